//! Orders of an operator, and a look at a fleet without joining it.

use std::time::Duration;

use super::bucket::{self, Opened, Seen};
use super::core::{Core, Input, Settings};
use super::gate::boot_time;
use super::keys::{DRAIN, Key, nanoseconds};
use super::{FleetStatus, LinkSpec, Member};
use crate::config::{Name, NatsSection};

/// The time for an order.
const PATIENCE: Duration = Duration::from_secs(10);

/// An order that was not given.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct OrderError(String);

/// Moves a link to a member, while that lives and reaches it; without one, back to its placement. The members do
/// that when they see the order: it needs no member to be asked.
///
/// # Errors
/// [`OrderError`] if there is no store, or if it does not answer.
pub async fn move_link(
    nats: &NatsSection,
    id: &Name,
    bucket: &Name,
    link: &Name,
    member: Option<&Name>,
) -> Result<(), OrderError> {
    let member = member.map_or_else(String::new, Name::to_string);
    order(nats, id, bucket, &Key::Override(link.as_str()).text(), member).await
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
    stored.unwrap_or_else(|_| Err("the server does not answer".to_owned())).map_err(OrderError)
}

/// The state of a fleet as the store has it, for one that is no member. How long a member is silent already, and
/// since when a link is owned, only members know.
///
/// # Errors
/// [`OrderError`] if there is no store, or if it does not answer.
pub async fn observe(
    nats: &NatsSection,
    bucket: &Name,
    lease: Duration,
    member: Member,
    links: Vec<LinkSpec>,
) -> Result<FleetStatus, OrderError> {
    let fail = |error: String| OrderError(error);
    let id = Name::parse(&member.id).ok_or_else(|| fail("the id is not a name".to_owned()))?;
    let opened = bucket::open(nats, &id, bucket).await.map_err(|error| fail(error.to_string()))?;
    let settings = Settings { lease: nanoseconds(lease), process: "observer".to_owned(), max_requests: 0 };
    let mut core = Core::new(settings, member.clone());
    core.handle(boot_time(), Input::Configure { member, links });
    // The connection must last as long as its watch.
    let Opened { bucket: _bucket, mut watch, created, last_revision } = opened;
    core.handle(boot_time(), Input::Connected { created, last_revision });
    loop {
        let seen = tokio::time::timeout(PATIENCE, watch.next()).await;
        match seen.unwrap_or_else(|_| Err("the server does not answer".to_owned())).map_err(fail)? {
            Seen::Entry(entry) => {
                let input = Input::Entry { key: entry.key, value: entry.value, revision: entry.revision };
                core.handle(boot_time(), input);
            }
            Seen::Complete => return Ok(core.observe(boot_time())),
        }
    }
}
