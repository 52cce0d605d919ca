//! The PLC of a run beside the one that was read.

use super::Restoring;
use crate::file::{Origin, PlcDifference};

impl Restoring {
    /// Returns whether the backup states the PLC that was read.
    pub(in crate::backup) fn has_origin(&self) -> bool {
        self.station.is_some() || self.origin.is_known()
    }

    /// The run is with this station, whose statuses these are.
    pub(in crate::backup) fn compare_origin(&mut self, station: u8, plc: &Origin) {
        let file = self.station.filter(|&file| file != station);
        let number = file.map(|file| PlcDifference::Station { file, plc: station });
        self.other_plc = number.into_iter().chain(self.origin.differences(plc)).collect();
    }

    /// Returns whether a backup may be restored to the PLC of this run.
    pub(in crate::backup) fn accepts_plc(&self) -> bool {
        self.options.accept_other_plc || self.other_plc.is_empty()
    }
}
