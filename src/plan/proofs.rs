//! The proofs of a plan: the exchanges, and the longer requests, by which a link makes sure that no
//! reply is taken for another request's.
//!
//! A duplicate of a reply comes before the reply to the next request. So a link never sends a request
//! whose reply has the command and the length of the reply before it. It sends the elements of a run
//! as a mixed read (48) where that takes less time than a loop-back without data (4E), and such a
//! loop-back before the request otherwise. A job of several requests ends with a loop-back with a
//! nonce, unless the last reply differs from all others.

use super::cost::CostModel;
use super::layout::Draft;
use super::limits::Limits;
use crate::command::{Code, LoopBack};
use crate::link::Prices;

/// The shape of a reply, by which a link tells it from others: the command, and the length.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub(super) struct ReplyShape {
    code: Code,
    bytes: usize,
}

impl ReplyShape {
    pub(super) fn of(draft: &Draft, cost: &CostModel) -> Self {
        let (_, bytes) = draft.bytes(cost);
        Self { code: draft.code(), bytes }
    }
}

/// A request, as far as its proof needs it.
#[derive(Clone, Copy, Debug)]
pub(super) struct Exchange {
    pub(super) shape: ReplyShape,
    /// The nanoseconds that a mixed read of the elements of this run takes more. `None` if the link
    /// sends a check instead.
    other: Option<u64>,
}

impl Exchange {
    pub(super) fn of(draft: &Draft, limits: &Limits, cost: &CostModel) -> Self {
        Self { shape: ReplyShape::of(draft, cost), other: other_spelling(draft, limits, cost) }
    }

    /// A request of which no other one has the shape, so that its other spelling is not needed.
    pub(super) fn distinct(shape: ReplyShape) -> Self {
        Self { shape, other: None }
    }

    /// The price of the other spelling, and the shape of its reply.
    pub(super) fn other(&self) -> Option<(u64, ReplyShape)> {
        let shape = ReplyShape { code: Code::ReadMixed, ..self.shape };
        self.other.map(|price| (price, shape))
    }

    /// Returns the price of its proof behind a reply of the shape `last`, and the shape of its reply.
    pub(super) fn behind(&self, last: Option<ReplyShape>, prices: ProofPrices) -> (u64, ReplyShape) {
        if last != Some(self.shape) {
            return (0, self.shape);
        }
        self.other().unwrap_or((prices.separator, self.shape))
    }
}

/// Returns the nanoseconds that the other spelling of a run takes more, if the link uses it.
///
/// The link has other spellings with an element more, which depend on what the PLC has answered
/// before. They are not counted.
fn other_spelling(draft: &Draft, limits: &Limits, cost: &CostModel) -> Option<u64> {
    if !cost.proofs() || draft.run_units()? > limits.mixed_units() {
        return None;
    }
    let request = draft.request().ok()?;
    let candidate = request.as_mixed_read(cost.framing())?;
    let prices = Prices::new(cost.framing(), cost.byte_time(), cost.frame_gap());
    prices.is_below_an_exchange(&candidate, request.plain()).then(|| cost.bytes_cost(candidate.more_bytes))
}

/// The prices of checks in nanoseconds.
#[derive(Clone, Copy, Debug)]
pub(super) struct ProofPrices {
    /// A loop-back without data between two requests.
    separator: u64,
    /// A loop-back with a nonce at the end of a job.
    confirmation: u64,
}

impl ProofPrices {
    pub(super) fn new(cost: &CostModel) -> Self {
        let nonce = LoopBack::nonce(0).data().len();
        let check =
            |data: usize| if cost.proofs() { cost.cost(2 * (cost.framing().frame_overhead() + data)) } else { 0 };
        Self { separator: check(0), confirmation: check(nonce) }
    }

    /// Returns the price of the end of a job whose last reply has this shape.
    pub(super) fn end(self, has_shape_of_another: bool) -> u64 {
        if has_shape_of_another { self.confirmation } else { 0 }
    }
}
