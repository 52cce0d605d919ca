//! The binary decoder, on both sides: [`codec`](crate::codec) says what must hold.

use fatek::wire::Framing;

pub fn run(input: &[u8]) {
    crate::codec::run(Framing::Binary, input);
}
