//! The report of a run.

use super::Restoring;
use crate::backup::options::SpecialElements;
use crate::backup::report::RestoreReport;
use crate::backup::target::{ElementState, Target};
use crate::tag::Tag;

impl Restoring {
    /// The elements by their states, and the PLC.
    pub(in crate::backup) fn report(&self) -> RestoreReport {
        let ranges =
            |holds: fn(ElementState) -> bool| self.targets.iter().flat_map(|target| target.ranges(holds)).collect();
        let compared = self.all().flat_map(|target| &target.elements).filter(|element| element.found.is_some());
        RestoreReport {
            compared: compared.count(),
            differences: self.targets.iter().flat_map(Target::differences).collect(),
            written: ranges(|state| state == ElementState::Written),
            in_doubt: ranges(|state| matches!(state, ElementState::InDoubt | ElementState::ToRepeat)),
            unwritten: ranges(|state| state == ElementState::Differs),
            to_write: self
                .targets
                .iter()
                .flat_map(|target| target.ranges_to_write(self.options.bridge, self.lengths))
                .collect(),
            refused: self.all().flat_map(Target::refused).collect(),
            forced: ranges(|state| state == ElementState::Forced),
            left_out: self.left_out.iter().map(|target| target.range).collect(),
            left_out_differences: self.left_out.iter().flat_map(Target::differences).collect(),
            special: self.special.clone(),
            missing: self.missing.clone(),
            other_plc: self.other_plc.clone(),
            remaining: self.remaining.clone(),
            was_stopped: self.control.was_stopped(),
            plc: self.control.plc(),
        }
    }

    /// The first special elements, if their treatment was not chosen.
    pub(in crate::backup) fn refused_special(&self) -> Option<Tag> {
        self.special.first().copied().filter(|_| self.options.special == SpecialElements::Refuse)
    }
}
