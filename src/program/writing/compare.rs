//! Comparing the pages of the PLC with those of the program, and finding those to write.

use super::confirm::Pending;
use super::{LookAt, WriteGoal, WriteStage, Writing};
use crate::command::{DetailedStatus, ProgramPage};
use crate::program::{ProgramError, ProgramHeader};
use crate::progress::Phase;
use crate::transfer::{PlcState, Position};

impl Writing {
    pub(super) fn fits(&mut self, status: &DetailedStatus) {
        let (program, plc) = (self.program.ladder_words(), status.ladder_words());
        self.control.saw(status.flags().running());
        if program != plc {
            return self.refuse(ProgramError::SizeMisfit { program, plc });
        }
        self.other_plc = self.program.plc_differences(status);
        if !self.other_plc.is_empty() && !self.options.accept_other_plc && self.goal != WriteGoal::Compare {
            return self.refuse(ProgramError::OtherPlc);
        }
        if status.flags().memory_card() && self.goal != WriteGoal::Compare {
            return self.refuse(ProgramError::MemoryCard);
        }
        let runs = self.control.plc() == PlcState::Running;
        self.suspect = runs && self.touched;
        if runs && !self.suspect && !self.options.stop_first && self.goal != WriteGoal::Compare {
            return self.refuse(ProgramError::Running);
        }
        self.stage = self.program.refused_page().map_or(WriteStage::Kind, WriteStage::End);
    }

    /// A PLC whose page 0 is no header has no kind, and may be given any program.
    pub(super) fn kind(&mut self, content: &ProgramPage) {
        let program = self.program.header().kind();
        match ProgramHeader::parse(content) {
            Ok(header) if header.kind() != program => {
                self.refuse(ProgramError::KindMisfit { program, plc: header.kind() });
            }
            // Pages that an earlier run wrote may have changed since: those are compared.
            Ok(_) | Err(_) if self.writes_all() && self.written_before.is_empty() => {
                self.stage = WriteStage::LastPage;
            }
            Ok(_) | Err(_) => {
                self.uncompared = (1..self.program.page_count()).rev().collect();
                self.uncompared.sort_by_key(|&page| page >= self.telling);
                self.compare(0, content);
            }
        }
    }

    /// All pages are written without a comparison.
    pub(super) fn write_all(&mut self) {
        self.pending = (0..self.program.page_count()).collect();
        self.to_confirm = Some(Pending::AllCompared);
    }

    fn writes_all(&self) -> bool {
        self.options.all_pages && self.goal != WriteGoal::Compare && !self.suspect
    }

    pub(super) fn compare(&mut self, page: u16, content: &ProgramPage) {
        let differs = self.program.page(page) != Some(content);
        self.comparisons.push((page, differs));
        let total = usize::from(self.program.page_count());
        debug_assert!(self.uncompared.len() < total, "each page is compared once");
        let done = total.saturating_sub(self.uncompared.len());
        self.position = Position { phase: Phase::Comparing, done, total };
        if differs && self.suspect && self.goal != WriteGoal::Compare {
            self.to_confirm = Some(Pending::HalfRuns);
            return;
        }
        match self.uncompared.pop() {
            Some(next) => {
                self.stage = WriteStage::Compare(next);
                self.confirm_between(page, next);
            }
            None => self.to_confirm = Some(Pending::AllCompared),
        }
    }

    pub(super) fn is_to_be_written(&self, page: u16, differs: bool) -> bool {
        differs || self.writes_all() && !self.written_before.contains(&page)
    }

    /// A check separates two pages that should be equal: a duplicate of one would pass as the other.
    pub(super) fn confirm_between(&mut self, page: u16, next: u16) {
        if self.program.page(page) == self.program.page(next) {
            self.to_confirm = Some(Pending::NextPage);
        }
    }

    /// Uses the confirmed comparisons.
    pub(super) fn sort_out(&mut self) {
        for (page, differs) in std::mem::take(&mut self.comparisons) {
            if self.is_to_be_written(page, differs) {
                self.pending.push(page);
            } else if self.sent_before.remove(&page) {
                self.written_before.insert(page);
            }
        }
    }

    pub(super) fn all_compared(&mut self) {
        self.sort_out();
        self.compared = true;
        // The PLC holds the program, if another client has written the rest.
        self.touched &= !self.pending.is_empty();
        // Taken from the end: the ladder in ascending order, then the header.
        self.pending.sort_unstable_by(|page, next| next.cmp(page));
        if self.pending.last() == Some(&0) {
            self.pending.rotate_right(1);
        }
        match (self.goal, self.pending.is_empty()) {
            (WriteGoal::Compare | WriteGoal::DryRun, _) => self.stage = WriteStage::Done,
            (WriteGoal::Write, false) => self.look(LookAt::Start),
            // An earlier run stopped the PLC and may have written all pages.
            (WriteGoal::Write, true) if self.control.was_stopped() => self.look(LookAt::End),
            (WriteGoal::Write, true) => self.stage = WriteStage::Done,
        }
    }
}
