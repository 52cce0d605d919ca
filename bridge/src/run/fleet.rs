//! The bridge as a member of a fleet: it polls the PLCs of the links that it owns, and no others.
//!
//! ```text
//! Fleet ──Owned──▶ links of this member ──▶ registry: PLCs are polled, with links whose gate is that of the ownership
//!       ──Close──▶ registry: PLCs are not polled ──▶ links are closed ──▶ Fleet: another member may take them
//! ```
//!
//! Invariants:
//! - A link is opened with the gate of the present ownership, and is closed before the fleet gets it back. So no link
//!   lives longer than its ownership.
//! - An endpoint without an ownership has a gate that is never open.

use std::collections::HashMap;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use fatek::link::SendGate;
use fatek::plant::Plant;
use fatek::{Endpoint, Pool};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Instant, sleep_until, timeout};

use super::{Bridge, RunError, Signals};
use crate::config::Config;
use crate::fleet::{
    Closing, Event, Events, Fleet, FleetError, FleetSettings, FleetStatus, FleetTask, Gate, LinkToken, Ownership,
    PlantLinks, member,
};
use crate::registry::{AddError, Elsewhere, Share};

/// The time for all links to be closed and released when the bridge ends.
const LEAVE: Duration = Duration::from_secs(5);
/// The time between two looks at who has got the PLCs that this member has lost.
const LOOK: Duration = Duration::from_secs(1);

/// The membership of a bridge. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Membership {
    fleet: Fleet,
    owned: OwnedLinks,
    /// Of the configuration that is in force.
    links: Arc<RwLock<Arc<PlantLinks>>>,
    counters: Arc<Counters>,
}

#[derive(Debug, Default)]
struct Counters {
    taken: AtomicU64,
    lost: AtomicU64,
}

/// Links that a member has got and lost since its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MembershipCounts {
    /// Links that it has got.
    pub taken: u64,
    /// Links that it has lost, because the store did not answer in time.
    pub lost: u64,
}

impl Membership {
    /// The state of the fleet, as this member sees it.
    #[must_use]
    pub fn status(&self) -> Arc<FleetStatus> {
        self.fleet.status()
    }

    /// The links that it has got and lost since its start.
    #[must_use]
    pub fn counts(&self) -> MembershipCounts {
        let Counters { taken, lost } = &*self.counters;
        MembershipCounts { taken: taken.load(Ordering::Relaxed), lost: lost.load(Ordering::Relaxed) }
    }

    fn links(&self) -> Arc<PlantLinks> {
        self.links.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The fencing tokens of the PLCs of a plant whose links this member owns. Their links are opened with the
    /// gates of these ownerships from now on.
    pub(super) fn owned_plcs(&self, plant: &Plant) -> HashMap<Arc<str>, u64> {
        let links = PlantLinks::of(plant);
        self.owned.plcs(plant, &links, links.specs().iter().map(|link| &link.id))
    }

    /// Applies a configuration to the fleet.
    pub(super) fn configure(&self, config: &Config) {
        let links = PlantLinks::of(&config.plant);
        self.fleet.configure(member(config), links.specs().to_vec());
        *self.links.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(links);
    }
}

/// The links that this member owns. Cheap to clone.
#[derive(Clone, Debug, Default)]
pub(super) struct OwnedLinks(Arc<RwLock<OwnedState>>);

/// Invariant: `endpoints` has those of the `links`, and no others.
#[derive(Debug, Default)]
struct OwnedState {
    links: HashMap<Arc<str>, Owned>,
    endpoints: HashMap<Endpoint, Arc<str>>,
}

#[derive(Debug)]
struct Owned {
    token: LinkToken,
    gate: Gate,
    /// That of the configuration, and those of configurations before it.
    endpoints: Vec<Endpoint>,
}

impl OwnedLinks {
    /// The pool of a member: its links ask the gates of the ownerships before each write.
    pub(super) fn pool(&self) -> Pool {
        let owned = self.clone();
        Pool::builder().send_gates(move |endpoint| Some(owned.gate_of(endpoint))).build()
    }

    fn gate_of(&self, endpoint: &Endpoint) -> SendGate {
        let owned = self.0.read().unwrap_or_else(PoisonError::into_inner);
        match owned.endpoints.get(endpoint).and_then(|link| owned.links.get(link)) {
            Some(owned) => {
                let gate = owned.gate.clone();
                SendGate::new(move || gate.is_open())
            }
            None => SendGate::new(|| false),
        }
    }

    fn insert(&self, ownership: &Ownership) {
        let owned = Owned { token: ownership.token, gate: ownership.gate.clone(), endpoints: Vec::new() };
        self.0.write().unwrap_or_else(PoisonError::into_inner).links.insert(ownership.link.clone(), owned);
    }

    /// Ends the ownership of a link. Returns its endpoints.
    fn remove(&self, link: &str) -> Vec<Endpoint> {
        let mut owned = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let removed = owned.links.remove(link).map(|owned| owned.endpoints).unwrap_or_default();
        removed.iter().for_each(|endpoint| drop(owned.endpoints.remove(endpoint)));
        removed
    }

    /// The PLCs of links of a plant that are owned, with their tokens.
    fn plcs<'l>(
        &self,
        plant: &Plant,
        links: &PlantLinks,
        of: impl Iterator<Item = &'l Arc<str>>,
    ) -> HashMap<Arc<str>, u64> {
        let mut owned = self.0.write().unwrap_or_else(PoisonError::into_inner);
        let OwnedState { links: known, endpoints } = &mut *owned;
        let mut plcs = HashMap::new();
        for link in of {
            let Some(owned) = known.get_mut(link) else { continue };
            for plc in links.plcs_of(link).iter().filter_map(|name| plant.plc(name)) {
                let endpoint = plc.endpoint();
                if !endpoints.contains_key(endpoint) {
                    endpoints.insert(endpoint.clone(), link.clone());
                    owned.endpoints.push(endpoint.clone());
                }
                plcs.insert(plc.name().into(), owned.token.revision);
            }
        }
        plcs
    }
}

/// Joins the fleet of a configuration.
pub(super) fn join(config: &Config, owned: OwnedLinks) -> Result<Option<(Membership, Events, FleetTask)>, FleetError> {
    let Some((fleet, nats)) = config.fleet.as_ref().zip(config.nats.as_ref()) else { return Ok(None) };
    let links = PlantLinks::of(&config.plant);
    let settings = FleetSettings {
        nats: nats.clone(),
        bucket: fleet.bucket.clone(),
        lease: fleet.lease.0,
        member: member(config),
        links: links.specs().to_vec(),
    };
    let (fleet, events, task) = Fleet::start(settings)?;
    let links = Arc::new(RwLock::new(Arc::new(links)));
    Ok(Some((Membership { fleet, owned, links, counters: Arc::default() }, events, task)))
}

/// Polls what the fleet gives to this member, until the fleet ends.
///
/// # Errors
/// [`AddError`] if a PLC cannot be polled.
pub(super) async fn run(bridge: Bridge, membership: Membership, mut events: Events) -> Result<(), AddError> {
    let mut look = Instant::now() + LOOK;
    loop {
        let first = tokio::select! {
            event = events.recv() => match event {
                Some(event) => event,
                None => return Ok(()),
            },
            () = sleep_until(look) => {
                look = Instant::now() + LOOK;
                settle(&bridge, &membership);
                continue;
            }
        };
        // Many links come and go at once.
        let mut changes = Changes::default();
        let mut next = Some(first);
        // A reload has the plant that is in force before and after.
        let _changing = bridge.changing.lock().await;
        while let Some(event) = next {
            if let Some(event) = changes.add(event) {
                std::mem::take(&mut changes).apply(&bridge, &membership).await?;
                // The first one of the next changes.
                changes.add(event);
            }
            next = events.try_recv().ok();
        }
        changes.apply(&bridge, &membership).await?;
    }
}

/// Forgets that PLCs were lost which other members have got.
fn settle(bridge: &Bridge, membership: &Membership) {
    if bridge.registry.read().lost().next().is_none() {
        return;
    }
    let status = membership.status();
    let owned: HashMap<&str, bool> =
        status.links.iter().map(|link| (&*link.link, link.owner.as_ref().is_some_and(|id| *id != status.id))).collect();
    let links = membership.links();
    let is_found = |plc: &str| links.link_of(plc).is_some_and(|link| owned.get(&**link) == Some(&true));
    bridge.registry.settle(is_found);
}

/// Changes of several links, each of them once.
#[derive(Debug, Default)]
struct Changes {
    owned: Vec<Ownership>,
    closings: Vec<Closing>,
}

impl Changes {
    /// Adds an event. Returns it if its link has another one here already.
    fn add(&mut self, event: Event) -> Option<Event> {
        let link = match &event {
            Event::Owned(ownership) => &ownership.link,
            Event::Close(closing) => &closing.link,
        };
        let is_here = self.owned.iter().any(|owned| owned.link == *link)
            || self.closings.iter().any(|closing| closing.link == *link);
        if is_here {
            return Some(event);
        }
        match event {
            Event::Owned(ownership) => self.owned.push(ownership),
            Event::Close(closing) => self.closings.push(closing),
        }
        None
    }

    async fn apply(self, bridge: &Bridge, membership: &Membership) -> Result<(), AddError> {
        let config = bridge.config();
        if !self.closings.is_empty() {
            close(bridge, membership, self.closings);
        }
        if self.owned.is_empty() {
            return Ok(());
        }
        self.owned.iter().for_each(|ownership| membership.owned.insert(ownership));
        membership.counters.taken.fetch_add(count(self.owned.len()), Ordering::Relaxed);
        let of = self.owned.iter().map(|ownership| &ownership.link);
        let mut plcs = membership.owned.plcs(&config.plant, &membership.links(), of);
        plcs.retain(|plc, _| bridge.registry.read().get(plc).is_none());
        for plc in plcs.keys().filter_map(|name| config.plant.plc(name)) {
            // One that was opened without an ownership, such as for the end of a pulse, has a closed gate.
            bridge.pool.close_endpoint(plc.endpoint()).await;
        }
        let Bridge { registry, pool, poller, .. } = bridge.clone();
        // Thousands of tags may be planned: that blocks.
        let runtime = tokio::runtime::Handle::current();
        let taken = tokio::task::spawn_blocking(move || {
            let _runtime = runtime.enter();
            registry.take(&config.plant, &plcs, &pool, &poller)
        });
        // An error: the runtime ends.
        taken.await.unwrap_or(Ok(()))
    }
}

fn count(links: usize) -> u64 {
    u64::try_from(links).unwrap_or(u64::MAX)
}

/// Ends polling of links, closes them, and tells that to the fleet.
fn close(bridge: &Bridge, membership: &Membership, closings: Vec<Closing>) {
    let lost = closings.iter().filter(|closing| closing.is_lost).count();
    membership.counters.lost.fetch_add(count(lost), Ordering::Relaxed);
    if lost > 0 {
        tracing::warn!("fleet: {lost} links are lost: the store did not answer in time");
    }
    let links = membership.links();
    let status = membership.status();
    let is_alone = status.members.iter().all(|member| member.id == status.id || member.is_draining);
    let of_closing = |closing: &Closing| if closing.is_lost || is_alone { Elsewhere::Lost } else { Elsewhere::Member };
    bridge.registry.give_up(closings.iter().flat_map(|closing| {
        let elsewhere = of_closing(closing);
        links.plcs_of(&closing.link).iter().map(move |name| (name, elsewhere))
    }));
    for closing in closings {
        let endpoints = membership.owned.remove(&closing.link);
        let pool = bridge.pool.clone();
        tokio::spawn(async move {
            for endpoint in &endpoints {
                pool.close_endpoint(endpoint).await;
            }
            tracing::debug!(link = %closing.link, token = %closing.token, "fleet: closed");
            closing.closed();
        });
    }
}

/// Returns whether all PLCs of a configuration can be polled: a member finds out before it joins.
///
/// # Errors
/// [`AddError`] names the PLC.
pub(super) fn check(plant: &Plant) -> Result<(), AddError> {
    let poller = fatek::Poller::new();
    let registry = crate::registry::Registry::default();
    // Its gates are closed: a pool without gates would connect, and send requests to PLCs of other members.
    let pool = OwnedLinks::default().pool();
    registry.apply_share(plant, Share::All, &pool, &poller.handle()).map(drop)
}

/// Ends the commands that are under way, and gives all links to the other members. A second signal ends the wait.
pub(super) async fn leave(bridge: &Bridge, membership: &Membership, task: FleetTask, signals: &mut Signals) {
    let left = async {
        if let Some(commands) = &bridge.commands {
            commands.close().await;
        }
        membership.fleet.leave();
        task.await
    };
    tokio::select! {
        left = timeout(LEAVE, left) => match left {
            Ok(Ok(Ok(()))) => {}
            Ok(Ok(Err(error))) => tracing::error!("fleet: {error}"),
            Ok(Err(_)) => tracing::error!("the fleet has failed: this is a fault of the bridge"),
            Err(_) => tracing::warn!("the fleet was not left within {LEAVE:?}: its links are free after the lease"),
        },
        () = signals.end() => tracing::warn!("a second signal: links are free after the lease"),
    }
}

/// Waits for the end of a task; forever without one. Cancel-safe.
pub(super) async fn end_of<T>(task: &mut Option<JoinHandle<T>>) -> Result<T, JoinError> {
    match task {
        Some(task) => task.await,
        None => std::future::pending().await,
    }
}

/// The error of a member that has ended by itself.
pub(super) fn ended(result: Result<Result<(), FleetError>, JoinError>) -> RunError {
    match result {
        Ok(Err(error)) => RunError::Fleet(error),
        Ok(Ok(())) | Err(_) => RunError::Panicked("fleet"),
    }
}

/// The error of the task that polls the share of a member, unless it has ended with the fleet.
pub(super) fn ended_share(result: Result<Result<(), AddError>, JoinError>) -> RunError {
    match result {
        Ok(Err(error)) => RunError::Add(error),
        Ok(Ok(())) | Err(_) => RunError::Panicked("share of the fleet"),
    }
}
