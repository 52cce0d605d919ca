//! Models of PLCs with their memory and their statuses: one table.

use std::fmt;
use std::str::FromStr;

use super::{AreaRange, AreaUsage};
use crate::command::{BriefStatus, DetailedStatus, Series};
use crate::element;
use crate::element::Element;
use crate::printable::excerpt;

/// A model of PLC whose memory is documented.
///
/// Other models, such as those of the B1 and M series, are missing, because no figures were found
/// for them. [`MemoryMap::from_status`](super::MemoryMap::from_status) is for these.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[non_exhaustive]
pub enum PlcModel {
    /// FBE-28MC of the FB/FBE series: D0 to D3071, a ladder of 13184 words.
    ///
    /// Source: the example of 53 in the older protocol manual. Ranges within `R` and `M` are those of
    /// the FBs instruction manual, because the counts are equal.
    Fbe28Mc,
    /// FBS-20MC of the FBs series: D0 to D4095, a ladder of 32768 words by its status.
    ///
    /// Source: FBs instruction manual, list of memory areas; the example of 53 in Appendix 2 of the
    /// FBs manual. A user reports 20K words of ladder.
    Fbs20Mc,
}

impl PlcModel {
    /// All models.
    pub const ALL: &'static [Self] = &[Self::Fbe28Mc, Self::Fbs20Mc];

    /// Its name, as it is printed and parsed in either case: `FBS-20MC`.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.row().name
    }

    /// Its series.
    #[must_use]
    pub const fn series(self) -> Series {
        self.row().series
    }

    /// The reply of such a PLC in STOP to 40.
    #[must_use]
    pub fn brief_status(self) -> BriefStatus {
        BriefStatus::from_raw([0, self.row().program_capacity, 0])
    }

    /// The reply of such a PLC in STOP to 53: 64 bytes.
    #[must_use]
    pub fn detailed_status(self) -> DetailedStatus {
        let row = self.row();
        let mut raw = [0; 64];
        let words = row.words.iter().flat_map(|word| word.to_be_bytes());
        raw.iter_mut().zip([0].into_iter().chain(row.unit).chain(words)).for_each(|(byte, value)| *byte = value);
        raw.into()
    }

    pub(super) fn ranges(self) -> impl Iterator<Item = AreaRange> {
        COMMON.iter().chain(self.row().registers_d).copied()
    }

    const fn row(self) -> &'static ModelRow {
        match self {
            Self::Fbe28Mc => &FBE_28MC,
            Self::Fbs20Mc => &FBS_20MC,
        }
    }
}

impl fmt::Display for PlcModel {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for PlcModel {
    type Err = ParsePlcModelError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let model = Self::ALL.iter().copied().find(|model| model.name().eq_ignore_ascii_case(text));
        model.ok_or_else(|| ParsePlcModelError { input: text.to_owned() })
    }
}

/// Error: a text is not the name of a model.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct ParsePlcModelError {
    /// The text.
    pub input: String,
}

impl fmt::Display for ParsePlcModelError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "`{}` is not a known model (known:", excerpt(&self.input))?;
        PlcModel::ALL.iter().try_for_each(|model| write!(f, " {}", model.name().to_ascii_lowercase()))?;
        f.write_str(")")
    }
}

impl std::error::Error for ParsePlcModelError {}

/// A row of the table.
struct ModelRow {
    name: &'static str,
    series: Series,
    registers_d: &'static [AreaRange],
    /// STATUS2 of 40.
    program_capacity: u8,
    /// STATUS2 to 4 of 53: main unit, code of its points, version.
    unit: [u8; 3],
    /// STATUS5 to 28 of 53, as words: ladder words, inputs, outputs, analog inputs, analog outputs,
    /// relays M, S and L, registers R and D, timers, counters.
    words: [u16; 12],
}

/// The example of 53 in the older protocol manual. STATUS2 of 40 is that of an FBE with 13K.
static FBE_28MC: ModelRow = ModelRow {
    name: "FBE-28MC",
    series: Series::Fb,
    registers_d: &[range(element!("D0"), element!("D3071"), AreaUsage::General)],
    program_capacity: 0x54,
    unit: [0x01, 0x02, 0x31],
    words: [13_184, 256, 256, 100, 100, 2002, 1000, 0, 8072, 3072, 256, 256],
};

/// The example of 53 in Appendix 2 of the FBs manual. STATUS2 of 40 is reserved there; 40h was seen
/// on a real unit. The counts of analog elements are those of the registers.
static FBS_20MC: ModelRow = ModelRow {
    name: "FBS-20MC",
    series: Series::Fbs,
    // D4000 and above are used by the system in part: D4053 is.
    registers_d: &[
        range(element!("D0"), element!("D3999"), AreaUsage::General),
        range(element!("D4000"), element!("D4095"), AreaUsage::PartlySystem),
    ],
    program_capacity: 0x40,
    unit: [0x01, 0x02, 0x40],
    words: [32_768, 256, 256, 64, 64, 2002, 1000, 0, 8072, 4096, 256, 256],
};

/// The ranges of both series, without registers `D`.
///
/// Source: FBs instruction manual, list of memory areas. R4168 to R4999 do not exist: they are
/// missing there and in the maker's Modbus address map. Counters C200 to C255 have 32 bits by the
/// same map.
static COMMON: [AreaRange; 15] = [
    range(element!("X0"), element!("X255"), AreaUsage::Input),
    range(element!("Y0"), element!("Y255"), AreaUsage::Output),
    range(element!("M0"), element!("M1911"), AreaUsage::General),
    range(element!("M1912"), element!("M2001"), AreaUsage::Special),
    range(element!("S0"), element!("S999"), AreaUsage::General),
    range(element!("T0"), element!("T255"), AreaUsage::Contact),
    range(element!("C0"), element!("C255"), AreaUsage::Contact),
    range(element!("RT0"), element!("RT255"), AreaUsage::General),
    range(element!("RC0"), element!("RC199"), AreaUsage::General),
    range(element!("DRC200"), element!("DRC255"), AreaUsage::General),
    range(element!("R0"), element!("R3839"), AreaUsage::General),
    range(element!("R3840"), element!("R3903"), AreaUsage::AnalogInput),
    range(element!("R3904"), element!("R3967"), AreaUsage::AnalogOutput),
    range(element!("R3968"), element!("R4167"), AreaUsage::Special),
    range(element!("R5000"), element!("R8071"), AreaUsage::ProgramReadOnly),
];

const fn range(first: Element, last: Element, usage: AreaUsage) -> AreaRange {
    AreaRange { first, last, usage }
}
