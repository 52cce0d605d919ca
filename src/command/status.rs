use std::fmt;

use bytes::Bytes;

use super::{Code, Command, RequestError, Run, sealed};
use crate::wire::{FieldError, FieldReader, FieldWriter};

/// 40: reads the brief status.
///
/// ```text
/// request  -
/// reply    STATUS1..3, one byte each
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ReadStatus;

impl sealed::Sealed for ReadStatus {}

impl fmt::Display for ReadStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", Self::CODE)
    }
}

impl Command for ReadStatus {
    type Reply = BriefStatus;
    const CODE: Code = Code::ReadStatus;

    fn write_request<W: FieldWriter>(&self, _fields: &mut W) {}

    fn read_request<R: FieldReader>(_fields: &mut R) -> Result<Self, RequestError> {
        Ok(Self)
    }

    fn write_reply<W: FieldWriter>(&self, reply: &BriefStatus, fields: &mut W) {
        reply.raw.iter().for_each(|&byte| fields.byte(byte));
    }

    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<BriefStatus, FieldError> {
        Ok(BriefStatus { raw: [fields.byte()?, fields.byte()?, fields.byte()?] })
    }

    fn fmt_reply(reply: &BriefStatus, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{reply}")
    }

    fn for_each_run(&self, _each: &mut dyn FnMut(Run)) {}
}

/// The reply to 40: the state of the PLC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct BriefStatus {
    raw: [u8; 3],
}

impl BriefStatus {
    /// A status of these bytes, beginning with STATUS1.
    #[must_use]
    pub fn from_raw(raw: [u8; 3]) -> Self {
        Self { raw }
    }

    /// The bytes from the PLC, beginning with STATUS1.
    #[must_use]
    pub fn raw(&self) -> [u8; 3] {
        self.raw
    }

    /// STATUS1: run, battery, checksum and the rest.
    #[must_use]
    pub fn flags(&self) -> StatusFlags {
        StatusFlags(self.raw[0])
    }

    /// STATUS2: the program capacity of older ASCII models. FBs and M-series units send other
    /// values.
    #[must_use]
    pub fn capacity(&self) -> ProgramCapacity {
        ProgramCapacity::from(self.raw[1])
    }
}

impl fmt::Display for BriefStatus {
    /// The states of STATUS1, and all bytes: `RUN, id set (21 40 00)`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let [status1, status2, status3] = self.raw;
        write!(f, "{} ({status1:02X} {status2:02X} {status3:02X})", self.flags())
    }
}

/// STATUS1 of 40 and 53: a bit for each state.
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

    /// B5: an ID is set.
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
    /// The names of the states: `RUN, id set`.
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

/// STATUS2 of 40: the program capacity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum ProgramCapacity {
    /// 00: reserved. The M series sends it.
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
    /// A value that is in no manual, such as 40h from real FBs units.
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
/// Replies of 28 and more bytes are accepted, because models differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct ReadDetailedStatus;

impl sealed::Sealed for ReadDetailedStatus {}

impl fmt::Display for ReadDetailedStatus {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", Self::CODE)
    }
}

impl Command for ReadDetailedStatus {
    type Reply = DetailedStatus;
    const CODE: Code = Code::ReadDetailedStatus;

    fn write_request<W: FieldWriter>(&self, _fields: &mut W) {}

    fn read_request<R: FieldReader>(_fields: &mut R) -> Result<Self, RequestError> {
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

    fn fmt_reply(reply: &DetailedStatus, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{reply}")
    }

    fn for_each_run(&self, _each: &mut dyn FnMut(Run)) {}
}

/// The reply to 53: the type of the PLC and the size of its memory.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct DetailedStatus {
    raw: Bytes,
}

impl DetailedStatus {
    /// A status of these bytes, beginning with STATUS1; `None` unless there are 28 to 249, the most
    /// in an ASCII frame.
    #[must_use]
    pub fn from_raw(raw: impl Into<Bytes>) -> Option<Self> {
        let raw = raw.into();
        (Self::MIN_LEN..=Self::MAX_LEN).contains(&raw.len()).then_some(Self { raw })
    }

    /// The bytes from the PLC, beginning with STATUS1: 28 or more, 64 in the manual.
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

    /// STATUS3: a code for the number of I/O points of the main unit, different in each series.
    #[must_use]
    pub fn io_points_code(&self) -> u8 {
        self.status(3)
    }

    /// The number of I/O points of the main unit in this series; `None` for an unknown code.
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

    /// STATUS4: the version of the operating system, major and minor: (3, 1) for 31h.
    #[must_use]
    pub fn os_version(&self) -> (u8, u8) {
        (self.status(4) >> 4, self.status(4) & 0x0F)
    }

    /// STATUS5 and 6: the size of the ladder in words.
    #[must_use]
    pub fn ladder_words(&self) -> u16 {
        self.word(5)
    }

    /// STATUS7 and 8: the number of discrete inputs.
    #[must_use]
    pub fn discrete_inputs(&self) -> u16 {
        self.word(7)
    }

    /// STATUS9 and 10: the number of discrete outputs.
    #[must_use]
    pub fn discrete_outputs(&self) -> u16 {
        self.word(9)
    }

    /// STATUS11 and 12: the number of analog inputs.
    #[must_use]
    pub fn analog_inputs(&self) -> u16 {
        self.word(11)
    }

    /// STATUS13 and 14: the number of analog outputs.
    #[must_use]
    pub fn analog_outputs(&self) -> u16 {
        self.word(13)
    }

    /// STATUS15 and 16: the number of relays `M`.
    #[must_use]
    pub fn m_relays(&self) -> u16 {
        self.word(15)
    }

    /// STATUS17 and 18: the number of step relays `S`.
    #[must_use]
    pub fn s_relays(&self) -> u16 {
        self.word(17)
    }

    /// STATUS19 and 20: the number of relays `L`.
    #[must_use]
    pub fn l_relays(&self) -> u16 {
        self.word(19)
    }

    /// STATUS21 and 22: the number of registers `R`.
    #[must_use]
    pub fn r_registers(&self) -> u16 {
        self.word(21)
    }

    /// STATUS23 and 24: the number of registers `D`.
    #[must_use]
    pub fn d_registers(&self) -> u16 {
        self.word(23)
    }

    /// STATUS25 and 26: the number of timers.
    #[must_use]
    pub fn timers(&self) -> u16 {
        self.word(25)
    }

    /// STATUS27 and 28: the number of counters.
    #[must_use]
    pub fn counters(&self) -> u16 {
        self.word(27)
    }

    /// The bytes of all fields.
    const MIN_LEN: usize = 28;
    /// The most bytes in 500 characters: an error digit, and two characters a byte.
    const MAX_LEN: usize = 249;

    /// The byte with this number, from 1 as in the manual.
    fn status(&self, number: usize) -> u8 {
        self.raw[number - 1]
    }

    /// The big-endian word whose high byte has this number.
    fn word(&self, high: usize) -> u16 {
        u16::from_be_bytes([self.status(high), self.status(high + 1)])
    }
}

impl fmt::Display for DetailedStatus {
    /// States, main unit, version and ladder: `STOP; main unit MC, OS 3.1, ladder of 13184 words`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ((major, minor), words) = (self.os_version(), self.ladder_words());
        write!(f, "{}; main unit {}, OS {major}.{minor}, ladder of {words} words", self.flags(), self.main_unit())
    }
}

impl From<[u8; 64]> for DetailedStatus {
    /// A status of the length in the manual.
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
    /// A value that is in no manual.
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

/// The series of a PLC, which is not in its status.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Series {
    /// FB and FBe.
    Fb,
    /// FBs.
    Fbs,
}
