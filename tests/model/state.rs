//! Events of a run, and the terms of the rules.

use fatek::wire::Framing;

use super::oracle::Mark;
pub(crate) use super::spec::station::Station;
use super::spec::station::Strays;

pub(crate) type Micros = u64;
pub(crate) type Id = usize;

/// The link's settings.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LinkSettings {
    pub(crate) framing: Framing,
    /// Default response timeout.
    pub(crate) timeout: Micros,
    /// Settling time of the line after corrupt bytes.
    pub(crate) settle: Micros,
    /// Time to wait for the next byte of a frame, and for its end, after the response timeout.
    pub(crate) byte_timeout: Micros,
    pub(crate) slow_frame: Micros,
    pub(crate) offline_after: u32,
    pub(crate) probe_interval: (Micros, Micros),
    /// Pause after a probe, as a multiple of its duration.
    pub(crate) probe_pause: u64,
    pub(crate) queue: usize,
    /// Longest back-off before a connection attempt.
    pub(crate) backoff: Micros,
    /// Minimum copy window: silence after which no copy of a taken reply arrives.
    pub(crate) window: Micros,
    /// Minimum quiet time: silence that replaces a check.
    pub(crate) quiet: Micros,
    /// Mute timeout: silence of all stations after which a connection is replaced.
    pub(crate) mute: Micros,
}

#[derive(Clone, Debug)]
pub(crate) struct Call {
    pub(crate) station: u8,
    /// 0 control, 1 write, 2 read, in order of priority. Calls of a lane keep their order.
    pub(crate) lane: usize,
    pub(crate) class: CallClass,
    /// Equivalent requests; the first is the plain one.
    pub(crate) spellings: Vec<Spelling>,
    /// Number of registers in the result.
    pub(crate) words: usize,
    pub(crate) retries: u32,
    /// Number of retries of a check before the request, beyond those of the request.
    pub(crate) check_retries: u32,
    pub(crate) timeout: Micros,
    pub(crate) deadline: Micros,
}

/// How the rule of "in step" treats a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CallClass {
    /// Writes and control commands: sent only if no owed reply could match.
    Write,
    /// Reads of live data.
    Read,
    /// Reads of a program page.
    Page,
}

#[derive(Clone, Debug)]
pub(crate) struct Spelling {
    pub(crate) request: Vec<u8>,
    /// An extra register that is not part of the call.
    pub(crate) extra: Option<u16>,
    /// The extra register is the first one of the request.
    pub(crate) before: bool,
    /// Registers that exist if the reply is positive.
    pub(crate) shows: Vec<u16>,
}

/// Result of a call.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum CallResult {
    /// Success with these registers; empty for writes and control commands.
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
    NotConnected {
        sent: bool,
    },
    QueueFull,
}

#[derive(Clone, Debug)]
pub(crate) enum Event {
    Called(Id, Call),
    Cancelled(Id),
    Ended(Id, CallResult),
    Connecting,
    Connected,
    NotConnected,
    Lost,
    /// The link has dropped its stream.
    Dropped,
    /// The link wrote a request.
    Wrote(Vec<u8>),
    /// The link wrote a request when the connection was lost.
    WroteInVain(Vec<u8>),
    /// The link read bytes, each with the mark of its frame.
    Read(Vec<u8>, Vec<Option<Mark>>),
}

#[derive(Debug)]
pub(crate) struct CallState {
    pub(crate) call: Call,
    pub(crate) retries_left: u32,
    pub(crate) check_retries_left: u32,
    pub(crate) called_at: Micros,
    /// `true` if frames came instead of the reply when the request itself was first unanswered.
    pub(crate) cause: Option<bool>,
    /// Number of requests sent, without those whose spelling was refused.
    pub(crate) sends: u32,
    pub(crate) was_sent: bool,
    /// A reply without proof has led to an extra attempt that is no retry.
    pub(crate) extra_attempt: bool,
    /// A spelling was refused, so only the plain one may be sent.
    pub(crate) plain_only: bool,
    /// The station's strays when the spelling of a write was refused, until it is sent again.
    pub(crate) refused_at: Option<Strays>,
    /// The call has waited for silence of its station since it was last sent.
    pub(crate) waited_for_silence: bool,
    /// The result that the call must end with, once it is decided.
    pub(crate) due: Option<CallResult>,
    pub(crate) ended: bool,
}

#[derive(Debug)]
pub(crate) struct InFlight {
    pub(crate) purpose: Purpose,
    pub(crate) station: u8,
    /// The call of this request, or the one that waits for this check.
    pub(crate) call: Option<Id>,
    /// Index of the spelling.
    pub(crate) spelling: usize,
    pub(crate) request: Vec<u8>,
    pub(crate) command: u8,
    pub(crate) data: Vec<u8>,
    pub(crate) sent: Micros,
    pub(crate) give_up: Micros,
    /// Latest timeout that a frame in progress can cause.
    pub(crate) limit: Micros,
    pub(crate) bad_reply: bool,
    pub(crate) echoed: bool,
    pub(crate) noise: usize,
    /// The reply, until the whole read that contained it is processed.
    pub(crate) held: Option<HeldReply>,
    /// Another frame of the station, no copy of the reply, came after it.
    pub(crate) followed_by_other: bool,
}

/// A frame that matches the request in flight.
#[derive(Clone, Debug)]
pub(crate) struct HeldReply {
    pub(crate) data: Vec<u8>,
    pub(crate) answer: Result<Vec<u16>, u8>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Purpose {
    Call,
    Check,
    /// A status request that shows whether the line echoes.
    LearnEcho,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LineEcho {
    Absent,
    Present,
    Unknown,
}

#[derive(Clone, Copy, Debug)]
pub(crate) struct ProbeTimer {
    pub(crate) at: Micros,
    pub(crate) interval: Micros,
}
