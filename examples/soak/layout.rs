//! Memory layout of the PLCs.
//!
//! Every value contains its place: line, station, owner, cell and version. So a value of another
//! PLC, another register or another time differs from the expected one.
//!
//! - The *constants*, `R0` to `R127` and `M0` to `M127`, are never written.
//! - The *cells* are each written by one caller only, the owner, and read by all.

use fatek::command::{PAGE_WORDS, ProgramPage};
use fatek::sim::Plc;
use fatek::{Discrete, Register, Register32, Symbol, Value};

use crate::Result;

/// Limits of lines, stations per line and callers per line, by the bits of the values.
pub(crate) const MAX_LINES: usize = 16;
pub(crate) const MAX_STATIONS: usize = 31;
pub(crate) const MAX_CALLERS: usize = 16;

/// Number of constant registers, and of constant discretes.
pub(crate) const CONSTANTS: u16 = 128;

/// Number of 32-bit cells per owner.
pub(crate) const DWORDS: u16 = 4;

/// Kind of a cell.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) enum Kind {
    /// Two registers `D`, with an index below [`DWORDS`].
    DWord(u16),
    /// 32 relays `M`.
    Bits,
    /// Program page.
    Page,
    /// Two registers `F`, written by broadcasts.
    Broadcast,
    /// Output `Y`, set and reset.
    Switch,
    /// Disabled state of an input `X`.
    Force,
    /// RUN or STOP of the PLC.
    Running,
}

/// Place of a cell on its line.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(crate) struct Place {
    /// Index of the station, from 0; not the station number.
    pub(crate) station: usize,
    pub(crate) owner: usize,
    pub(crate) kind: Kind,
}

impl Kind {
    /// Kinds of 32 bits, which contain a version.
    pub(crate) const VERSIONED: [Self; 7] =
        [Self::DWord(0), Self::DWord(1), Self::DWord(2), Self::DWord(3), Self::Bits, Self::Page, Self::Broadcast];
    pub(crate) const ALL: [Self; 10] = [
        Self::DWord(0),
        Self::DWord(1),
        Self::DWord(2),
        Self::DWord(3),
        Self::Bits,
        Self::Page,
        Self::Broadcast,
        Self::Switch,
        Self::Force,
        Self::Running,
    ];

    pub(crate) fn index(self) -> usize {
        match self {
            Self::DWord(n) => usize::from(n),
            Self::Bits => 4,
            Self::Page => 5,
            Self::Broadcast => 6,
            Self::Switch => 7,
            Self::Force => 8,
            Self::Running => 9,
        }
    }
}

impl Place {
    /// Value of the cell with this version. The initial version is 0.
    ///
    /// A broadcast value is the same for all stations.
    pub(crate) fn value(self, line: usize, version: u16) -> u32 {
        if !Kind::VERSIONED.contains(&self.kind) {
            return 0;
        }
        let station = if self.kind == Kind::Broadcast { MAX_STATIONS } else { self.station };
        let place = line << 28 | station << 23 | self.owner << 19 | self.kind.index() << 16;
        place as u32 | u32::from(version)
    }

    /// Reads the cell from the memory of a PLC.
    pub(crate) fn read(self, plc: &Plc) -> Result<u32> {
        let word = |value: Value| match value {
            Value::Bit(on) => u32::from(on),
            Value::Word(word) => u32::from(word),
            Value::DWord(double) => double,
        };
        Ok(match self.kind {
            Kind::DWord(n) => word(plc.read(dword(self.owner, n)?)),
            Kind::Bits => word(plc.read(Register32::new(Symbol::DWM, bits(self.owner)?.address())?)),
            Kind::Page => value_of_page(&plc.page(page(self.owner)).ok_or("the page does not exist")?)?,
            Kind::Broadcast => word(plc.read(broadcast_register(self.owner)?)),
            Kind::Switch => word(plc.read(switch(self.owner)?)),
            Kind::Force => u32::from(plc.is_disabled(force(self.owner)?)),
            Kind::Running => u32::from(plc.is_running()),
        })
    }

    /// Writes the initial value to a PLC.
    pub(crate) fn prepare(self, plc: &Plc, line: usize) -> Result<()> {
        let value = self.value(line, 0);
        match self.kind {
            Kind::DWord(n) => plc.write(dword(self.owner, n)?, value)?,
            Kind::Bits => plc.write(Register32::new(Symbol::DWM, bits(self.owner)?.address())?, value)?,
            Kind::Page => plc.set_page(page(self.owner), page_of(value))?,
            Kind::Broadcast => plc.write(broadcast_register(self.owner)?, value)?,
            Kind::Switch | Kind::Force | Kind::Running => {}
        }
        Ok(())
    }
}

/// Value of a constant register.
pub(crate) fn constant(line: usize, station: usize, address: u16) -> u16 {
    (line << 12 | station << 7) as u16 | address
}

/// State of a constant relay.
pub(crate) fn constant_bit(line: usize, station: usize, address: u16) -> bool {
    u32::from(constant(line, station, address)).wrapping_mul(0x9E37_79B9) >> 24 & 1 == 1
}

pub(crate) fn relay(address: u16) -> Result<Discrete> {
    Ok(Discrete::new(Symbol::M, address)?)
}

pub(crate) fn dword(owner: usize, n: u16) -> Result<Register32> {
    Ok(Register32::new(Symbol::DD, 2 * (owner as u16 * DWORDS + n))?)
}

/// First of the 32 relays of an owner.
pub(crate) fn bits(owner: usize) -> Result<Discrete> {
    relay(1000 + 32 * owner as u16)
}

pub(crate) fn switch(owner: usize) -> Result<Discrete> {
    Ok(Discrete::new(Symbol::Y, owner as u16)?)
}

pub(crate) fn force(owner: usize) -> Result<Discrete> {
    Ok(Discrete::new(Symbol::X, owner as u16)?)
}

pub(crate) fn broadcast_register(owner: usize) -> Result<Register32> {
    Ok(Register32::new(Symbol::DF, 2 * owner as u16)?)
}

/// Page of an owner. Page 0 is the header.
pub(crate) fn page(owner: usize) -> u16 {
    1 + owner as u16
}

/// Writes the constants to a PLC.
pub(crate) fn prepare_constants(plc: &Plc, line: usize, station: usize) -> Result<()> {
    for address in 0..CONSTANTS {
        plc.write(Register::r(address), constant(line, station, address))?;
        plc.write(relay(address)?, constant_bit(line, station, address))?;
    }
    Ok(())
}

/// Returns whether all constants have their initial values.
pub(crate) fn constants_are_whole(plc: &Plc, line: usize, station: usize) -> Result<bool> {
    for address in 0..CONSTANTS {
        let register = plc.read(Register::r(address)) == constant(line, station, address).into();
        if !register || plc.read(relay(address)?) != constant_bit(line, station, address).into() {
            return Ok(false);
        }
    }
    Ok(true)
}

/// Page with `value` in its first two words, and words derived from it.
pub(crate) fn page_of(value: u32) -> ProgramPage {
    let word = |i: usize| match i {
        0 => (value >> 16) as u16,
        1 => (value & 0xFFFF) as u16,
        i => (value.wrapping_add(i as u32).wrapping_mul(0x9E37_79B9) >> 16) as u16,
    };
    ProgramPage::new(std::array::from_fn::<_, PAGE_WORDS, _>(word))
}

/// Value of a page. Fails if the page mixes two writes.
pub(crate) fn value_of_page(page: &ProgramPage) -> Result<u32> {
    let [high, low, ..] = *page.words();
    let value = u32::from(high) << 16 | u32::from(low);
    if *page == page_of(value) { Ok(value) } else { Err(format!("the page of {value:08X} is inconsistent").into()) }
}

/// Joins words to 32-bit values, low word first.
pub(crate) fn join(words: &[u16]) -> Vec<u32> {
    words.chunks(2).map(|pair| pair.iter().rev().fold(0, |value, &word| value << 16 | u32::from(word))).collect()
}

pub(crate) fn split(values: &[u32]) -> Vec<u16> {
    values.iter().flat_map(|&value| [(value & 0xFFFF) as u16, (value >> 16) as u16]).collect()
}

pub(crate) fn join_bits(states: &[bool]) -> u32 {
    states.iter().rev().fold(0, |value, &on| value << 1 | u32::from(on))
}

pub(crate) fn split_bits(value: u32) -> [bool; 32] {
    std::array::from_fn(|i| value >> i & 1 == 1)
}

#[cfg(test)]
mod tests {
    use std::collections::HashSet;

    use super::*;

    #[test]
    fn all_places_have_different_values() {
        let mut seen = HashSet::new();
        for line in 0..MAX_LINES {
            for station in 0..MAX_STATIONS {
                for owner in 0..MAX_CALLERS {
                    for kind in Kind::VERSIONED.into_iter().filter(|&kind| kind != Kind::Broadcast) {
                        assert!(
                            seen.insert(Place { station, owner, kind }.value(line, 0)),
                            "{line} {station} {kind:?}"
                        );
                    }
                }
                assert!(
                    (0..CONSTANTS).all(|address| seen.insert(0x7_0000 | u32::from(constant(line, station, address))))
                );
            }
        }
    }

    #[test]
    fn prepared_values_are_read_back() {
        let plc = Plc::with_model(fatek::sim::Model::largest());
        prepare_constants(&plc, 3, 5).unwrap();
        for owner in 0..MAX_CALLERS {
            for kind in Kind::ALL {
                Place { station: 5, owner, kind }.prepare(&plc, 3).unwrap();
            }
        }
        assert!(constants_are_whole(&plc, 3, 5).unwrap());
        assert!(!constants_are_whole(&plc, 3, 4).unwrap());
        for owner in 0..MAX_CALLERS {
            for kind in Kind::ALL {
                let place = Place { station: 5, owner, kind };
                assert_eq!(place.read(&plc).unwrap(), place.value(3, 0), "{place:?}");
            }
        }
    }

    #[test]
    fn split_values_are_joined_again() {
        for value in [0, 1, 0x1234_5678, u32::MAX] {
            assert_eq!(join(&split(&[value, !value])), [value, !value]);
            assert_eq!(join_bits(&split_bits(value)), value);
            assert_eq!(value_of_page(&page_of(value)).unwrap(), value);
        }
    }
}
