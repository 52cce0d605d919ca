//! Compares a link with the model of `tests/model`: the input is a sequence of steps for the link,
//! its callers and the other end of its line, in paused time.

use fatek::wire::Framing;

#[path = "../../tests/model/calls.rs"]
mod calls;
#[path = "../../tests/model/decoder.rs"]
mod decoder;
#[path = "../../tests/model/harness.rs"]
mod harness;
#[path = "../../tests/model/idle.rs"]
mod idle;
#[path = "../../tests/model/op.rs"]
mod op;
#[path = "../../tests/model/oracle.rs"]
mod oracle;
#[path = "../../tests/model/plc.rs"]
mod plc;
#[path = "../../tests/model/replies.rs"]
mod replies;
#[path = "../../tests/model/spec/mod.rs"]
mod spec;
#[path = "../../tests/model/state.rs"]
mod state;

/// Enough for long sequences. More would be slow: a step costs as much as a whole input of another
/// target.
const MAX_STEPS: usize = 64;

pub fn run(input: &[u8]) {
    let mut bytes = input.iter().copied();
    let framing = if bytes.next().unwrap_or_default() & 1 == 0 { Framing::Ascii } else { Framing::Binary };
    let ops: Vec<op::Op> = std::iter::from_fn(|| op::Op::from_bytes(&mut bytes)).take(MAX_STEPS).collect();
    if let Err(broken) = harness::run(framing, u64::from(framing == Framing::Binary), &ops) {
        panic!("{broken}\n{ops:#?}");
    }
}
