//! Orders of an operator, and a look at a fleet without joining it.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::time::{Duration, Instant};

use super::bucket::{self, Bucket, Entry, Opened, Seen, Watch};
use super::core::{Core, Input, Settings};
use super::gate::boot_time;
use super::keys::{DRAIN, Key, nanoseconds};
use super::{FleetStatus, LinkSpec, LinkStatus, Member, MemberStatus, Reach};
use crate::config::{Name, NatsSection};

/// The time for an order.
pub(super) const PATIENCE: Duration = Duration::from_secs(10);

/// An order that was not given.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct OrderError(pub(super) String);

/// The error of a server that does not answer in time.
pub(super) fn no_answer() -> OrderError {
    OrderError("the server does not answer".to_owned())
}

/// Moves a link, by its id, to a member, while that lives and reaches it; without one, back to its placement. The
/// members do that when they see the order: it needs no member to be asked.
///
/// # Errors
/// [`OrderError`] if there is no store, or if it does not answer.
pub async fn move_link(
    nats: &NatsSection,
    id: &Name,
    bucket: &Name,
    link: &str,
    member: Option<&Name>,
) -> Result<(), OrderError> {
    let member = member.map_or_else(String::new, Name::to_string);
    order(nats, id, bucket, &Key::Override(link).text(), member).await
}

/// Lets a member give its links to the others, until it is told not to. It keeps those that no other one reaches.
///
/// # Errors
/// [`OrderError`] if there is no store, or if it does not answer.
pub async fn drain(
    nats: &NatsSection,
    id: &Name,
    bucket: &Name,
    member: &Name,
    is_drained: bool,
) -> Result<(), OrderError> {
    let value = if is_drained { DRAIN } else { "" };
    order(nats, id, bucket, &Key::Drain(member.as_str()).text(), value.to_owned()).await
}

async fn order(nats: &NatsSection, id: &Name, bucket: &Name, key: &str, value: String) -> Result<(), OrderError> {
    let opened = bucket::open(nats, id, bucket, bucket::OPEN).await.map_err(|error| OrderError(error.to_string()))?;
    let stored = tokio::time::timeout(PATIENCE, opened.bucket.store().set(key, value)).await;
    stored.map_err(|_| no_answer())?.map_err(OrderError)
}

/// The state of a fleet as the store has it.
///
/// Times are those of the server: the times at which it stored entries, and the time at which it was asked.
#[derive(Clone, Debug, PartialEq)]
pub struct Observation {
    /// The replicas of the store.
    pub replicas: usize,
    /// The living members and those that have just fallen silent, in the order of their ids.
    pub members: Vec<MemberStatus>,
    /// All links of the configuration, in the order of their ids.
    pub links: Vec<LinkStatus>,
    /// The links that were moved by hand, each with its member.
    pub moved: BTreeMap<String, String>,
    /// The members that were told to give their links away, also those that do not live.
    pub drained: BTreeSet<String>,
}

/// Observes a fleet without joining it. `config`: the hash of the configuration; targets are those of members that
/// have it.
///
/// # Errors
/// [`OrderError`] if there is no store, or if it does not answer.
pub async fn observe(
    nats: &NatsSection,
    id: &Name,
    bucket: &Name,
    config: &str,
    links: Vec<LinkSpec>,
) -> Result<Observation, OrderError> {
    Ok(Observer::open(nats, id, bucket, config, links).await?.observation())
}

/// Watches a fleet without joining it.
pub struct Observer {
    /// The connection must last as long as its watch.
    _bucket: Bucket,
    watch: Watch,
    core: Core,
    replicas: usize,
    links: Vec<LinkSpec>,
    moved: BTreeMap<String, String>,
    drained: BTreeSet<String>,
    /// The times at which the server stored entries.
    stored_at: HashMap<String, u64>,
    /// The time of the server at `begin`.
    server_time: u64,
    begin: Instant,
}

impl std::fmt::Debug for Observer {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Observer").field("links", &self.links.len()).finish_non_exhaustive()
    }
}

impl Observer {
    /// Opens the store and reads it. See [`observe`].
    ///
    /// # Errors
    /// [`OrderError`] if there is no store, or if it does not answer.
    pub async fn open(
        nats: &NatsSection,
        id: &Name,
        bucket: &Name,
        config: &str,
        links: Vec<LinkSpec>,
    ) -> Result<Self, OrderError> {
        let opened =
            bucket::open(nats, id, bucket, bucket::OPEN).await.map_err(|error| OrderError(error.to_string()))?;
        let Opened { bucket, watch, created, last_revision, replicas, server_time } = opened;
        // No member has this id.
        let member = Member { id: "".into(), version: String::new(), config: config.to_owned(), weight: 0 };
        let settings = Settings { lease: 0, process: "observer".to_owned(), max_requests: 0 };
        let mut core = Core::new(settings, member.clone());
        core.handle(boot_time(), Input::Configure { member, links: links.clone() });
        core.handle(boot_time(), Input::Connected { created, last_revision });
        let mut observer = Self {
            _bucket: bucket,
            watch,
            core,
            replicas,
            links,
            moved: BTreeMap::new(),
            drained: BTreeSet::new(),
            stored_at: HashMap::new(),
            server_time,
            begin: Instant::now(),
        };
        tokio::time::timeout(PATIENCE, observer.read()).await.unwrap_or_else(|_| Err(no_answer()))?;
        Ok(observer)
    }

    /// Follows the fleet until the store is lost. Cancel-safe.
    ///
    /// # Errors
    /// [`OrderError`], always: entries may be missing.
    pub async fn follow(&mut self) -> Result<std::convert::Infallible, OrderError> {
        loop {
            self.step().await?;
        }
    }

    /// Reads the entries that are there at first.
    async fn read(&mut self) -> Result<(), OrderError> {
        while !self.step().await? {}
        Ok(())
    }

    /// Takes the next entry. Returns `true` when all have come that were there at first. Cancel-safe.
    async fn step(&mut self) -> Result<bool, OrderError> {
        let Entry { key, value, revision, stored_at } = match self.watch.next().await.map_err(OrderError)? {
            Seen::Entry(entry) => entry,
            Seen::Complete => return Ok(true),
        };
        let text = value.as_deref().filter(|value| !value.is_empty());
        match (Key::parse(&key), text) {
            (Some(Key::Override(link)), Some(member)) => {
                self.moved.insert(link.to_owned(), member.to_owned());
            }
            (Some(Key::Override(link)), None) => drop(self.moved.remove(link)),
            (Some(Key::Drain(member)), Some(DRAIN)) => drop(self.drained.insert(member.to_owned())),
            (Some(Key::Drain(member)), _) => drop(self.drained.remove(member)),
            (Some(Key::Session(_) | Key::Link(_)), _) => drop(self.stored_at.insert(key.clone(), stored_at)),
            (None, _) => {}
        }
        // Its view is never complete for the core, which so joins nothing.
        self.core.handle(boot_time(), Input::Entry { key, value, revision });
        Ok(false)
    }

    /// The fleet as the store has it now.
    pub fn observation(&mut self) -> Observation {
        let FleetStatus { mut members, links: mut statuses, .. } = self.core.observe(boot_time());
        let now = self.server_time.saturating_add(nanoseconds(self.begin.elapsed()));
        let stored_at = &self.stored_at;
        let age = |key: Key<'_>| stored_at.get(&key.text()).map(|at| Duration::from_nanos(now.saturating_sub(*at)));
        for member in &mut members {
            member.silent_for = age(Key::Session(&member.session)).unwrap_or_default();
        }
        let pinned = self.links.iter().filter(|link| matches!(link.reach, Reach::Pinned(_)));
        let pinned: HashSet<&str> = pinned.map(|link| &*link.id).collect();
        for status in &mut statuses {
            status.owned_for = age(Key::Link(&status.link)).unwrap_or_default();
            if pinned.contains(&*status.link) {
                // It has no entry: its host owns it whenever it lives.
                let host = members.iter_mut().find(|member| Some(&member.id) == status.owner.as_ref());
                match host {
                    Some(host) => host.links += 1,
                    None => status.owner = None,
                }
            }
        }
        let (moved, drained) = (self.moved.clone(), self.drained.clone());
        Observation { replicas: self.replicas, members, links: statuses, moved, drained }
    }
}
