//! The bridge as a member of a fleet: it polls the PLCs of the links that it owns, and no others.
//!
//! ```text
//! Fleet ──Owned──▶ links of this member ──▶ registry: PLCs are polled, with links whose gate is that of the ownership
//!       ──Close──▶ registry: PLCs are not polled ──▶ links are closed ──▶ Fleet: another member may take them
//! ```
//!
//! Invariants:
//! - The id of a link is made of its address: a PLC with another name or another bus keeps its owner.
//! - A link is opened with the gate of the present ownership, and is closed before the fleet gets it back. So no link
//!   lives longer than its ownership.
//! - An endpoint without an ownership has a gate that is never open.

use std::collections::{HashMap, HashSet};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, PoisonError, RwLock};
use std::time::Duration;

use fatek::link::SendGate;
use fatek::plant::Plant;
use fatek::{Endpoint, Pool, PoolBuilder};
use tokio::task::{JoinError, JoinHandle};
use tokio::time::{Instant, sleep_until, timeout};

use super::{Bridge, RunError, Signals, connections};
use crate::config::{BridgeSection, Config, Name, NatsSection};
use crate::fleet::{
    Closing, Event, Events, Fleet, FleetError, FleetSettings, FleetStatus, FleetTask, Gate, LinkToken, MemberStatus,
    Ownership, PlantLinks, Reach, link_id, member,
};
use crate::registry::{AddError, Elsewhere, PlcOwnership, Registry, Share};

/// The part of the bridge that polls what a member owns.
pub(super) const SHARE: &str = "share of the fleet";
/// The time for commands that are under way when the bridge ends.
const COMMANDS: Duration = Duration::from_secs(3);
/// The time for all links to be closed and released when the bridge ends, and more for each of them: few are handed
/// over at once.
const LEAVE: Duration = Duration::from_secs(5);
const LEAVE_LINK: Duration = Duration::from_millis(10);
/// The time between two looks at who has got the PLCs that this member has lost.
const LOOK: Duration = Duration::from_secs(1);

/// The membership of a bridge. Cheap to clone.
#[derive(Clone, Debug)]
pub struct Membership {
    fleet: Fleet,
    owned: OwnedLinks,
    /// The server of its store, until it ends.
    nats: Arc<NatsSection>,
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

    /// The section of the server of its store, as it was at the start.
    pub(super) fn nats(&self) -> &NatsSection {
        &self.nats
    }

    /// The links of the configuration that is in force.
    pub(crate) fn links(&self) -> Arc<PlantLinks> {
        self.links.read().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// The PLCs of a plant whose links this member owns.
    pub(super) fn owned_plcs(&self, plant: &Plant) -> HashMap<Arc<str>, PlcOwnership> {
        let links = PlantLinks::of(plant);
        self.owned.plcs(&links, links.specs().iter().map(|link| &link.id))
    }

    /// Applies a configuration to the fleet.
    pub(super) fn configure(&self, config: &Config) {
        let links = PlantLinks::of(&config.plant);
        self.fleet.configure(member(config), links.specs().to_vec());
        *self.links.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(links);
    }
}

/// The links that this member owns, by id. Cheap to clone.
///
/// The id of a link is made of its address, so that a link is opened with the gate of its own ownership, also if a
/// configuration gives its PLCs other names.
#[derive(Clone, Debug)]
pub(super) struct OwnedLinks {
    /// The id of this member: the host of its serial ports.
    member: Name,
    links: Arc<RwLock<HashMap<Arc<str>, Owned>>>,
}

#[derive(Debug)]
struct Owned {
    token: LinkToken,
    gate: Gate,
    /// The endpoint, once its link is open; with each of the options that configurations have given it.
    opened: Vec<Endpoint>,
}

impl OwnedLinks {
    pub(super) fn new(member: Name) -> Self {
        Self { member, links: Arc::default() }
    }

    /// The pool of a member: its links ask the gates of the ownerships before each write.
    pub(super) fn pool(&self, connections: PoolBuilder) -> Pool {
        let owned = self.clone();
        connections.send_gates(move |endpoint: &Endpoint| Some(owned.gate_of(endpoint))).build()
    }

    fn gate_of(&self, endpoint: &Endpoint) -> SendGate {
        let id = link_id(endpoint, Some(self.member.as_str()));
        let mut links = self.links.write().unwrap_or_else(PoisonError::into_inner);
        match links.get_mut(id.as_str()) {
            Some(owned) => {
                if !owned.opened.contains(endpoint) {
                    owned.opened.push(endpoint.clone());
                }
                let gate = owned.gate.clone();
                SendGate::new(move || gate.is_open())
            }
            None => SendGate::new(|| false),
        }
    }

    fn insert(&self, ownership: &Ownership) {
        let owned = Owned { token: ownership.token, gate: ownership.gate.clone(), opened: Vec::new() };
        self.links.write().unwrap_or_else(PoisonError::into_inner).insert(ownership.link.clone(), owned);
    }

    /// Ends an ownership. Returns the endpoints whose links are open.
    fn remove(&self, link: &str) -> Vec<Endpoint> {
        let removed = self.links.write().unwrap_or_else(PoisonError::into_inner).remove(link);
        removed.map(|owned| owned.opened).unwrap_or_default()
    }

    fn count(&self) -> u32 {
        u32::try_from(self.links.read().unwrap_or_else(PoisonError::into_inner).len()).unwrap_or(u32::MAX)
    }

    /// The PLCs of links that are owned.
    fn plcs<'l>(&self, links: &PlantLinks, of: impl Iterator<Item = &'l Arc<str>>) -> HashMap<Arc<str>, PlcOwnership> {
        let owned = self.links.read().unwrap_or_else(PoisonError::into_inner);
        let known = of.filter_map(|link| Some((link, owned.get(link)?)));
        let plcs = known.flat_map(|(link, owned)| {
            let ownership = PlcOwnership { revision: owned.token.revision, gate: owned.gate.clone() };
            links.plcs_of(link).iter().map(move |name| (name.clone(), ownership.clone()))
        });
        plcs.collect()
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
    Ok(Some((Membership { fleet, owned, nats: Arc::new(nats.clone()), links, counters: Arc::default() }, events, task)))
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
    let links = membership.links();
    let has_owner = |link: &str| status.link(link)?.owner.as_ref().map(|id| *id != status.id);
    let is_found = |plc: &str| links.link_of(plc).and_then(|link| has_owner(link)).unwrap_or(false);
    bridge.registry.settle(is_found);
}

/// Changes of several links, each of them once.
#[derive(Debug, Default)]
struct Changes {
    owned: Vec<Ownership>,
    closings: Vec<Closing>,
    links: HashSet<Arc<str>>,
}

impl Changes {
    /// Adds an event. Returns it if its link has another one here already.
    fn add(&mut self, event: Event) -> Option<Event> {
        let link = match &event {
            Event::Owned(ownership) => &ownership.link,
            Event::Close(closing) => &closing.link,
        };
        if !self.links.insert(link.clone()) {
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
        let plcs = membership.owned.plcs(&membership.links(), of);
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
        match taken.await {
            Ok(taken) => taken,
            // Then the bridge ends.
            Err(error) if error.is_panic() => std::panic::resume_unwind(error.into_panic()),
            Err(_) => Ok(()),
        }
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
    // It can be old by half a second. An owner repeats its states.
    let of_closing = |closing: &Closing| {
        let target = status.link(&closing.link).and_then(|link| link.target.as_ref());
        let has_target = target.is_some_and(|target| *target != status.id);
        if closing.is_lost || !has_target { Elsewhere::Lost } else { Elsewhere::Member }
    };
    bridge.registry.give_up(closings.iter().flat_map(|closing| {
        let elsewhere = of_closing(closing);
        links.plcs_of(&closing.link).iter().map(move |name| (name, elsewhere))
    }));
    for closing in closings {
        let opened = membership.owned.remove(&closing.link);
        let pool = bridge.pool.clone();
        tokio::spawn(async move {
            for endpoint in &opened {
                pool.close_endpoint(endpoint).await;
            }
            tracing::debug!(link = %closing.link, token = %closing.token, "fleet: closed");
            closing.closed();
        });
    }
}

/// Returns whether all PLCs of a configuration can be polled that a member may get: it finds out before it joins.
///
/// # Errors
/// [`AddError`] names the PLC.
pub(super) fn check(plant: &Plant, bridge: &BridgeSection) -> Result<(), AddError> {
    // Its gates are closed: a pool without gates would connect, and send requests to PLCs of other members.
    let (poller, pool) = (fatek::Poller::new(), OwnedLinks::new(bridge.id.clone()).pool(connections(bridge)));
    let (links, member) = (PlantLinks::of(plant), &bridge.id);
    let is_for = |reach: &Reach| match reach {
        Reach::All => true,
        Reach::Only(hosts) => hosts.iter().any(|host| **host == *member.as_str()),
        // A port of another host may have other settings.
        Reach::Pinned(host) => **host == *member.as_str(),
    };
    let ownership = PlcOwnership { revision: 0, gate: Gate::always_open() };
    let own = links.specs().iter().filter(|link| is_for(&link.reach)).flat_map(|link| links.plcs_of(&link.id));
    let own: HashMap<Arc<str>, PlcOwnership> = own.map(|name| (name.clone(), ownership.clone())).collect();
    Registry::default().apply_share(plant, Share::Owned(&own), &pool, &poller.handle()).map(drop)
}

/// Ends polling, and closes all links.
pub(super) async fn close_all(bridge: &Bridge) {
    let closed = async {
        bridge.poller.close().await;
        bridge.pool.close().await;
    };
    if timeout(LEAVE, closed).await.is_err() {
        tracing::warn!("a link did not close within {LEAVE:?}");
    }
}

/// Ends the commands that are under way, and gives all links to the other members. A second signal ends the wait:
/// returns whether there was one.
pub(super) async fn leave(bridge: &Bridge, membership: &Membership, task: FleetTask, signals: &mut Signals) -> bool {
    let registry = bridge.registry.clone();
    let limit = LEAVE + LEAVE_LINK.saturating_mul(membership.owned.count());
    let left = async {
        // A reload goes on in its thread. It must not bring back what is given away.
        let _ = tokio::task::spawn_blocking(move || registry.freeze()).await;
        if let Some(commands) = &bridge.commands
            && timeout(COMMANDS, commands.close()).await.is_err()
        {
            tracing::warn!("commands did not end within {COMMANDS:?}: their links are closed");
        }
        membership.fleet.leave();
        timeout(limit, task).await
    };
    tokio::select! {
        left = left => {
            match left {
                Ok(Ok(Ok(()))) => {
                    let status = membership.status();
                    // A server that was killed may have lost that another member has left: that one is silent.
                    let is_other = |member: &MemberStatus| member.id != status.id && !member.is_silent();
                    if !status.members.iter().any(is_other) {
                        bridge.registry.lose_all();
                    }
                }
                Ok(Ok(Err(error))) => tracing::error!("fleet: {error}"),
                Ok(Err(_)) => tracing::error!("the fleet has failed: this is a fault of the bridge"),
                Err(_) => tracing::warn!("the fleet was not left within {limit:?}: its links are free after the lease"),
            }
            false
        }
        () = signals.end() => {
            membership.fleet.leave();
            tracing::warn!("a second signal: links are free after the lease, if they are not given away before");
            true
        }
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
        Ok(Ok(())) | Err(_) => RunError::Panicked(SHARE),
    }
}
