//! What the model is told, and what it keeps of it.

use fatek::wire::Framing;

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
}

#[derive(Clone, Debug)]
pub(crate) struct Call {
    pub(crate) station: u8,
    /// 0 control, 1 write, 2 read: that is the order, and calls of one keep theirs.
    pub(crate) lane: usize,
    pub(crate) request: Vec<u8>,
    pub(crate) retries: u32,
    pub(crate) timeout: Micros,
    pub(crate) deadline: Micros,
}

/// What a call ends with.
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
    /// The link was to read this.
    Read(Vec<u8>),
}

#[derive(Debug)]
pub(crate) struct State {
    pub(crate) call: Call,
    pub(crate) retries_left: u32,
    pub(crate) sends: u32,
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
    pub(crate) doubtful: bool,
    pub(crate) echoed: bool,
    pub(crate) noise: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Goal {
    Call,
    Barrier,
    /// A status request, to learn whether the line echoes.
    Learn,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Echo {
    Absent,
    Present,
    Unknown,
}

#[derive(Debug, Default)]
pub(crate) struct Station {
    pub(crate) dirty: bool,
    /// When it refused the barrier, or sent anything after that.
    pub(crate) refused: Option<Micros>,
    pub(crate) timeouts: u32,
    pub(crate) offline: Option<Probe>,
    /// The longest response timeout that it was ever given.
    pub(crate) allowed: Micros,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct Probe {
    pub(crate) at: Micros,
    pub(crate) interval: Micros,
}
