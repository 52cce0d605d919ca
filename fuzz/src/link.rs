//! Drives a link, its callers and the PLCs by the input, in paused time.
//!
//! The link is compared with the model of `tests/model`.

use fatek::wire::Framing;

#[path = "../../tests/model/ear.rs"]
mod ear;
#[path = "../../tests/model/fit.rs"]
mod fit;
#[path = "../../tests/model/op.rs"]
mod op;
#[path = "../../tests/model/plc.rs"]
mod plc;
#[path = "../../tests/model/rest.rs"]
mod rest;
#[path = "../../tests/model/spec/mod.rs"]
mod spec;
#[path = "../../tests/model/state.rs"]
mod state;
#[path = "../../tests/model/wanted.rs"]
mod wanted;
#[path = "../../tests/model/witness.rs"]
mod witness;
#[path = "../../tests/model/world.rs"]
mod world;

/// Limit of steps: each takes as long as a whole input of another target.
const MAX_STEPS: usize = 64;

pub fn run(input: &[u8]) {
    let mut bytes = input.iter().copied();
    let framing = if bytes.next().unwrap_or_default() & 1 == 0 { Framing::Ascii } else { Framing::Binary };
    let ops: Vec<op::Op> = std::iter::from_fn(|| op::Op::from_bytes(&mut bytes)).take(MAX_STEPS).collect();
    if let Err(broken) = world::run(framing, u64::from(framing == Framing::Binary), &ops) {
        panic!("{broken}\n{ops:#?}");
    }
}
