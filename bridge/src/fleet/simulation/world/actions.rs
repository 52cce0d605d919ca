//! Actions of cores, and the requests to PLCs that follow from them.

use std::sync::Arc;

use super::{Event, POLL, TO_PLC, World};
use crate::fleet::core::Action;
use crate::fleet::simulation::faults::Fault;
use crate::fleet::simulation::oracle::Owner;
use crate::fleet::simulation::{LEASE, Variant};

impl World {
    pub(super) fn act(&mut self, node: usize, start: u32, action: Action) {
        match action {
            Action::Request { request, operation, timeout } => {
                self.note(|| format!("node {node} sends {request}: {operation:?}"));
                self.send(node, start, request, operation, timeout);
            }
            Action::Gate { session, until } => self.set_gate(node, start, session, until),
            Action::Own { link, token, session } => {
                self.note(|| format!("node {node} owns {link} by {token}"));
                let session = session.unwrap_or_else(|| "pinned".into());
                let owner = Owner { node, start, session, token: token.revision };
                let Some(process) = self.process(node, start) else { return };
                let before = process.owned.insert(link.clone(), owner.clone());
                if before.is_some() {
                    return self.fail(format!("node {node} owns {link} twice"));
                }
                let at = self.rng.u64(..POLL / 8);
                self.after(at, Event::Poll { node, start, owner, link, is_extra: false });
                self.moment(node, 0);
            }
            Action::Close { link, token } => {
                self.note(|| format!("node {node} closes {link} of {token}"));
                let Some(process) = self.process(node, start) else { return };
                let owner = process.owned.remove(&link);
                if owner.is_none_or(|owner| owner.token != token.revision) {
                    return self.fail(format!("node {node} closes {link} of {token}, which it does not own"));
                }
                // Until its last request is off the wire.
                let at = TO_PLC + self.rng.u64(1..LEASE / 10);
                self.after(at, Event::Closed { node, start, link, token });
                self.moment(node, 0);
            }
            Action::Reconnect => self.lose_connection(node, start),
            Action::Warn(text) => self.note(|| format!("node {node} warns: {text}")),
            Action::Fail(fault) => {
                self.note(|| format!("node {node} fails: {fault}"));
                self.figures.failed += 1;
                let was_set_back = self.store.was_set_back;
                let Some(process) = self.process(node, start) else { return };
                process.has_failed = true;
                if !was_set_back {
                    return self.fail(format!("node {node} fails without a reason: {fault}"));
                }
                let wait = self.rng.u64(LEASE / 10..LEASE * 3);
                self.after(wait, Event::Fault(Fault::Replace { node, start }));
            }
            Action::Left => {
                self.note(|| format!("node {node} has left"));
                if let Some(process) = self.process(node, start) {
                    process.has_left = true;
                }
                let wait = self.rng.u64(LEASE / 10..LEASE * 3);
                self.after(wait, Event::Fault(Fault::Replace { node, start }));
            }
        }
    }

    fn set_gate(&mut self, node: usize, start: u32, session: Arc<str>, until: u64) {
        self.note(|| format!("node {node} has a gate until {until} ({session})"));
        let Some(process) = self.process(node, start) else { return };
        process.gates.insert(session.clone(), until);
        if until == 0 {
            return;
        }
        // The last moments of a gate matter.
        let owned: Vec<_> = process.owned.clone().into_iter().collect();
        let end = self.true_time(node, until);
        for (link, owner) in owned {
            let before = self.rng.u64(1..LEASE / 100);
            self.at(end.saturating_sub(before), Event::Poll { node, start, owner, link, is_extra: true });
        }
        self.moment(node, end.saturating_sub(self.now));
    }

    /// A request is due for a link that a process owns, if it still does.
    pub(super) fn poll(&mut self, node: usize, start: u32, owner: Owner, link: Arc<str>, is_extra: bool) {
        let local = self.local(node);
        let variant = self.variant;
        let Some(process) = self.process(node, start) else { return };
        if process.owned.get(&link) != Some(&owner) {
            return;
        }
        let until = process.gates.get(&owner.session).copied().unwrap_or(0);
        if local < until || variant == Variant::NoGate {
            let way = self.rng.u64(..TO_PLC);
            self.after(way, Event::Arrive { link: link.clone(), owner: owner.clone() });
        }
        if !is_extra {
            let period = self.rng.u64(POLL / 2..POLL * 3 / 2);
            self.after(period, Event::Poll { node, start, owner, link, is_extra });
        }
    }
}
