//! The state of the fleet, as one member sees it: for `fleet status`, the page and the metrics.

use std::sync::Arc;
use std::time::Duration;

use super::LinkToken;

/// The state of the fleet, as one member sees it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FleetStatus {
    /// The id of this member.
    pub id: Arc<str>,
    /// The state of this member.
    pub state: MemberState,
    /// The time until its gates close, if they are open.
    pub open_for: Option<Duration>,
    /// All members, in the order of their ids, this one included.
    pub members: Vec<MemberStatus>,
    /// All links of the configuration, in the order of their ids.
    pub links: Vec<LinkStatus>,
    /// The faults that an operator should know: members with other configurations, two processes of one id.
    pub warnings: Vec<String>,
}

impl FleetStatus {
    /// The state of a link of the configuration.
    #[must_use]
    pub fn link(&self, id: &str) -> Option<&LinkStatus> {
        let at = self.links.binary_search_by(|link| (*link.link).cmp(id)).ok()?;
        self.links.get(at)
    }
}

/// The state of this member.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub enum MemberState {
    /// It has no connection to the store, or reads its content.
    #[default]
    Connecting,
    /// It makes its session.
    Joining,
    /// It has a session.
    Active,
    /// It gives its links to other members, and takes none.
    Draining,
    /// It has left.
    Left,
    /// It has stopped for good: the store was deleted or set back.
    Failed(String),
}

/// A member of the fleet.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemberStatus {
    /// Its id.
    pub id: Arc<str>,
    /// Its session.
    pub session: Arc<str>,
    /// Its version of the program.
    pub version: String,
    /// The hash of its configuration.
    pub config: String,
    /// Its share in comparison with the others.
    pub weight: u32,
    /// `true` if it gives its links to other members.
    pub is_draining: bool,
    /// Its lease.
    pub lease: Duration,
    /// The time since its session was last seen to be renewed: more than a third of a lease is a delay.
    pub silent_for: Duration,
    /// The number of links that it owns.
    pub links: usize,
}

impl MemberStatus {
    /// Returns whether its last sign of life is older than its lease: it is fenced within another one.
    #[must_use]
    pub fn is_silent(&self) -> bool {
        self.silent_for > self.lease
    }
}

/// A link of the configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinkStatus {
    /// Its id.
    pub link: Arc<str>,
    /// The id of the member that owns it.
    pub owner: Option<Arc<str>>,
    /// The token of the owner.
    pub token: LinkToken,
    /// The time since this member saw the owner take it. The true time is longer if the owner had it before.
    pub owned_for: Duration,
    /// The id of the member that is to own it.
    pub target: Option<Arc<str>>,
}
