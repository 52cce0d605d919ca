//! The terms of the rule.

use std::time::Duration;

use tokio::time::Instant;

use crate::command::{Candidate, Candidates, Code, Spelling};
use crate::endpoint::InStepSettings;

/// The shape of a positive reply. A refusal fits every size of its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Shape {
    pub(crate) code: Code,
    /// See [`Command::reply_size`](crate::command::Command).
    pub(crate) size: u32,
}

/// The size of a stray, which may fit any size.
pub(super) const ANY_SIZE: u32 = u32::MAX;

/// What a request is to the rule.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Kind {
    /// It can be asked again.
    Read,
    /// A read of a program page: a page that differs from the one before it is new.
    Page,
    /// It is sent only if no owed frame of any sort could answer it.
    Once,
}

/// A request, as far as the rule must know it.
pub(crate) trait Spelled {
    fn kind(&self) -> Kind;
    fn plain(&self) -> Spelling;
    /// The other spellings.
    fn candidates(&self) -> Candidates;
    /// The shape of the positive reply to a spelling.
    fn shape(&self, spelling: Spelling) -> Shape;
}

/// A reply that fits the request on the wire.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Reply {
    /// The shape that was asked for.
    pub(crate) shape: Shape,
    pub(crate) refused: bool,
    /// Of the frame: see [`fingerprint`].
    pub(crate) fingerprint: u64,
}

/// What goes out for a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Choice {
    /// The request, so spelt.
    Send(Spelling),
    /// A request of the link itself, before it.
    Check(Check, Why),
    /// Nothing before this time, nor ever if a frame comes from the station before.
    Silence(Instant),
}

/// What the link itself sends to separate two requests.
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

/// What a frame is that no request takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Stray {
    /// A copy of the reply that was taken last.
    Duplicate,
    /// An answer to a request that had timed out.
    Late,
    /// An answer to a broadcast.
    Broadcast,
    /// None of these.
    Unexpected,
}

/// A number for what was proven of a station so far: see [`Job`](super::job::Job).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct Proof {
    /// The number of proofs: echoes of checks, and silences of the quiet time.
    pub(crate) proofs: u32,
    /// The number of unexpected strays.
    pub(crate) doubts: u32,
}

/// The rule as it holds on a link.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Rule {
    pub(crate) settings: InStepSettings,
    /// The silence that replaces a check.
    pub(crate) quiet: Duration,
    /// The connection is for one request alone, so silence replaces every check.
    pub(crate) one_request: bool,
    pub(crate) prices: Prices,
    /// The time that the line has been busy so far.
    pub(crate) busy: Duration,
}

/// Prices of what separates two requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Prices {
    /// Time on the line of a byte.
    pub(crate) byte: Duration,
    /// Time of an exchange without data.
    pub(crate) exchange: Duration,
}

impl Check {
    pub(crate) const EMPTY: Shape = Shape { code: Code::LoopBack, size: 0 };
    pub(crate) const STATUS: Shape = Shape { code: Code::ReadStatus, size: 0 };
    pub(crate) const DETAIL: Shape = Shape { code: Code::ReadDetailedStatus, size: 0 };
}

impl Prices {
    /// Time on the line of this many bytes; a count of 32 bits would end within days.
    pub(crate) fn line_time(&self, bytes: u64) -> Duration {
        let byte = u64::try_from(self.byte.as_nanos()).unwrap_or(u64::MAX);
        Duration::from_nanos(byte.saturating_mul(bytes))
    }

    pub(super) fn of(&self, candidate: &Candidate, plain: Spelling) -> Duration {
        let bytes = self.byte.saturating_mul(u32::try_from(candidate.more_bytes).unwrap_or(u32::MAX));
        // What is left takes its part of another exchange.
        let rest = self.exchange.saturating_mul(candidate.left.into()).checked_div(u32::from(plain.count.max(1)));
        bytes.saturating_add(rest.unwrap_or_default())
    }
}

/// A number for the content of a frame: equal for equal frames, and for others hardly ever.
pub(crate) fn fingerprint(command: u8, data: &[u8]) -> u64 {
    const FACTOR: u64 = 0x9E37_79B9_7F4A_7C15;
    let (words, rest) = data.as_chunks::<8>();
    let mut last = [0; 8];
    last.iter_mut().zip(rest).for_each(|(place, &byte)| *place = byte);
    let seed = u64::from(command) << 32 | u64::try_from(data.len()).unwrap_or(u64::MAX);
    words.iter().chain([&last]).fold(seed.wrapping_mul(FACTOR), |hash, word| {
        (hash.rotate_left(23) ^ u64::from_le_bytes(*word)).wrapping_mul(FACTOR)
    })
}
