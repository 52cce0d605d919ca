//! The ASCII decoder: [`codec`](crate::codec) says what must hold.

use fatek::wire::Framing;

pub fn run(input: &[u8]) {
    crate::codec::run(Framing::Ascii, input);
}
