//! The data that the core and its driver exchange.

use std::sync::Arc;

#[cfg(doc)]
use super::Core;
use crate::fleet::{LinkSpec, LinkToken};

/// A time of `CLOCK_BOOTTIME`, or a duration, in nanoseconds.
pub(in crate::fleet) type Nanos = u64;

/// The settings of a member that do not change.
#[derive(Clone, Debug)]
pub(in crate::fleet) struct Settings {
    /// The lease `L`.
    pub(in crate::fleet) lease: Nanos,
    /// A name that no other process has had: sessions are named after it.
    pub(in crate::fleet) process: String,
    /// The requests for links that are in flight at once.
    pub(in crate::fleet) max_requests: usize,
}

/// The data of a member that all others see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Member {
    /// Its id: the name of its host, unless it was given another. No other member has it.
    pub id: Arc<str>,
    /// Its version of the program.
    pub version: String,
    /// The hash of its configuration. Links are shared among members with the same one.
    pub config: String,
    /// Its share in comparison with the others.
    pub weight: u32,
}

/// An event for the core.
#[derive(Clone, Debug)]
pub(in crate::fleet) enum Input {
    /// A connection is open. The entries of a new watch follow. The revision is the last one of the store, and was
    /// read before the watch began.
    Connected { created: u64, last_revision: u64 },
    /// An entry of the watch; without a value it was deleted. Entries come in the order of their revisions.
    Entry { key: String, value: Option<String>, revision: u64 },
    /// The watch has delivered all entries that were there when it began.
    Complete,
    /// The connection or its watch was lost: replies that are missing will not come.
    Disconnected,
    /// The server says that there is no store.
    StoreMissing,
    /// The result of a request.
    Reply { request: u64, outcome: Outcome },
    /// A link is closed, after [`Action::Close`].
    Closed { link: Arc<str>, token: LinkToken },
    /// The configuration: at first, and when it changes.
    Configure { member: Member, links: Vec<LinkSpec> },
    /// The member is to leave.
    Leave,
    /// The time has come.
    Tick,
}

/// The result of a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::fleet) enum Outcome {
    /// It was stored as this revision.
    Stored(u64),
    /// It was not stored, since the entry has another revision.
    WrongRevision,
    /// The entry that was read.
    Found { value: Option<String>, revision: u64 },
    /// There is no such entry.
    Missing,
    /// The entries were removed.
    Purged,
    /// A timeout or an error: it may have been stored, and may still be.
    Unknown,
}

/// A request to the store.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::fleet) enum Operation {
    /// Stores a value if the entry has this revision; 0: if there is none.
    Put { key: String, value: String, expected: u64 },
    /// Reads an entry, from the leader of the stream.
    Get { key: String },
    /// Removes the entries of a key up to this revision.
    Purge { key: String, revision: u64 },
}

/// An action for the driver.
#[derive(Clone, Debug, PartialEq)]
pub(in crate::fleet) enum Action {
    /// Send a request. Without a reply within this time its outcome is [`Outcome::Unknown`].
    Request { request: u64, operation: Operation, timeout: Nanos },
    /// The gates of a session are open until this time; 0: closed for good, if the session has ended.
    Gate { session: Arc<str>, until: Nanos },
    /// This member owns a link, with the gate of this session; without one the link is pinned.
    Own { link: Arc<str>, token: LinkToken, session: Option<Arc<str>> },
    /// Revoke the gate of the link, close it, and report [`Input::Closed`].
    Close { link: Arc<str>, token: LinkToken },
    /// Drop the connection and open another: the view is in doubt.
    Reconnect,
    /// Something that an operator should know.
    Warn(String),
    /// The member has stopped for good.
    Fail(StoreFault),
    /// The member has left.
    Left,
}

/// A store that the fleet must not use any more.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum StoreFault {
    /// It was deleted and made again.
    #[error(
        "the store was deleted and made again (now created {now}, before {before}): this bridge has stopped, so \
         that no PLC gets two masters. Start it again if that was intended"
    )]
    Recreated {
        /// Its creation time as seen at first, in nanoseconds since 1970.
        before: u64,
        /// Its creation time now.
        now: u64,
    },
    /// It was set back to an older state.
    #[error(
        "the store was set back: {what} has revision {now}, and {before} was seen before: this bridge has stopped, \
         so that no PLC gets two masters. Start it again if that was intended"
    )]
    SetBack {
        /// The key, or the store.
        what: String,
        /// The revision that was seen before.
        before: u64,
        /// The revision now; 0: the entry is gone.
        now: u64,
    },
}
