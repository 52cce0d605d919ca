//! ASCII decoder, with the invariants of [`codec`](crate::codec).

use fatek::wire::Framing;

pub fn run(input: &[u8]) {
    crate::codec::run(Framing::Ascii, input);
}
