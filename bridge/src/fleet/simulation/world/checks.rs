//! The rules that a run must keep, and its figures.

use std::fmt;
use std::sync::Arc;

use super::{World, id_of};
use crate::fleet::Reach;
use crate::fleet::keys::Key;
use crate::fleet::placement::{self, Candidate};
use crate::fleet::simulation::oracle::Owner;
use crate::fleet::simulation::{LEASE, Variant};

/// Figures of runs.
#[derive(Clone, Debug, Default)]
pub(in crate::fleet::simulation) struct Figures {
    pub(in crate::fleet::simulation) requests: u64,
    pub(in crate::fleet::simulation) handovers: u64,
    pub(in crate::fleet::simulation) faults: u64,
    pub(in crate::fleet::simulation) events: u64,
    pub(in crate::fleet::simulation) fences: u64,
    pub(in crate::fleet::simulation) failed: u64,
}

impl World {
    /// A PLC gets a request.
    pub(super) fn arrive(&mut self, link: &Arc<str>, owner: &Owner) {
        let last_take = if self.store.was_set_back { None } else { self.store.last_take(link) };
        if let Err(failure) = self.oracle.request(self.now, link, owner, last_take) {
            return self.fail(failure);
        }
        if self.variant != Variant::Real {
            return;
        }
        for (index, node) in self.nodes.iter().enumerate() {
            let Some(process) = &node.process else { continue };
            let Some(other) = process.owned.get(link).filter(|other| *other != owner) else { continue };
            let until = process.gates.get(&other.session).copied().unwrap_or(0);
            if self.local(index) < until {
                let failure = format!("{link}: request of {owner:?} while the gate of {other:?} is open");
                return self.fail(failure);
            }
        }
    }

    /// Each link must be polled by its target, and by no other node.
    pub(super) fn check_all_is_well(&self) -> Result<(), String> {
        let entries = self.store.entries();
        let value = |key: &str| {
            let entry = entries.iter().find(|change| change.key == key);
            entry.and_then(|change| change.value.clone()).filter(|value| !value.is_empty())
        };
        let running = self.nodes.iter().enumerate().filter(|(_, node)| node.process.is_some());
        let running: Vec<(usize, String, u32)> = running.map(|(n, node)| (n, id_of(n), node.weight)).collect();
        for link in &self.links {
            let reaches = |id: &str| match &link.reach {
                Reach::All => true,
                Reach::Only(members) => members.iter().any(|member| **member == *id),
                Reach::Pinned(_) => false,
            };
            let can_own = |id: &str| reaches(id) && value(&Key::Drain(id).text()).is_none();
            let candidates = running.iter().filter(|(_, id, _)| can_own(id));
            let candidates: Vec<_> =
                candidates.map(|(_, id, weight)| Candidate { member: id, weight: *weight, session: id }).collect();
            let by_hand = value(&Key::Override(&link.id).text());
            let by_hand = by_hand.and_then(|id| candidates.iter().copied().find(|candidate| candidate.member == id));
            let Some(target) = by_hand.or_else(|| placement::target(&link.id, candidates)) else { continue };
            let Some((at, node)) = self.oracle.last_request(&link.id) else {
                return Err(format!("{}: never polled", link.id));
            };
            let age = (self.now - at) as f64 / LEASE as f64;
            if id_of(node) != target.member || age > 0.5 {
                let id = &link.id;
                let target = target.member;
                return Err(format!("{id}: last polled by {} {age:.2} leases ago, in place of {target}", id_of(node)));
            }
        }
        Ok(())
    }
}

impl Figures {
    pub(in crate::fleet::simulation) fn add(&mut self, other: &Self) {
        self.requests += other.requests;
        self.handovers += other.handovers;
        self.faults += other.faults;
        self.events += other.events;
        self.fences += other.fences;
        self.failed += other.failed;
    }
}

impl fmt::Display for Figures {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { requests, handovers, faults, events, fences, failed } = self;
        write!(
            f,
            "{faults} faults, {requests} requests to PLCs, {handovers} handovers, {fences} sessions fenced, \
             {failed} members stopped by a store that was set back, {events} events"
        )
    }
}
