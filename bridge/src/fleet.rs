//! A fleet: several bridges share the PLCs of one configuration, and each PLC has one master at a time.
//!
//! The members know each other through a bucket of NATS JetStream KV alone. Each has a session there, which it
//! renews, and each link of the configuration has an entry with the session of its owner. The revision of that
//! entry is the fencing token of the ownership. No decision depends on a wall clock or on the clock of the server.
//!
//! ```text
//!   NATS KV ◀──requests, watch──▶ driver ◀──inputs, actions──▶ core (no I/O, no clock)
//!                                    │
//!                                    └──▶ Ownership { link, token, gate } ──▶ rest of the bridge
//! ```
//!
//! | module | content |
//! |---|---|
//! | `bucket` | the store in NATS: opened, watched, written and made |
//! | `core` | the protocol of one member, with its rules and invariants |
//! | `driver` | runs the core: store, clock and rest of the bridge |
//! | `gate` | the check in front of each write to a PLC |
//! | `keys` | keys and values in the bucket |
//! | `naive` | naive variants that a test must see fail, with the feature `naive-fleet` alone |
//! | `open_limit` | the time for opening the store |
//! | `operator` | orders by hand, and a look at the fleet without joining it |
//! | `placement` | the member that is to own a link |
//! | `status` | the state of the fleet, as a member sees it |
//! | `plants` | the plant in the store, with its versions |
//! | `simulation` | seeded test of whole fleets with faults |
//! | `spec` | links, member and hash of a configuration |

mod bucket;
mod core;
mod driver;
mod gate;
mod keys;
#[cfg(feature = "naive-fleet")]
mod naive;
mod open_limit;
mod operator;
mod placement;
mod plants;
#[cfg(test)]
mod simulation;
mod spec;
mod status;

use std::fmt;
use std::sync::Arc;

use tokio::sync::oneshot;

pub use self::bucket::{InitError, Initialized, init};
pub use self::core::{Member, StoreFault};
pub use self::driver::{Events, Fleet, FleetError, FleetSettings, FleetTask};
pub use self::gate::{Gate, boot_time};
pub use self::operator::{Observation, Observer, OrderError, drain, move_link, observe};
pub use self::plants::{PlantStore, PlantStoreError, Refusal, init_plants};
pub use self::spec::{PlantLinks, config_hash, link_id, link_of, links, member};
pub(crate) use self::spec::{hosts, is_serial};
pub use self::status::{FleetStatus, LinkStatus, MemberState, MemberStatus};

/// The member that is to own a link, of members with the same weight that all reach it.
#[must_use]
pub fn placed<'m>(link: &str, members: impl IntoIterator<Item = &'m str>) -> Option<&'m str> {
    let candidates = members.into_iter().map(|member| placement::Candidate { member, weight: 1, session: "" });
    placement::target(link, candidates).map(|chosen| chosen.member)
}

/// The fencing token of an ownership. Tokens of one link rise with each owner.
///
/// The creation time of the store is a part of it: revisions of a store that was deleted and made again do not
/// continue those before.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct LinkToken {
    /// The time at which the store was created, by the clock of its server: nanoseconds since 1970.
    pub store: u64,
    /// The revision of the entry of the link; 0 for a link that is pinned to this member.
    pub revision: u64,
}

impl LinkToken {
    /// The token of a link that is pinned to a member, and has no entry in the store.
    pub const PINNED: Self = Self { store: 0, revision: 0 };
}

impl fmt::Display for LinkToken {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.revision.fmt(f)
    }
}

/// The members that can reach a link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Reach {
    /// All members.
    All,
    /// The members with these ids.
    Only(Vec<Arc<str>>),
    /// One member, always: a serial port of its host. It is not leased, and needs no store.
    Pinned(Arc<str>),
}

/// A link that the fleet shares: that of a PLC, or of a bus.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkSpec {
    /// The id: the name of the PLC or of the bus.
    pub id: Arc<str>,
    /// The members that can reach it.
    pub reach: Reach,
}

/// A link that this member owns, until an [`Event::Close`] names it.
#[derive(Clone, Debug)]
pub struct Ownership {
    /// The id of the link.
    pub link: Arc<str>,
    /// The token of this ownership: the next one of the link has another.
    pub token: LinkToken,
    /// Checked before each write to the socket of the link.
    pub gate: Gate,
}

/// A link that this member must close. Its gate is closed already.
///
/// The link goes to another member only after [`closed`](Self::closed), so nothing of this member may be on its
/// wire by then. Dropping it says the same.
#[derive(Debug)]
pub struct Closing {
    /// The id of the link.
    pub link: Arc<str>,
    /// The token of the ownership that ends.
    pub token: LinkToken,
    /// `true` if it is not handed over: the store did not answer in time, and perhaps no member gets it soon.
    pub is_lost: bool,
    done: Option<oneshot::Sender<()>>,
}

impl Closing {
    /// Tells the fleet that the link is closed: no request is on its wire, and none will be sent.
    pub fn closed(mut self) {
        if let Some(done) = self.done.take() {
            // Without the fleet, nothing waits for it.
            let _ = done.send(());
        }
    }
}

/// A change of the links that this member owns.
#[derive(Debug)]
pub enum Event {
    /// It owns a link.
    Owned(Ownership),
    /// It must close a link that it owned.
    Close(Closing),
}
