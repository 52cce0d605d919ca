//! Elements of the PLCs and their content.

use fatek::command::ProgramPage;
use fatek::{Discrete, Register, Register32, Symbol};

/// Content of a register D of a station.
pub(crate) fn word(station: u16, address: u16) -> u16 {
    1000 * station + address
}

/// Content of three registers D of station 1.
pub(crate) fn words(first: u16) -> [u16; 3] {
    [0, 1, 2].map(|n| word(1, first + n))
}

pub(crate) fn double(first: u16) -> u32 {
    u32::from(word(1, first)) | u32::from(word(1, first + 1)) << 16
}

pub(crate) fn page(n: u16) -> ProgramPage {
    ProgramPage::new([n; 64])
}

pub(crate) fn d(address: u16) -> Register {
    Register::d(address)
}

pub(crate) fn dd(address: u16) -> Register32 {
    d(address).widened().unwrap()
}

pub(crate) fn r(address: u16) -> Register {
    Register::r(address)
}

pub(crate) fn dr(address: u16) -> Register32 {
    r(address).widened().unwrap()
}

pub(crate) fn m(address: u16) -> Discrete {
    Discrete::new(Symbol::M, address).unwrap()
}

pub(crate) fn x(address: u16) -> Discrete {
    Discrete::new(Symbol::X, address).unwrap()
}
