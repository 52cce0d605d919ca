//! Content of the simulated PLCs, and the requests that they refuse.

use fatek::command::{PAGE_WORDS, ProgramPage};
use fatek::program::Program;
use fatek::sim::{Model, Plc};
use fatek::{Discrete, ErrorCode, Register, Symbol};

use crate::rng::Rng;

/// Error code of addresses that are always refused.
pub(crate) const REFUSED: ErrorCode = ErrorCode::IllegalAddress;
/// Error code of unsupported commands.
pub(crate) const UNKNOWN_COMMAND: ErrorCode = ErrorCode::IllegalFormat;
/// Error code of refused RUN commands.
pub(crate) const RUN_REFUSED: ErrorCode = ErrorCode::Syntax;
/// Error code of injected refusals of reads and writes.
pub(crate) const INJECTED: ErrorCode = ErrorCode::IllegalValue;
/// Error code of second answers and answers to broadcasts. It is right for no request.
pub(crate) const SECOND: ErrorCode = ErrorCode::NotSupported;

/// R0 to R2999 hold their station and address. R3000 to R3199 cannot be read.
pub(crate) const READABLE: u16 = 3000;
pub(crate) const UNREADABLE: u16 = 200;
/// M0 to M1999 depend on station and address.
pub(crate) const DISCRETES: u16 = 2000;
/// D0 to D1999 are written. D2000 to D2199 cannot be written. D2500 to D2899 are restored.
pub(crate) const WRITABLE: u16 = 2000;
pub(crate) const UNWRITABLE: u16 = 200;
pub(crate) const RESTORED: (u16, u16) = (2500, 400);
/// Size of the ladder program, in words.
pub(crate) const LADDER_WORDS: u16 = 1024;
/// Station that refuses RUN.
pub(crate) const NO_RUN: u8 = 2;

pub(crate) fn word(station: u8, address: u16) -> u16 {
    u16::from(station) << 12 | address
}

pub(crate) fn dword(station: u8, address: u16) -> u32 {
    u32::from(word(station, address + 1)) << 16 | u32::from(word(station, address))
}

pub(crate) fn bit(station: u8, address: u16) -> bool {
    Rng(u64::from(station) << 16 | u64::from(address)).percent(50)
}

pub(crate) fn r(address: u16) -> Register {
    Register::r(address)
}

pub(crate) fn d(address: u16) -> Register {
    Register::new(Symbol::D, address).unwrap()
}

pub(crate) fn m(address: u16) -> Discrete {
    Discrete::new(Symbol::M, address).unwrap()
}

pub(crate) fn plc(station: u8) -> Plc {
    let plc = Plc::with_model(Model::largest().ladder_words(LADDER_WORDS));
    // One register more than is read: the upper word of the last pair.
    for address in 0..=READABLE {
        plc.write(r(address), word(station, address)).unwrap();
    }
    for address in 0..DISCRETES {
        plc.write(m(address), bit(station, address)).unwrap();
    }
    plc.refuse_run((station == NO_RUN).then_some(RUN_REFUSED));
    plc
}

/// A random program. In 30 % of the programs, runs of pages are equal.
pub(crate) fn program(rng: &mut Rng) -> Program {
    let mut header = [0xFF; 2 * PAGE_WORDS];
    header[..4].copy_from_slice(b"FB00");
    header[4..6].copy_from_slice(&LADDER_WORDS.to_be_bytes());
    let mut pages = vec![ProgramPage::from_bytes(&header)];
    let equal = rng.percent(30);
    for page in 1..=LADDER_WORDS.div_ceil(64) {
        match pages.last().filter(|_| equal && page % 8 != 1) {
            Some(last) => pages.push(last.clone()),
            None => pages.push(ProgramPage::new([0; PAGE_WORDS].map(|_: u16| rng.next() as u16))),
        }
    }
    Program::from_pages(pages).unwrap()
}

pub(crate) fn load(plc: &Plc, program: &Program) {
    (0..).zip(program.pages()).for_each(|(page, content)| plc.set_page(page, content.clone()).unwrap());
}
