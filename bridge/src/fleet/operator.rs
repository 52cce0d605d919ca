//! Orders of an operator, and a look at a fleet without joining it.

use std::collections::{BTreeMap, BTreeSet, HashMap, HashSet};
use std::time::{Duration, Instant};

use super::bucket::{self, Opened, Seen};
use super::core::{Core, Input, Settings};
use super::gate::boot_time;
use super::keys::{DRAIN, Key, nanoseconds};
use super::{FleetStatus, LinkSpec, LinkStatus, Member, MemberStatus, Reach};
use crate::config::{Name, NatsSection};

/// The time for an order.
const PATIENCE: Duration = Duration::from_secs(10);
const NO_ANSWER: &str = "the server does not answer";

/// An order that was not given.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct OrderError(String);

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
    let opened = bucket::open(nats, id, bucket).await.map_err(|error| OrderError(error.to_string()))?;
    let stored = tokio::time::timeout(PATIENCE, opened.bucket.store().set(key, value)).await;
    stored.unwrap_or_else(|_| Err(NO_ANSWER.to_owned())).map_err(OrderError)
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
    let opened = bucket::open(nats, id, bucket).await.map_err(|error| OrderError(error.to_string()))?;
    // The connection must last as long as its watch.
    let Opened { bucket: _bucket, mut watch, created, last_revision, replicas, server_time } = opened;
    let begin = Instant::now();
    // No member has this id.
    let member = Member { id: "".into(), version: String::new(), config: config.to_owned(), weight: 0 };
    let settings = Settings { lease: 0, process: "observer".to_owned(), max_requests: 0 };
    let mut core = Core::new(settings, member.clone());
    core.handle(boot_time(), Input::Configure { member, links: links.clone() });
    core.handle(boot_time(), Input::Connected { created, last_revision });
    let (mut moved, mut drained) = (BTreeMap::new(), BTreeSet::new());
    let mut stored_at: HashMap<String, u64> = HashMap::new();
    loop {
        let seen = tokio::time::timeout(PATIENCE, watch.next()).await;
        let entry = match seen.unwrap_or_else(|_| Err(NO_ANSWER.to_owned())).map_err(OrderError)? {
            Seen::Entry(entry) => entry,
            Seen::Complete => break,
        };
        let value = entry.value.as_deref().filter(|value| !value.is_empty());
        match (Key::parse(&entry.key), value) {
            (Some(Key::Override(link)), Some(member)) => {
                moved.insert(link.to_owned(), member.to_owned());
            }
            (Some(Key::Override(link)), None) => drop(moved.remove(link)),
            (Some(Key::Drain(member)), Some(DRAIN)) => drop(drained.insert(member.to_owned())),
            (Some(Key::Drain(member)), _) => drop(drained.remove(member)),
            (Some(Key::Session(_) | Key::Link(_)), _) => drop(stored_at.insert(entry.key.clone(), entry.stored_at)),
            (None, _) => {}
        }
        core.handle(boot_time(), Input::Entry { key: entry.key, value: entry.value, revision: entry.revision });
    }
    let FleetStatus { mut members, links: mut statuses, .. } = core.observe(boot_time());
    let now = server_time.saturating_add(nanoseconds(begin.elapsed()));
    let age = |key: Key<'_>| stored_at.get(&key.text()).map(|at| Duration::from_nanos(now.saturating_sub(*at)));
    for member in &mut members {
        member.silent_for = age(Key::Session(&member.session)).unwrap_or_default();
    }
    let pinned = links.iter().filter(|link| matches!(link.reach, Reach::Pinned(_)));
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
    Ok(Observation { replicas, members, links: statuses, moved, drained })
}
