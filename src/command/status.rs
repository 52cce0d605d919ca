use std::fmt;

use bytes::Bytes;

use super::{Code, Command};
use crate::wire::{FieldError, FieldReader, FieldWriter};

/// 40: reads the brief status.
///
/// ```text
/// request  -
/// reply    STATUS1..3, one byte each
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ReadStatus;

impl Command for ReadStatus {
    type Reply = BriefStatus;
    const CODE: Code = Code::ReadStatus;

    fn write_request<W: FieldWriter>(&self, _fields: &mut W) {}

    fn read_request<R: FieldReader>(_fields: &mut R) -> Result<Self, FieldError> {
        Ok(Self)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &BriefStatus, fields: &mut W) {
        reply.raw.iter().for_each(|&byte| fields.byte(byte));
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<BriefStatus, FieldError> {
        Ok(BriefStatus { raw: [fields.byte()?, fields.byte()?, fields.byte()?] })
    }
}

/// The reply to 40: what state the PLC is in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BriefStatus {
    raw: [u8; 3],
}

impl BriefStatus {
    /// A status of these bytes, STATUS1 first.
    #[must_use]
    pub fn from_raw(raw: [u8; 3]) -> Self {
        Self { raw }
    }

    /// The bytes as the PLC sent them, STATUS1 first.
    #[must_use]
    pub fn raw(&self) -> [u8; 3] {
        self.raw
    }

    /// STATUS1: run, battery, checksum and the rest.
    #[must_use]
    pub fn flags(&self) -> StatusFlags {
        StatusFlags(self.raw[0])
    }

    /// STATUS2: the program capacity, on older ASCII models. FBs and M-series units answer values of their own.
    #[must_use]
    pub fn capacity(&self) -> ProgramCapacity {
        ProgramCapacity::from(self.raw[1])
    }
}

/// STATUS1, of 40 and of 53: one bit a state.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct StatusFlags(pub u8);

impl StatusFlags {
    /// B0: the ladder program runs.
    #[must_use]
    pub fn running(self) -> bool {
        self.bit(0)
    }

    /// B1: the battery is low.
    #[must_use]
    pub fn battery_low(self) -> bool {
        self.bit(1)
    }

    /// B2: the ladder's checksum is wrong.
    #[must_use]
    pub fn ladder_checksum_error(self) -> bool {
        self.bit(2)
    }

    /// B3: a ROM pack or memory card is in use.
    #[must_use]
    pub fn memory_card(self) -> bool {
        self.bit(3)
    }

    /// B4: the watchdog has timed out.
    #[must_use]
    pub fn watchdog_timeout(self) -> bool {
        self.bit(4)
    }

    /// B5: an id is set.
    #[must_use]
    pub fn id_set(self) -> bool {
        self.bit(5)
    }

    /// B6: the emergency stop is on.
    #[must_use]
    pub fn emergency_stop(self) -> bool {
        self.bit(6)
    }

    fn bit(self, n: u32) -> bool {
        self.0 >> n & 1 == 1
    }
}

impl fmt::Display for StatusFlags {
    /// The states by name: `RUN, id set`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(if self.running() { "RUN" } else { "STOP" })?;
        let others = [
            (self.battery_low(), "battery low"),
            (self.ladder_checksum_error(), "ladder checksum error"),
            (self.memory_card(), "memory card in use"),
            (self.watchdog_timeout(), "watchdog timeout"),
            (self.id_set(), "id set"),
            (self.emergency_stop(), "emergency stop"),
        ];
        others.iter().filter(|(on, _)| *on).try_for_each(|(_, name)| write!(f, ", {name}"))
    }
}

/// STATUS2 of 40: how large a program the PLC holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ProgramCapacity {
    /// 00: reserved; what the M series answers.
    Reserved,
    /// FF: FB, 8K steps.
    Fb8K,
    /// 53: FBE, 8K steps.
    Fbe8K,
    /// 54: FBE, 13K steps.
    Fbe13K,
    /// 55: FBN, 8K steps.
    Fbn8K,
    /// 56: FBN, 13K steps.
    Fbn13K,
    /// A value that no manual names, such as the 40h of real FBs units.
    Unknown(u8),
}

impl From<u8> for ProgramCapacity {
    fn from(byte: u8) -> Self {
        match byte {
            0x00 => Self::Reserved,
            0xFF => Self::Fb8K,
            0x53 => Self::Fbe8K,
            0x54 => Self::Fbe13K,
            0x55 => Self::Fbn8K,
            0x56 => Self::Fbn13K,
            other => Self::Unknown(other),
        }
    }
}

impl fmt::Display for ProgramCapacity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Reserved => f.pad("not stated"),
            Self::Fb8K => f.pad("FB 8K"),
            Self::Fbe8K => f.pad("FBE 8K"),
            Self::Fbe13K => f.pad("FBE 13K"),
            Self::Fbn8K => f.pad("FBN 8K"),
            Self::Fbn13K => f.pad("FBN 13K"),
            Self::Unknown(byte) => write!(f, "unknown ({byte:02X}h)"),
        }
    }
}

/// 53: reads the detailed status.
///
/// ```text
/// request  -
/// reply    STATUS1..64, one byte each
/// ```
///
/// Any number of bytes from 28 on is accepted, because models differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ReadDetailedStatus;

impl Command for ReadDetailedStatus {
    type Reply = DetailedStatus;
    const CODE: Code = Code::ReadDetailedStatus;

    fn write_request<W: FieldWriter>(&self, _fields: &mut W) {}

    fn read_request<R: FieldReader>(_fields: &mut R) -> Result<Self, FieldError> {
        Ok(Self)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &DetailedStatus, fields: &mut W) {
        reply.raw.iter().for_each(|&byte| fields.byte(byte));
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<DetailedStatus, FieldError> {
        let mut raw = Vec::with_capacity(64);
        while !fields.is_empty() && raw.len() <= DetailedStatus::MAX_LEN {
            raw.push(fields.byte()?);
        }
        DetailedStatus::from_raw(raw).ok_or(FieldError::WrongLength)
    }
}

/// The reply to 53: what the PLC is, and how large its memory is.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct DetailedStatus {
    raw: Bytes,
}

impl DetailedStatus {
    /// A status of these bytes, STATUS1 first; `None` for fewer than 28, and for more than fit into an ASCII frame (249).
    #[must_use]
    pub fn from_raw(raw: impl Into<Bytes>) -> Option<Self> {
        let raw = raw.into();
        (Self::MIN_LEN..=Self::MAX_LEN).contains(&raw.len()).then_some(Self { raw })
    }

    /// The bytes as the PLC sent them, STATUS1 first: 28 or more, 64 by the manual.
    #[must_use]
    pub fn raw(&self) -> &[u8] {
        &self.raw
    }

    /// STATUS1: run, battery, checksum and the rest.
    #[must_use]
    pub fn flags(&self) -> StatusFlags {
        StatusFlags(self.status(1))
    }

    /// STATUS2: the type of the main unit.
    #[must_use]
    pub fn main_unit(&self) -> MainUnit {
        MainUnit::from(self.status(2))
    }

    /// STATUS3: a code for the number of I/O points of the main unit, which each series assigns anew.
    #[must_use]
    pub fn io_points_code(&self) -> u8 {
        self.status(3)
    }

    /// The number of I/O points of the main unit, if it is of this series and its code is known.
    #[must_use]
    pub fn io_points(&self, series: Series) -> Option<u16> {
        match (series, self.io_points_code()) {
            (Series::Fb, 0x01) => Some(20),
            (Series::Fb, 0x02) => Some(28),
            (Series::Fb, 0x03) => Some(40),
            (Series::Fbs, 0x00) => Some(10),
            (Series::Fbs, 0x01) => Some(14),
            (Series::Fbs, 0x02) => Some(20),
            (Series::Fbs, 0x03) => Some(24),
            (Series::Fbs, 0x04) => Some(32),
            (Series::Fbs, 0x05) => Some(40),
            (Series::Fbs, 0x06) => Some(60),
            _ => None,
        }
    }

    /// STATUS4: the version of the operating system, major and minor, as two nibbles: 31h is (3, 1).
    #[must_use]
    pub fn os_version(&self) -> (u8, u8) {
        (self.status(4) >> 4, self.status(4) & 0x0F)
    }

    /// STATUS5 and 6: the size of the ladder, in words.
    #[must_use]
    pub fn ladder_words(&self) -> u16 {
        self.word(5)
    }

    /// STATUS7 and 8: how many discrete inputs there are.
    #[must_use]
    pub fn discrete_inputs(&self) -> u16 {
        self.word(7)
    }

    /// STATUS9 and 10: how many discrete outputs there are.
    #[must_use]
    pub fn discrete_outputs(&self) -> u16 {
        self.word(9)
    }

    /// STATUS11 and 12: how many analog inputs there are.
    #[must_use]
    pub fn analog_inputs(&self) -> u16 {
        self.word(11)
    }

    /// STATUS13 and 14: how many analog outputs there are.
    #[must_use]
    pub fn analog_outputs(&self) -> u16 {
        self.word(13)
    }

    /// STATUS15 and 16: how many relays `M` there are.
    #[must_use]
    pub fn m_relays(&self) -> u16 {
        self.word(15)
    }

    /// STATUS17 and 18: how many step relays `S` there are.
    #[must_use]
    pub fn s_relays(&self) -> u16 {
        self.word(17)
    }

    /// STATUS19 and 20: how many relays `L` there are.
    #[must_use]
    pub fn l_relays(&self) -> u16 {
        self.word(19)
    }

    /// STATUS21 and 22: how many registers `R` there are.
    #[must_use]
    pub fn r_registers(&self) -> u16 {
        self.word(21)
    }

    /// STATUS23 and 24: how many registers `D` there are.
    #[must_use]
    pub fn d_registers(&self) -> u16 {
        self.word(23)
    }

    /// STATUS25 and 26: how many timers there are.
    #[must_use]
    pub fn timers(&self) -> u16 {
        self.word(25)
    }

    /// STATUS27 and 28: how many counters there are.
    #[must_use]
    pub fn counters(&self) -> u16 {
        self.word(27)
    }

    /// The fewest bytes that hold every field.
    const MIN_LEN: usize = 28;
    /// The most that 500 characters hold, two each, behind the error digit.
    const MAX_LEN: usize = 249;

    /// The byte that the manual numbers from 1.
    fn status(&self, number: usize) -> u8 {
        self.raw[number - 1]
    }

    /// The big-endian word whose high byte the manual numbers so.
    fn word(&self, high: usize) -> u16 {
        u16::from_be_bytes([self.status(high), self.status(high + 1)])
    }
}

impl From<[u8; 64]> for DetailedStatus {
    /// A status of the length that the manual gives.
    fn from(raw: [u8; 64]) -> Self {
        Self { raw: Bytes::copy_from_slice(&raw) }
    }
}

/// STATUS2 of 53: the type of the main unit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum MainUnit {
    /// 00: MA or MU.
    MaMu,
    /// 01: MC.
    Mc,
    /// A value that no manual names.
    Unknown(u8),
}

impl From<u8> for MainUnit {
    fn from(byte: u8) -> Self {
        match byte {
            0x00 => Self::MaMu,
            0x01 => Self::Mc,
            other => Self::Unknown(other),
        }
    }
}

impl fmt::Display for MainUnit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::MaMu => f.pad("MA/MU"),
            Self::Mc => f.pad("MC"),
            Self::Unknown(byte) => write!(f, "unknown ({byte:02X}h)"),
        }
    }
}

/// The series of a PLC, which it does not tell itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Series {
    /// FB and FBe.
    Fb,
    /// FBs.
    Fbs,
}
