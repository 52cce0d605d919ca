//! Terms of the rule.

use std::time::Duration;

use tokio::time::Instant;

use crate::command::{Candidate, Candidates, Code, CommandSet, Spelling};
use crate::endpoint::InStepSettings;
use crate::link::nanoseconds;
use crate::wire::Framing;

/// The shape of a positive reply. A refusal fits every size of its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Shape {
    pub(crate) code: Code,
    /// See [`Command::reply_size`](crate::command::Command).
    pub(crate) size: u32,
}

/// The size of a stray, which may fit any size.
pub(super) const ANY_SIZE: u32 = u32::MAX;

/// The declared capabilities of a station, as far as the rule needs them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Declared {
    /// The commands that are refused.
    pub(crate) refused: CommandSet,
    /// The commands that are not answered.
    pub(crate) unanswered: CommandSet,
    pub(crate) longest: LongestReads,
}

/// The longest reads that a station accepts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct LongestReads {
    pub(crate) registers: u16,
    pub(crate) points: u16,
    pub(crate) mixed: u16,
}

impl LongestReads {
    /// No limits below those of the protocol.
    pub(crate) const ANY: Self = Self { registers: u16::MAX, points: u16::MAX, mixed: u16::MAX };

    /// Returns whether a spelling is as short as the station needs it.
    pub(super) fn allows(self, candidate: &Candidate) -> bool {
        let most = match candidate.spelling.code {
            Code::ReadRegisters => self.registers,
            Code::ReadDisabled | Code::ReadDiscretes => self.points,
            Code::ReadMixed => self.mixed,
            Code::ReadStatus
            | Code::ControlPlc
            | Code::ControlDiscrete
            | Code::WriteDiscretes
            | Code::WriteRegisters
            | Code::WriteMixed
            | Code::LoopBack
            | Code::ReadProgramPage
            | Code::WriteProgramPage
            | Code::ReadDetailedStatus => u16::MAX,
        };
        candidate.units <= most
    }
}

/// How the rule treats a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Kind {
    /// A read: it can be sent again.
    Read,
    /// A read of a program page: a page that differs from the one before it is proven.
    Page,
    /// A request that is sent only if no owed frame of any sort could answer it.
    Once,
}

/// A request, as far as the rule needs it.
pub(crate) trait Spelled {
    fn kind(&self) -> Kind;
    fn plain(&self) -> Spelling;
    /// The other spellings.
    fn candidates(&self) -> Candidates;
    /// Shape of the positive reply to a spelling.
    fn shape(&self, spelling: Spelling) -> Shape;
}

/// A reply that fits the request on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reply {
    /// Shape of the positive reply to the request.
    pub(crate) shape: Shape,
    pub(crate) refused: bool,
    /// The [`fingerprint`](crate::wire::fingerprint) of the frame.
    pub(crate) fingerprint: u64,
}

/// The next transmission for a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Choice {
    /// The request, in this spelling.
    Send(Spelling),
    /// A request of the link itself, before it.
    Check(Check, Why),
    /// Nothing before this time; a frame of the station restarts the silence.
    Silence(Instant),
}

/// A request of the link itself that separates two requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Check {
    /// 4E with a nonce. Its echo always proves.
    Nonce,
    /// 4E without data: in step, any distinct exchange separates.
    Empty,
    /// 40, where 4E was refused without proof.
    Status,
    /// 53, where 4E was refused without proof and 40 is owed.
    Detail,
}

/// Why a check is sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Why {
    /// The connection is new.
    Connected,
    /// A request was not answered in time.
    TimedOut,
    /// A frame came that no request takes.
    Stray,
    /// A reply came without proof.
    Unproven,
    /// No spelling of the request is distinct from what is owed.
    Owed,
    /// A job ends, or a station is probed.
    Confirm,
}

/// The kind of a frame that no request takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Stray {
    /// A duplicate of the reply taken last.
    Duplicate,
    /// The reply to a request that had timed out.
    Late,
    /// An answer to a broadcast.
    Broadcast,
    /// None of these.
    Unexpected,
}

/// Counters of a station's proofs and doubts so far: see [`Job`](super::job::Job).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Proof {
    /// Number of proofs: echoes of checks, and silences of the quiet time.
    pub(crate) proofs: u32,
    /// Number of unexpected strays.
    pub(crate) doubts: u32,
}

/// The rule's settings, and the figures that it needs now.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rule {
    pub(crate) settings: InStepSettings,
    /// The silence that replaces a check.
    pub(crate) quiet: Duration,
    /// The connection carries one request only, so silence replaces every check.
    pub(crate) one_request: bool,
    pub(crate) prices: Prices,
    /// The time that the line has been busy so far.
    pub(crate) busy: Duration,
}

/// The part of an exchange that is not transmission, for comparing prices: half a scan of a PLC.
const ASSUMED_RESPONSE_TIME: Duration = Duration::from_millis(5);

/// Prices of what separates two requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Prices {
    /// Transmission time of a byte.
    pub(crate) byte: Duration,
    /// Time of an exchange without data.
    pub(crate) exchange: Duration,
}

impl Check {
    pub(crate) const EMPTY: Shape = Shape { code: Code::LoopBack, size: 0 };
    pub(crate) const STATUS: Shape = Shape { code: Code::ReadStatus, size: 0 };
    pub(crate) const DETAIL: Shape = Shape { code: Code::ReadDetailedStatus, size: 0 };

    /// The checks in place of 4E, the first one first.
    pub(super) const IN_PLACE: [(Self, Shape); 2] = [(Self::Status, Self::STATUS), (Self::Detail, Self::DETAIL)];
}

impl Prices {
    /// The prices on a line with this time per byte and this silence between a reply and a request.
    pub(crate) fn new(framing: Framing, byte: Duration, frame_gap: Duration) -> Self {
        let bytes = u32::try_from(framing.frame_overhead()).unwrap_or(u32::MAX);
        let frames = byte.saturating_mul(2).saturating_mul(bytes);
        Self { byte, exchange: frames.saturating_add(ASSUMED_RESPONSE_TIME).saturating_add(frame_gap) }
    }

    /// Returns whether a spelling takes less time in addition than a loop-back before the plain one.
    pub(crate) fn is_below_an_exchange(&self, candidate: &Candidate, plain: Spelling) -> bool {
        self.of(candidate, plain) < self.exchange
    }

    /// Transmission time of this many bytes. A count of 32 bits would be full within days.
    pub(crate) fn line_time(&self, bytes: u64) -> Duration {
        Duration::from_nanos(nanoseconds(self.byte).saturating_mul(bytes))
    }

    pub(super) fn of(&self, candidate: &Candidate, plain: Spelling) -> Duration {
        let bytes = self.byte.saturating_mul(u32::try_from(candidate.more_bytes).unwrap_or(u32::MAX));
        // The elements left over take their part of another exchange.
        let rest = self.exchange.saturating_mul(candidate.left.into()).checked_div(u32::from(plain.count.max(1)));
        bytes.saturating_add(rest.unwrap_or_default())
    }
}
