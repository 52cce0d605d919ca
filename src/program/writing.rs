//! Writing a program as a [`Transfer`], as the [module](super) draws it: compare, write, verify.

mod compare;
mod confirm;
mod outcome;

use std::collections::BTreeSet;

use self::confirm::Pending;
use super::{Program, ProgramAction, ProgramError, WriteOptions, ends_the_ladder};
use crate::command::ProgramPage;
use crate::error::Error;
use crate::file::PlcDifference;
use crate::progress::Phase;
use crate::transfer::{Position, Reply, Request, RunControl, RunEvent, Step, Transfer};

/// How often STOP and RUN are sent.
const CONTROL_ATTEMPTS: u32 = 5;
/// After this number of written pages the status is read: is the PLC still stopped?
const LOOK_EVERY: usize = 16;

/// The purpose of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WriteGoal {
    /// Find the pages that differ.
    Compare,
    /// Find the pages that would be written, or the refusal.
    DryRun,
    Write,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum WriteStage {
    /// Does the program fit the PLC (53)?
    Fit,
    /// The page behind the program, if it ends before the size of its header: does the PLC refuse it, too?
    End(u16),
    /// Page 0: is the program of the PLC's kind?
    Kind,
    /// The last page of the program, if all are written without a comparison: does the PLC have it?
    LastPage,
    Compare(u16),
    Look(LookAt),
    Write {
        page: u16,
        left: u32,
    },
    ReadBack {
        page: u16,
        left: u32,
    },
    Verify(u16),
    Run,
    Done,
    /// Failed; the PLC may hold a half-written program and must not run.
    Secure,
    Failed,
}

/// When the status is read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum LookAt {
    /// All pages are compared. A PLC that runs is stopped here, if that is chosen.
    Start,
    BetweenPages,
    /// The PLC refused a page.
    Refusal,
    /// All pages are written.
    End,
}

/// Where a request stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct WriteMark {
    stage: WriteStage,
    compared: usize,
    written: usize,
}

/// The writing of one program, for all its runs.
#[derive(Debug)]
pub(super) struct Writing {
    program: Program,
    options: WriteOptions,
    /// How the PLC differs from the one that the program was read from.
    other_plc: Vec<PlcDifference>,
    goal: WriteGoal,
    stage: WriteStage,
    control: RunControl,
    /// A page was or may have been written since the last time all pages were found equal: any run.
    touched: bool,
    /// Pages that earlier runs wrote and read back, or that were found written since.
    written_before: BTreeSet<u16>,
    /// Pages that earlier runs sent, with unknown result.
    sent_before: BTreeSet<u16>,
    /// The PLC runs although an earlier run left it half-written and stopped.
    suspect: bool,
    /// The page to compare first, because it shows soonest whether a suspect PLC is half-written.
    telling: u16,
    /// Pages still to compare, the next one last.
    uncompared: Vec<u16>,
    /// Pages that were compared, and whether they differ; used when all of them are confirmed.
    comparisons: Vec<(u16, bool)>,
    /// All pages have been compared in this run.
    compared: bool,
    /// Pages still to write, the next one last.
    pending: Vec<u16>,
    /// The action that waits for a check.
    to_confirm: Option<Pending>,
    /// Pages written and read back in this run.
    written: Vec<u16>,
    /// A page was read back since the last check.
    unconfirmed: bool,
    /// Written pages that must be read back again before they are written again.
    to_read_back: BTreeSet<u16>,
    /// The page whose write was sent last, until it is read back.
    in_doubt: Option<u16>,
    /// Pages that differed when all were verified.
    differing: Vec<u16>,
    /// The error of the last write of the current page. It is reported if no attempt succeeds.
    page_error: Option<ProgramError>,
    failure: Option<ProgramError>,
    position: Position,
}

impl Writing {
    pub(super) fn new(program: Program, options: WriteOptions) -> Self {
        Self {
            program,
            options,
            other_plc: Vec::new(),
            goal: WriteGoal::Write,
            stage: WriteStage::Fit,
            control: RunControl::new(CONTROL_ATTEMPTS),
            touched: false,
            written_before: BTreeSet::new(),
            sent_before: BTreeSet::new(),
            suspect: false,
            telling: 0,
            uncompared: Vec::new(),
            comparisons: Vec::new(),
            compared: false,
            pending: Vec::new(),
            to_confirm: None,
            written: Vec::new(),
            unconfirmed: false,
            to_read_back: BTreeSet::new(),
            in_doubt: None,
            differing: Vec::new(),
            page_error: None,
            failure: None,
            position: Position { phase: Phase::Comparing, done: 0, total: 0 },
        }
    }

    /// Begins a run. Unless the last one succeeded, it inherits whether the PLC was stopped and
    /// which pages were written.
    pub(super) fn begin(&mut self, goal: WriteGoal) {
        let fresh = Self::new(self.program.clone(), self.options);
        let last = std::mem::replace(self, fresh);
        self.goal = goal;
        if last.is_over() {
            return;
        }
        let in_doubt = last.in_doubt();
        self.telling = if last.compared {
            last.unwritten().first().or(in_doubt.first()).copied().unwrap_or(0)
        } else {
            last.telling
        };
        self.touched = last.touched || !in_doubt.is_empty();
        self.sent_before = last.sent_before;
        self.sent_before.extend(in_doubt);
        self.written_before = last.written_before;
        self.written_before.extend(last.written);
        self.control = last.control;
        self.control.begin(false);
    }

    /// Returns whether earlier runs have left something in their PLC: a STOP or a page.
    pub(super) fn is_bound(&self) -> bool {
        let written = !self.written.is_empty() || !self.written_before.is_empty();
        let touched = self.touched || !self.in_doubt().is_empty();
        !self.is_over() && (self.control.was_stopped() || touched || written)
    }

    pub(super) fn program(&self) -> &Program {
        &self.program
    }

    pub(super) fn options(&self) -> &WriteOptions {
        &self.options
    }

    fn is_over(&self) -> bool {
        self.goal == WriteGoal::Write && self.stage == WriteStage::Done
    }

    /// Returns whether all pages were found to be those of the program, in this run.
    fn whole(&self) -> bool {
        let equal = self.pending.is_empty() && self.comparisons.is_empty() && self.differing.is_empty();
        self.compared && equal && !self.unconfirmed
    }

    /// Returns whether the PLC may hold parts of two programs because of this writing.
    fn half_written(&self) -> bool {
        self.touched && !self.whole()
    }

    // Run control.

    fn look(&mut self, at: LookAt) {
        self.stage = WriteStage::Look(at);
        if at == LookAt::Start && self.options.stop_first {
            self.control.halt();
        } else {
            self.control.look();
        }
    }

    fn controlled(&mut self, event: RunEvent) {
        match (self.stage, event) {
            (WriteStage::Look(at), RunEvent::Seen(running)) => self.seen(at, running),
            (WriteStage::Look(_), RunEvent::Obeyed) => self.write_next(),
            (WriteStage::Run, RunEvent::Obeyed) => self.stage = WriteStage::Done,
            (WriteStage::Secure, _) => self.stage = WriteStage::Failed,
            (_, RunEvent::Failed(failure)) => self.give_up(failure.into()),
            (stage, event @ (RunEvent::Seen(_) | RunEvent::Obeyed | RunEvent::Secured)) => {
                debug_assert!(false, "{event:?} in {stage:?}");
            }
        }
    }

    fn seen(&mut self, at: LookAt, running: bool) {
        match (at, running) {
            (LookAt::Start, false) => self.write_next(),
            (LookAt::Start, true) if self.touched => self.set_running(),
            (LookAt::Start, true) => self.fail(ProgramError::Running),
            (LookAt::Refusal, true) if self.touched => self.set_running(),
            // It runs the old program, whole: it is left alone.
            (LookAt::Refusal, true) => self.fail(ProgramError::SetRunning),
            (LookAt::Refusal, false) => {
                self.failure = self.page_error.take();
                self.stage = WriteStage::Failed;
            }
            (LookAt::BetweenPages, false) => self.write_or_read_back(),
            (LookAt::BetweenPages, true) => self.set_running(),
            // This run has written nothing: another client has started the whole program.
            (LookAt::End, true) if self.written.is_empty() => self.stage = WriteStage::Done,
            (LookAt::End, true) => self.set_running(),
            // After a duplicate some pages are read back again.
            (LookAt::End, false) if !self.pending.is_empty() => self.write_next(),
            (LookAt::End, false) if self.options.run_again && self.control.is_run_due() => {
                self.stage = WriteStage::Run;
                self.control.run();
            }
            (LookAt::End, false) => self.stage = WriteStage::Done,
        }
    }

    // Write.

    fn write_next(&mut self) {
        self.page_error = None;
        let done = self.written.len();
        // Limit: both count pages, of which there are at most 1025.
        let total = done.saturating_add(self.pending.len());
        self.position = Position { phase: Phase::Writing, done, total };
        if done > 0 && done.is_multiple_of(LOOK_EVERY) && !self.pending.is_empty() {
            self.look(LookAt::BetweenPages);
        } else if self.pending.is_empty() && self.options.verify_all {
            self.stage = WriteStage::Verify(0);
        } else {
            self.write_or_read_back();
        }
    }

    /// Writes the next page, or reads it back if only that was not reliable.
    fn write_or_read_back(&mut self) {
        let left = self.options.attempts;
        match self.pending.last() {
            Some(&page) if self.to_read_back.contains(&page) => self.stage = WriteStage::ReadBack { page, left },
            Some(&page) => self.stage = WriteStage::Write { page, left },
            None => self.look(LookAt::End),
        }
    }

    fn wrote(&mut self, page: u16, left: u32, error: Option<Error>) {
        if error.as_ref().is_none_or(Error::may_have_executed) {
            (self.touched, self.in_doubt) = (true, Some(page));
        }
        // The page itself shows whether it was written.
        self.stage = WriteStage::ReadBack { page, left };
        let is_invalid = matches!(error, Some(Error::Invalid(_)));
        let is_refused = error.as_ref().is_some_and(|error| !error.may_have_executed() && error.error_code().is_some());
        self.page_error = error.map(|source| ProgramError::Call { action: ProgramAction::WritePage(page), source });
        if is_invalid {
            let error = self.page_error.take();
            self.fail(error.unwrap_or(ProgramError::NotTaken { page }));
        } else if is_refused {
            self.look(LookAt::Refusal);
        }
    }

    fn read_back(&mut self, page: u16, left: u32, content: &ProgramPage) {
        if self.program.page(page) == Some(content) {
            self.in_doubt = self.in_doubt.filter(|&in_doubt| in_doubt != page);
            self.pending.pop();
            self.to_read_back.remove(&page);
            self.written.push(page);
            self.unconfirmed = true;
            return self.write_next();
        }
        match left.checked_sub(1) {
            Some(left @ 1..) => self.stage = WriteStage::Write { page, left },
            Some(0) | None => self.give_up(ProgramError::NotTaken { page }),
        }
    }

    // Verify.

    fn verify(&mut self, page: u16, content: &ProgramPage) {
        if self.program.page(page) != Some(content) {
            self.comparisons.push((page, true));
        }
        let total = self.program.page_count();
        // A page number is below the count of pages.
        let next = page.saturating_add(1);
        self.position = Position { phase: Phase::Verifying, done: next.into(), total: total.into() };
        if next < total {
            self.stage = WriteStage::Verify(next);
            self.confirm_between(page, next);
        } else {
            self.to_confirm = Some(Pending::AllVerified);
        }
    }

    fn all_verified(&mut self) {
        for (page, _) in std::mem::take(&mut self.comparisons) {
            self.differing.push(page);
            self.written.retain(|&written| written != page);
            self.touched = true;
        }
        if self.differing.is_empty() {
            self.look(LookAt::End);
        } else {
            let pages = self.differing.clone();
            self.fail(ProgramError::Differs { pages });
        }
    }

    // Fail.

    /// The program does not fit this PLC, which therefore is not a half-written one.
    fn refuse(&mut self, error: ProgramError) {
        self.failure = Some(error);
        self.stage = WriteStage::Failed;
    }

    /// The run cannot continue. A half-written PLC is left only after its status was read again.
    fn fail(&mut self, error: ProgramError) {
        self.refuse(error);
        if self.goal == WriteGoal::Write && self.half_written() {
            self.stage = WriteStage::Secure;
            self.control.secure(false);
        }
    }

    /// No attempt succeeded: for the reason of the last one, or else for this one.
    fn give_up(&mut self, error: ProgramError) {
        let error = self.page_error.take().unwrap_or(error);
        self.fail(error);
    }

    /// Another client has started the PLC, which holds a part of the program.
    fn set_running(&mut self) {
        self.refuse(ProgramError::SetRunning);
        if self.goal == WriteGoal::Write {
            self.stage = WriteStage::Secure;
            self.control.secure(true);
        }
    }

    fn take_failure(&mut self) -> ProgramError {
        debug_assert!(self.failure.is_some(), "no failure in {:?}", self.stage);
        self.failure.take().unwrap_or(ProgramError::NotRunning)
    }
}

impl Transfer for Writing {
    type Mark = WriteMark;
    type Failure = ProgramError;

    fn next(&mut self) -> Result<Step, ProgramError> {
        if self.to_confirm.is_some() || self.control.must_confirm() {
            return Ok(Step::Confirm);
        }
        if let Some(request) = self.control.next() {
            return Ok(Step::Send(request));
        }
        let request = match self.stage {
            WriteStage::Fit => Request::DetailedStatus,
            WriteStage::Kind => Request::ReadPage(0),
            WriteStage::LastPage => Request::ReadPage(self.program.page_count().saturating_sub(1)),
            WriteStage::End(page)
            | WriteStage::Compare(page)
            | WriteStage::Verify(page)
            | WriteStage::ReadBack { page, .. } => Request::ReadPage(page),
            WriteStage::Write { page, .. } => match self.program.page(page) {
                Some(content) => {
                    Request::WritePage { page, content: content.clone(), timeout: self.options.page_timeout }
                }
                None => return Err(self.take_failure()),
            },
            WriteStage::Done => return Ok(Step::Done),
            // Run control has a request in the first three.
            WriteStage::Look(_) | WriteStage::Run | WriteStage::Secure | WriteStage::Failed => {
                return Err(self.take_failure());
            }
        };
        Ok(Step::Send(request))
    }

    fn mark(&self) -> WriteMark {
        WriteMark { stage: self.stage, compared: self.comparisons.len(), written: self.written.len() }
    }

    fn handle(&mut self, result: Result<Reply, Error>) -> Result<(), ProgramError> {
        if self.control.next().is_some() {
            if let Some(event) = self.control.handle(result) {
                self.controlled(event);
            }
            return Ok(());
        }
        match (self.stage, result) {
            (WriteStage::Write { page, left }, result) => self.wrote(page, left, result.err()),
            (WriteStage::End(page), Ok(Reply::Page(_))) => self.refuse(ProgramError::HasRefusedPage { page }),
            (WriteStage::End(_), Err(source)) if ends_the_ladder(&source) => self.stage = WriteStage::Kind,
            (WriteStage::Kind, Ok(Reply::Page(content))) => self.kind(&content),
            (WriteStage::LastPage, Ok(Reply::Page(_))) => self.write_all(),
            (WriteStage::Compare(page), Ok(Reply::Page(content))) => self.compare(page, &content),
            (WriteStage::ReadBack { page, left }, Ok(Reply::Page(content))) => self.read_back(page, left, &content),
            (WriteStage::Verify(page), Ok(Reply::Page(content))) => self.verify(page, &content),
            (_, Ok(Reply::DetailedStatus(status))) => self.fits(&status),
            (stage, Ok(reply)) => debug_assert!(false, "{reply:?} in {stage:?}"),
            (
                WriteStage::End(page)
                | WriteStage::Compare(page)
                | WriteStage::ReadBack { page, .. }
                | WriteStage::Verify(page),
                Err(source),
            ) => self.give_up(ProgramError::Call { action: ProgramAction::ReadPage(page), source }),
            (WriteStage::LastPage, Err(source)) => {
                let page = self.program.page_count().saturating_sub(1);
                self.give_up(ProgramError::Call { action: ProgramAction::ReadPage(page), source });
            }
            (WriteStage::Kind, Err(source)) => {
                self.give_up(ProgramError::Call { action: ProgramAction::ReadPage(0), source });
            }
            (_, Err(source)) => self.give_up(ProgramError::Call { action: ProgramAction::ReadStatus, source }),
        }
        Ok(())
    }

    fn confirmed(&mut self, result: Result<(), Error>) -> Result<(), ProgramError> {
        self.take_confirmation(result);
        Ok(())
    }

    fn rewind(&mut self, mark: WriteMark) {
        self.go_back(mark);
    }

    /// Pages written since the mark are in doubt.
    fn distrust(&mut self, first_held: WriteMark) {
        if self.goal == WriteGoal::Write {
            self.take_back(first_held.written);
        }
    }

    fn position(&self) -> Position {
        self.position
    }
}

#[cfg(all(test, feature = "sim"))]
mod tests;
