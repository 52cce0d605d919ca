use std::fmt;

use super::Origin;
use crate::command::{DetailedStatus, MainUnit, ProgramCapacity};

/// A difference between the PLC that a file was read from and the PLC that it is to be written to.
///
/// Its `Display` is the property with the value of the PLC and that of the file, such as
/// `OS version 3.2 instead of 3.1`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum PlcDifference {
    /// The station number. Files of programs do not have it.
    #[non_exhaustive]
    Station {
        /// The number in the file.
        file: u8,
        /// The number of the PLC.
        plc: u8,
    },
    /// The program capacity (40), which is the model of older units. It is not compared for
    /// programs.
    #[non_exhaustive]
    Capacity {
        /// The capacity in the file.
        file: ProgramCapacity,
        /// The capacity of the PLC.
        plc: ProgramCapacity,
    },
    /// The main unit (53).
    #[non_exhaustive]
    MainUnit {
        /// The main unit in the file.
        file: MainUnit,
        /// The main unit of the PLC.
        plc: MainUnit,
    },
    /// The code of the number of I/O points (53).
    #[non_exhaustive]
    IoPoints {
        /// The code in the file.
        file: u8,
        /// The code of the PLC.
        plc: u8,
    },
    /// The version of the operating system (53), major and minor.
    #[non_exhaustive]
    OsVersion {
        /// The version in the file.
        file: (u8, u8),
        /// The version of the PLC.
        plc: (u8, u8),
    },
    /// One of both PLCs has a detailed status (53), and the other refuses it.
    #[non_exhaustive]
    DetailedStatus {
        /// `true` if the PLC has it.
        plc: bool,
    },
}

impl fmt::Display for PlcDifference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Station { file, plc } => write!(f, "station {plc} instead of {file}"),
            Self::Capacity { file, plc } => write!(f, "program capacity {plc} instead of {file}"),
            Self::MainUnit { file, plc } => write!(f, "main unit {plc} instead of {file}"),
            Self::IoPoints { file, plc } => write!(f, "I/O points code {plc} instead of {file}"),
            Self::OsVersion { file: (major, minor), plc: (plc_major, plc_minor) } => {
                write!(f, "OS version {plc_major}.{plc_minor} instead of {major}.{minor}")
            }
            Self::DetailedStatus { plc: true } => f.write_str("a detailed status (53) instead of none"),
            Self::DetailedStatus { plc: false } => f.write_str("no detailed status (53)"),
        }
    }
}

/// Differences as a list for a sentence.
pub(crate) fn listed(differences: &[PlcDifference]) -> String {
    differences.iter().map(ToString::to_string).collect::<Vec<_>>().join(", ")
}

impl Origin {
    /// Returns whether the content was read from a PLC.
    pub(crate) fn is_known(&self) -> bool {
        self.brief.is_some() || self.detailed.is_some()
    }

    /// The differences to a PLC with these statuses; `None` is a status that it refuses. A property
    /// that the file does not state is no difference.
    pub(crate) fn differences(&self, plc: &Self) -> Vec<PlcDifference> {
        let capacity = |origin: &Self| origin.brief.map(|status| status.capacity());
        let capacities = capacity(self).zip(capacity(plc)).filter(|(file, plc)| file != plc);
        let capacity = capacities.map(|(file, plc)| PlcDifference::Capacity { file, plc });
        let models = match (&self.detailed, &plc.detailed) {
            (Some(file), Some(plc)) => model_differences(file, plc),
            (Some(_), None) => vec![PlcDifference::DetailedStatus { plc: false }],
            (None, Some(_)) if self.is_known() => vec![PlcDifference::DetailedStatus { plc: true }],
            (None, _) => Vec::new(),
        };
        capacity.into_iter().chain(models).collect()
    }
}

/// The differences of model and operating system.
pub(crate) fn model_differences(file: &DetailedStatus, plc: &DetailedStatus) -> Vec<PlcDifference> {
    let unit = (file.main_unit(), plc.main_unit());
    let points = (file.io_points_code(), plc.io_points_code());
    let version = (file.os_version(), plc.os_version());
    let differences = [
        (unit.0 != unit.1).then_some(PlcDifference::MainUnit { file: unit.0, plc: unit.1 }),
        (points.0 != points.1).then_some(PlcDifference::IoPoints { file: points.0, plc: points.1 }),
        (version.0 != version.1).then_some(PlcDifference::OsVersion { file: version.0, plc: version.1 }),
    ];
    differences.into_iter().flatten().collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::BriefStatus;

    fn origin(capacity: Option<u8>, detailed: Option<[u8; 3]>) -> Origin {
        let brief = capacity.map(|capacity| BriefStatus::from_raw([0, capacity, 0]));
        let detailed = detailed.map(|[unit, points, version]| {
            let mut raw = vec![0; 64];
            raw[1..4].copy_from_slice(&[unit, points, version]);
            DetailedStatus::from_raw(raw).unwrap()
        });
        Origin { read_at: None, brief, detailed }
    }

    #[test]
    fn model_and_version_are_compared_as_far_as_known() {
        let file = origin(Some(0x40), Some([1, 2, 0x31]));
        let texts = |file: &Origin, plc: &Origin| -> Vec<String> {
            file.differences(plc).iter().map(ToString::to_string).collect()
        };
        assert_eq!(texts(&file, &file), [""; 0]);
        assert_eq!(texts(&file, &origin(Some(0x40), Some([1, 2, 0x32]))), ["OS version 3.2 instead of 3.1"]);
        let all = texts(&file, &origin(Some(0x54), Some([0, 3, 0x42])));
        assert_eq!(all.len(), 4, "{all:?}");
        assert_eq!(all[2], "I/O points code 3 instead of 2");
        assert_eq!(texts(&file, &origin(Some(0x40), None)), ["no detailed status (53)"]);
        assert_eq!(texts(&origin(Some(0x40), None), &file), ["a detailed status (53) instead of none"]);
        assert_eq!(texts(&origin(None, None), &file), [""; 0], "the file is not from a PLC");
        assert_eq!(texts(&origin(Some(0x40), None), &origin(None, None)), [""; 0]);
    }
}
