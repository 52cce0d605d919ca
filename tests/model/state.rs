//! Events that the model is told, and the state that it keeps.

use fatek::wire::Framing;

pub(crate) use super::spec::station::Station;
use super::witness::Mark;

pub(crate) type Micros = u64;
pub(crate) type Id = usize;

/// The link's settings.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rules {
    pub(crate) framing: Framing,
    /// The response timeout where a call has no other.
    pub(crate) timeout: Micros,
    /// How long a line may take to settle after something spoilt.
    pub(crate) settle: Micros,
    pub(crate) offline_after: u32,
    pub(crate) probe_interval: (Micros, Micros),
    /// The pause after a probe, in times of what it took.
    pub(crate) probe_pause: u64,
    pub(crate) queue: usize,
    /// The longest pause before connecting again.
    pub(crate) backoff: Micros,
    /// The shortest silence after which no duplicate of a taken reply comes.
    pub(crate) window: Micros,
    /// The shortest silence that replaces a check.
    pub(crate) quiet: Micros,
}

#[derive(Clone, Debug)]
pub(crate) struct Call {
    pub(crate) station: u8,
    /// 0 control, 1 write, 2 read: that is the order, and calls of one keep theirs.
    pub(crate) lane: usize,
    pub(crate) sort: Sort,
    /// Requests that ask for the same; the first is the plain one.
    pub(crate) spellings: Vec<Spelling>,
    /// The number of registers that it gets.
    pub(crate) words: usize,
    pub(crate) retries: u32,
    pub(crate) timeout: Micros,
    pub(crate) deadline: Micros,
}

/// What the rule of "in step" makes of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sort {
    /// Writes and control commands: sent only if nothing owed could answer.
    Once,
    /// A read of live data.
    Read,
    /// A page of a program.
    Page,
}

#[derive(Clone, Debug)]
pub(crate) struct Spelling {
    pub(crate) request: Vec<u8>,
    /// A register that the call does not ask for.
    pub(crate) extra: Option<u16>,
    /// That one is the first of those that are named.
    pub(crate) before: bool,
    /// Registers of which a reply shows that the station has them.
    pub(crate) shows: Vec<u16>,
}

/// Result of a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum End {
    /// With these registers; none for a write or a control command.
    Done(Vec<u16>),
    Refused {
        code: u8,
        repeated: bool,
    },
    Timeout {
        sent: bool,
    },
    BadReply {
        sent: bool,
    },
    Offline {
        sent: bool,
    },
    Disconnected {
        sent: bool,
    },
    OutOfStep {
        sent: bool,
    },
    NotConnected,
    QueueFull,
}

#[derive(Clone, Debug)]
pub(crate) enum Event {
    Called(Id, Call),
    Cancelled(Id),
    Ended(Id, End),
    Connecting,
    Connected,
    NotConnected,
    Lost,
    /// The link wrote this.
    Wrote(Vec<u8>),
    /// The link was writing this when the connection was lost.
    WroteInVain(Vec<u8>),
    /// The link was to read this; each byte has the mark of its frame.
    Read(Vec<u8>, Vec<Option<Mark>>),
}

#[derive(Debug)]
pub(crate) struct State {
    pub(crate) call: Call,
    pub(crate) retries_left: u32,
    /// Sendings that count for the PLC: one whose spelling alone was refused does not.
    pub(crate) sends: u32,
    pub(crate) was_sent: bool,
    /// A reply without proof was followed by another attempt that is no retry.
    pub(crate) asked_again: bool,
    /// Another spelling was refused.
    pub(crate) plain: bool,
    /// Its station had to be silent since it was sent last.
    pub(crate) doubted: bool,
    /// What it must end with, and has not yet.
    pub(crate) due: Option<End>,
    pub(crate) over: bool,
}

#[derive(Debug)]
pub(crate) struct Wire {
    pub(crate) goal: Goal,
    pub(crate) station: u8,
    /// The call that is on the wire or waits for what is.
    pub(crate) call: Option<Id>,
    /// Its spelling.
    pub(crate) spelling: usize,
    pub(crate) request: Vec<u8>,
    pub(crate) command: u8,
    pub(crate) data: Vec<u8>,
    pub(crate) sent: Micros,
    pub(crate) give_up: Micros,
    /// As far as the deadline can move while a frame comes in.
    pub(crate) limit: Micros,
    /// Whether the station has its whole response timeout.
    pub(crate) whole: bool,
    pub(crate) fault: bool,
    pub(crate) echoed: bool,
    pub(crate) noise: usize,
    /// The reply, until the whole read that it came in is understood.
    pub(crate) held: Option<Held>,
    /// Behind the reply stood another frame of the station that is no copy of it.
    pub(crate) followed: bool,
}

/// A frame that fits the request on the wire.
#[derive(Clone, Debug)]
pub(crate) struct Held {
    pub(crate) data: Vec<u8>,
    pub(crate) answer: Result<Vec<u16>, u8>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Goal {
    Call,
    Check,
    /// A status request, to learn whether the line echoes.
    Learn,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Echo {
    Absent,
    Present,
    Unknown,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Probe {
    pub(crate) at: Micros,
    pub(crate) interval: Micros,
}
