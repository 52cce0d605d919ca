//! What the simulated PLCs hold and refuse.

use fatek::command::{PAGE_WORDS, ProgramPage};
use fatek::program::Program;
use fatek::sim::{Model, Plc};
use fatek::{Discrete, Error, ErrorCode, Register, Symbol};

/// The refusal of addresses that are always refused.
pub(crate) const REFUSED: ErrorCode = ErrorCode::IllegalAddress;
/// The refusal of a command that the device does not know.
pub(crate) const UNKNOWN_COMMAND: ErrorCode = ErrorCode::IllegalFormat;
/// The refusal of RUN.
pub(crate) const RUN_REFUSED: ErrorCode = ErrorCode::Syntax;
/// The refusal of any read or write of registers, at random.
pub(crate) const INJECTED: ErrorCode = ErrorCode::IllegalValue;
/// The second answer to a request, or the answer to a broadcast: right for no request.
pub(crate) const SECOND: ErrorCode = ErrorCode::NotSupported;

/// R0 to R2999 hold their station and address, R3000 to R3199 cannot be read.
pub(crate) const READABLE: u16 = 3000;
pub(crate) const UNREADABLE: u16 = 200;
/// M0 to M1999 depend on their station and address.
pub(crate) const DISCRETES: u16 = 2000;
/// D0 to D1999 are written, D2000 to D2199 cannot be, D2500 to D2899 are restored.
pub(crate) const WRITABLE: u16 = 2000;
pub(crate) const UNWRITABLE: u16 = 200;
pub(crate) const RESTORED: (u16, u16) = (2500, 400);
/// The size of the program's ladder.
pub(crate) const LADDER_WORDS: u16 = 1024;
/// The station that refuses RUN.
pub(crate) const NO_RUN: u8 = 2;

/// `SplitMix64`: a run depends on its seed and on nothing else.
pub(crate) struct Dice(pub(crate) u64);

impl Dice {
    pub(crate) fn roll(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mixed = (self.0 ^ self.0 >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let mixed = (mixed ^ mixed >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
        mixed ^ mixed >> 31
    }

    pub(crate) fn below(&mut self, limit: u64) -> u64 {
        self.roll() % limit
    }

    pub(crate) fn in_hundred(&mut self, chances: u64) -> bool {
        self.below(100) < chances
    }

    /// From `first` to `last`.
    pub(crate) fn between(&mut self, first: u16, last: u16) -> u16 {
        first + self.below(u64::from(last - first) + 1) as u16
    }

    pub(crate) fn of<T: Copy>(&mut self, all: &[T]) -> T {
        all[self.below(all.len() as u64) as usize]
    }
}

pub(crate) fn word(station: u8, address: u16) -> u16 {
    u16::from(station) << 12 | address
}

pub(crate) fn dword(station: u8, address: u16) -> u32 {
    u32::from(word(station, address + 1)) << 16 | u32::from(word(station, address))
}

pub(crate) fn bit(station: u8, address: u16) -> bool {
    Dice(u64::from(station) << 16 | u64::from(address)).in_hundred(50)
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
    let plc = Plc::with_model(Model::default().ladder_words(LADDER_WORDS));
    // One more than is read, for the upper word of the last pair.
    for address in 0..=READABLE {
        plc.write(r(address), word(station, address)).unwrap();
    }
    for address in 0..DISCRETES {
        plc.write(m(address), bit(station, address)).unwrap();
    }
    plc.refuse_run((station == NO_RUN).then_some(RUN_REFUSED));
    plc
}

/// A program of which hardly two pages are equal, or some are.
pub(crate) fn program(dice: &mut Dice) -> Program {
    let mut header = [0xFF; 2 * PAGE_WORDS];
    header[..4].copy_from_slice(b"FB00");
    header[4..6].copy_from_slice(&LADDER_WORDS.to_be_bytes());
    let mut pages = vec![ProgramPage::from_bytes(&header)];
    let equal = dice.in_hundred(30);
    for page in 1..=LADDER_WORDS.div_ceil(64) {
        match pages.last().filter(|_| equal && page % 8 != 1) {
            Some(last) => pages.push(last.clone()),
            None => pages.push(ProgramPage::new([0; PAGE_WORDS].map(|_: u16| dice.roll() as u16))),
        }
    }
    Program::from_pages(pages).unwrap()
}

pub(crate) fn load(plc: &Plc, program: &Program) {
    (0..).zip(program.pages()).for_each(|(page, content)| plc.set_page(page, content.clone()).unwrap());
}

pub(crate) fn kind(error: &Error) -> &'static str {
    match error {
        Error::Invalid(_) => "invalid",
        Error::Plc { .. } => "refused",
        Error::Timeout { .. } => "timeout",
        Error::BadReply { .. } => "bad reply",
        Error::OutOfStep { .. } => "out of step",
        Error::Duplicates { .. } => "duplicates",
        Error::Offline { .. } => "offline",
        Error::QueueFull { .. } => "queue full",
        Error::Connect { .. } => "connect",
        Error::Disconnected { .. } => "disconnected",
        Error::PartlyWritten { source, .. } => kind(source),
        Error::Closed { .. } => "closed",
        _ => "other",
    }
}

/// The refusal that the error comes from.
pub(crate) fn refusal(error: &Error) -> Option<ErrorCode> {
    match error {
        Error::Plc { error, .. } => Some(*error),
        Error::PartlyWritten { source, .. } => refusal(source),
        _ => None,
    }
}
