//! The states of writing a program, as the [module](super) draws them. No I/O, and no clock.

mod confirm;
mod failing;
mod outcome;
mod states;

use std::collections::BTreeSet;

pub(super) use self::confirm::Mark;
use self::confirm::Then;
use self::states::State;
pub(super) use self::states::{Goal, Step, Told};
use super::{PlcState, Program, ProgramAction, ProgramError, ProgramHeader, WriteOptions};
use crate::command::{DetailedStatus, ProgramPage};
use crate::error::Error;
use crate::progress::Phase;

/// How often the PLC is told to stop or to run before that is given up.
const CONTROL_TRIES: u32 = 5;
/// After how many written pages it is looked at whether the PLC is still stopped.
const CHECK_EVERY: usize = 16;

/// A program that is being written.
#[derive(Debug)]
pub(super) struct Writing {
    program: Program,
    options: WriteOptions,
    goal: Goal,
    state: State,
    /// Whether it ran before it was first stopped here: of all runs of this writing.
    ran_before: bool,
    /// Whether it has been told to stop: of all runs of this writing.
    told_to_stop: bool,
    /// Whether it has been seen to obey: then these two stay so.
    has_stopped: bool,
    /// Whether a page has been written, or perhaps, since all were last found to be the program's: in all runs of this writing.
    touched: bool,
    /// The pages that earlier runs of this writing have written and read back, or that were found written since.
    written_before: BTreeSet<u16>,
    /// The pages that earlier runs have sent without having seen what became of them.
    doubted: BTreeSet<u16>,
    plc: PlcState,
    /// Whether it runs, and an earlier run of this writing has left a half there, stopped: unless somebody else has written the
    /// rest, it is to be stopped.
    suspect: bool,
    /// The page whose comparison is likely to tell that soonest: one that no earlier run has written.
    telling: u16,
    /// The pages that are still to be compared, the next one last.
    uncompared: Vec<u16>,
    /// Whether all pages have been compared in this run.
    compared: bool,
    /// The pages that are still to be written, the next one last.
    pending: Vec<u16>,
    /// The pages that have been compared in this run, and whether they differ. What follows from it waits until all are confirmed.
    looked_at: Vec<(u16, bool)>,
    /// All that was read is to be confirmed, and this follows.
    confirms: Option<Then>,
    /// The pages that have been written and read back in this run.
    written: Vec<u16>,
    /// Pages that were read back since the last check.
    unconfirmed: bool,
    /// Pages that have been written, and whose reading back may have brought another page: they are read back again before they are
    /// written again.
    to_read_back: BTreeSet<u16>,
    in_doubt: Option<u16>,
    /// Pages that were found to be others in the end.
    differing: Vec<u16>,
    /// Why the last attempt, to write a page, to stop or to run, had no answer; told if no further one does better.
    excuse: Option<ProgramError>,
    failure: Option<ProgramError>,
    progress: (Phase, usize, usize),
}

impl Writing {
    pub(super) fn new(program: Program, options: WriteOptions) -> Self {
        Self {
            program,
            options,
            goal: Goal::Write,
            state: State::Fit,
            ran_before: false,
            told_to_stop: false,
            has_stopped: false,
            touched: false,
            written_before: BTreeSet::new(),
            doubted: BTreeSet::new(),
            plc: PlcState::Unknown,
            suspect: false,
            telling: 0,
            uncompared: Vec::new(),
            compared: false,
            pending: Vec::new(),
            looked_at: Vec::new(),
            confirms: None,
            written: Vec::new(),
            unconfirmed: false,
            to_read_back: BTreeSet::new(),
            in_doubt: None,
            differing: Vec::new(),
            excuse: None,
            failure: None,
            progress: (Phase::Comparing, 0, 0),
        }
    }

    /// A run begins: the first, or another after a failure or when the last one was abandoned. It knows of those before
    /// whether the PLC ran, and what they have done to it; unless one has ended well, for then all is over.
    pub(super) fn begin(&mut self, goal: Goal) {
        let fresh = Self::new(self.program.clone(), self.options);
        let last = std::mem::replace(self, fresh);
        self.goal = goal;
        if last.goal == Goal::Write && last.state == State::Done {
            return;
        }
        let unwritten = last.unwritten().first().copied();
        self.telling =
            if last.compared { unwritten.or(last.in_doubt().first().copied()).unwrap_or(0) } else { last.telling };
        (self.ran_before, self.told_to_stop) = (last.ran_before, last.told_to_stop);
        self.has_stopped = last.has_stopped;
        self.touched = last.touched || !last.in_doubt().is_empty();
        self.doubted.extend(last.in_doubt());
        self.doubted.extend(last.doubted);
        self.written_before = last.written_before;
        self.written_before.extend(last.written);
    }

    /// Whether the last runs have left something that belongs to this one PLC: that it was told to stop, or written.
    pub(super) fn is_bound(&self) -> bool {
        let over = self.goal == Goal::Write && self.state == State::Done;
        let written = !self.written.is_empty() || !self.written_before.is_empty();
        !over && (self.told_to_stop || self.touched || !self.in_doubt().is_empty() || written)
    }

    pub(super) fn program(&self) -> &Program {
        &self.program
    }

    pub(super) fn options(&self) -> &WriteOptions {
        &self.options
    }

    /// What it is about, how many of its steps are done, and how many there are.
    pub(super) fn progress(&self) -> (Phase, usize, usize) {
        self.progress
    }

    pub(super) fn next(&self) -> Step {
        if self.confirms.is_some() {
            return Step::Confirm;
        }
        match self.state {
            State::Fit => Step::Status,
            State::Kind => Step::Read(0),
            State::Compare(page) | State::Verify(page) => Step::Read(page),
            State::Look
            | State::Stopped { .. }
            | State::Refused
            | State::Check
            | State::Final
            | State::Running { .. }
            | State::LastLook
            | State::StoppedAgain { .. } => Step::Flags,
            State::Stop { .. } | State::StopAgain { .. } => Step::Stop,
            State::StopPause { .. } | State::RunPause { .. } | State::StopAgainPause { .. } => Step::Pause,
            State::Write { .. } => self.pending.last().map_or(Step::Failed, |&page| Step::Write(page)),
            State::ReadBack { .. } => self.pending.last().map_or(Step::Failed, |&page| Step::Read(page)),
            State::Run { .. } => Step::Run,
            State::Done => Step::Done,
            State::Failed => Step::Failed,
        }
    }

    /// Takes what came of the [next step](Self::next).
    pub(super) fn told(&mut self, result: Result<Told, Error>) {
        match (self.state, result) {
            (State::Write { left }, result) => self.wrote(left, result.map(drop)),
            // Whether it has obeyed is asked, whatever it has answered.
            (State::Stop { left }, result) => self.stopping(left, result.map(drop)),
            (State::StopAgain { left }, result) => {
                self.controlled(&result.map(drop));
                self.state = State::StoppedAgain { left };
            }
            (State::Run { left }, result) => self.ran(left, result.map(drop)),
            (State::StopPause { left }, _) => self.stop(left),
            (State::RunPause { left }, _) => self.state = State::Run { left },
            (State::StopAgainPause { left }, _) => self.state = State::StopAgain { left },
            (_, Ok(Told::Status(status))) => self.fits(&status),
            (_, Ok(Told::Flags(flags))) => self.confirms = Some(Then::Flags(flags.running())),
            (_, Ok(Told::Page(page))) => self.read(&page),
            (_, Ok(Told::Done)) => {}
            (_, Err(error)) => self.lost(error),
        }
    }

    /// Whether all pages have been found to be the program's, in this run.
    fn whole(&self) -> bool {
        let good = self.pending.is_empty() && self.looked_at.is_empty() && self.differing.is_empty();
        self.compared && good && !self.unconfirmed
    }

    /// Whether the PLC may hold a part of the new program and a part of the old one, by this writing.
    fn half_written(&self) -> bool {
        self.touched && !self.whole()
    }

    // What the replies mean.

    fn fits(&mut self, status: &DetailedStatus) {
        let (program, plc) = (self.program.ladder_words(), status.ladder_words());
        self.saw(status.flags().running());
        if program != plc {
            return self.fail(ProgramError::SizeMisfit { program, plc });
        }
        if status.flags().memory_card() && self.goal != Goal::Compare {
            return self.fail(ProgramError::MemoryCard);
        }
        self.suspect = self.plc == PlcState::Running && self.touched;
        if !self.may_go_on_while_running() {
            self.fail(ProgramError::Running);
        } else {
            self.state = State::Kind;
        }
    }

    /// Whether it is no obstacle that the PLC runs, if it does.
    fn may_go_on_while_running(&self) -> bool {
        self.plc != PlcState::Running || self.suspect || self.options.stop_first || self.goal == Goal::Compare
    }

    fn read(&mut self, content: &ProgramPage) {
        match self.state {
            State::Kind => self.kind(content),
            State::Compare(page) => self.compare(page, content),
            State::ReadBack { left } => self.read_back(left, content),
            State::Verify(page) => self.verify(page, content),
            _ => {}
        }
    }

    /// A PLC whose own header is none cannot say what kind it is; it is just what a program may be written for.
    fn kind(&mut self, content: &ProgramPage) {
        let program = self.program.header().kind();
        match ProgramHeader::parse(content) {
            Ok(header) if header.kind() != program => {
                self.fail(ProgramError::KindMisfit { program, plc: header.kind() });
            }
            // What an earlier run has written may be another since: that is compared.
            _ if self.writes_all() && self.written_before.is_empty() => {
                self.pending = (0..self.program.header().page_count()).collect();
                self.confirms = Some(Then::Compared);
            }
            _ => {
                self.uncompared = (1..self.program.header().page_count()).rev().collect();
                self.uncompared.sort_by_key(|&page| page >= self.telling);
                self.compare(0, content);
            }
        }
    }

    fn writes_all(&self) -> bool {
        self.options.all_pages && self.goal != Goal::Compare && !self.suspect
    }

    fn compare(&mut self, page: u16, content: &ProgramPage) {
        let differs = self.program.page(page) != Some(content);
        self.looked_at.push((page, differs));
        let count = usize::from(self.program.header().page_count());
        self.progress = (Phase::Comparing, count.saturating_sub(self.uncompared.len()), count);
        if differs && self.suspect && self.goal != Goal::Compare {
            self.confirms = Some(Then::SetRunning);
            return;
        }
        match self.uncompared.pop() {
            Some(next) => {
                self.state = State::Compare(next);
                self.confirm_between(page, next);
            }
            None => self.confirms = Some(Then::Compared),
        }
    }

    fn is_to_be_written(&self, (page, differs): (u16, bool)) -> bool {
        differs || self.writes_all() && !self.written_before.contains(&page)
    }

    /// Two pages in a row that should be equal are read with a check between them.
    fn confirm_between(&mut self, page: u16, next: u16) {
        if self.program.page(page) == self.program.page(next) {
            self.confirms = Some(Then::NextPage);
        }
    }

    /// What was compared is confirmed.
    fn sort_out(&mut self) {
        for (page, differs) in std::mem::take(&mut self.looked_at) {
            if self.is_to_be_written((page, differs)) {
                self.pending.push(page);
            } else if self.doubted.remove(&page) {
                self.written_before.insert(page);
            }
        }
    }

    fn all_compared(&mut self) {
        self.sort_out();
        self.compared = true;
        // Found whole, by whomever.
        self.touched &= !self.pending.is_empty();
        // Taken from the end: the ladder in ascending order, and the header last.
        self.pending.sort_unstable_by(|page, next| next.cmp(page));
        if self.pending.last() == Some(&0) {
            self.pending.rotate_right(1);
        }
        self.state = match (self.goal, self.pending.is_empty()) {
            (Goal::Compare | Goal::DryRun, _) => State::Done,
            (Goal::Write, false) => State::Look,
            // An earlier run has stopped it, and may have got no further than the last page.
            (Goal::Write, true) if self.told_to_stop => State::Final,
            (Goal::Write, true) => State::Done,
        };
    }

    fn flags(&mut self, running: bool) {
        self.saw(running);
        match self.state {
            State::Look if !running => self.write_next(),
            State::Look if self.touched && !self.options.stop_first => self.stop_again(),
            State::Look if !self.options.stop_first => self.fail(ProgramError::Running),
            State::Look => {
                self.stop(CONTROL_TRIES);
            }
            State::Stopped { .. } if !running => self.write_next(),
            State::Stopped { left } => match left.checked_sub(1) {
                Some(left @ 1..) => self.state = State::StopPause { left },
                _ => self.give_up(ProgramError::StillRunning),
            },
            State::Refused if running && self.touched => self.stop_again(),
            // It runs the old program, whole: that is left alone.
            State::Refused if running => self.fail(ProgramError::SetRunning),
            State::Refused => {
                self.failure = self.excuse.take();
                self.state = State::Failed;
            }
            State::Check if !running => self.state = self.write_or_read_back(),
            State::Check => self.stop_again(),
            // Nothing was written in this run: somebody has set the whole program running.
            State::Final if running && self.written.is_empty() => self.state = State::Done,
            State::Final if running => self.stop_again(),
            // After a duplicate some are read back again.
            State::Final if !self.pending.is_empty() => self.write_next(),
            State::Final if self.options.run_again && self.ran_before => {
                self.state = State::Run { left: CONTROL_TRIES };
            }
            State::Final => self.state = State::Done,
            State::Running { .. } if running => self.state = State::Done,
            State::Running { left } => match left.checked_sub(1) {
                Some(left @ 1..) => self.state = State::RunPause { left },
                _ => self.give_up(ProgramError::NotRunning),
            },
            State::LastLook if !running => self.state = State::Failed,
            State::LastLook => self.state = State::StopAgain { left: CONTROL_TRIES },
            State::StoppedAgain { left } => {
                let left = left.saturating_sub(1);
                self.state = if running && left > 0 { State::StopAgainPause { left } } else { State::Failed };
            }
            _ => {}
        }
    }

    fn saw(&mut self, running: bool) {
        self.plc = if running { PlcState::Running } else { PlcState::Stopped };
        if running {
            self.not_stopped();
        } else {
            self.has_stopped |= self.told_to_stop;
        }
    }

    fn stop(&mut self, left: u32) {
        // Said before it is told to: whoever drops the future then does not know whether it has heard that.
        (self.told_to_stop, self.ran_before) = (true, true);
        self.state = State::Stop { left };
    }

    /// The last STOP did nothing: who has stopped it if it is stopped later was somebody else.
    fn not_stopped(&mut self) {
        (self.told_to_stop, self.ran_before) = (self.has_stopped, self.has_stopped);
    }

    /// It was told to stop or to run. Unless that has certainly done nothing, its state is not known now.
    fn controlled(&mut self, result: &Result<(), Error>) {
        if result.as_ref().err().is_none_or(Error::may_have_executed) {
            self.plc = PlcState::Unknown;
        }
    }

    fn stopping(&mut self, left: u32, result: Result<(), Error>) {
        self.controlled(&result);
        if result.as_ref().is_err_and(|error| !error.may_have_executed()) {
            self.not_stopped();
        }
        self.excuse = result.err().map(|source| ProgramError::Call { action: ProgramAction::Stop, source });
        self.state = State::Stopped { left };
    }

    fn write_next(&mut self) {
        self.excuse = None;
        let all = self.written.len().saturating_add(self.pending.len());
        self.state = match self.pending.last() {
            None if self.options.verify_all => State::Verify(0),
            None => State::Final,
            Some(_) if !self.written.is_empty() && self.written.len().is_multiple_of(CHECK_EVERY) => State::Check,
            Some(_) => self.write_or_read_back(),
        };
        self.progress = (Phase::Writing, self.written.len(), all);
    }

    /// The next page is written, unless it has been and only its reading back was not good.
    fn write_or_read_back(&self) -> State {
        let left = self.options.attempts;
        match self.pending.last() {
            Some(page) if self.to_read_back.contains(page) => State::ReadBack { left },
            Some(_) | None => State::Write { left },
        }
    }

    fn wrote(&mut self, left: u32, result: Result<(), Error>) {
        let page = self.pending.last().copied().unwrap_or_default();
        let sent = result.as_ref().err().is_none_or(Error::may_have_executed);
        if sent {
            (self.touched, self.in_doubt) = (true, Some(page));
        }
        match result {
            Ok(()) => self.excuse = None,
            Err(source) => {
                let refused = !source.may_have_executed() && source.error_code().is_some();
                let invalid = matches!(source, Error::Invalid(_));
                let error = ProgramError::Call { action: ProgramAction::WritePage(page), source };
                if invalid {
                    return self.fail(error);
                }
                self.excuse = Some(error);
                if refused {
                    self.state = State::Refused;
                    return;
                }
            }
        }
        // What has become of it, the page itself tells.
        self.state = State::ReadBack { left };
    }

    fn read_back(&mut self, left: u32, content: &ProgramPage) {
        let Some(&page) = self.pending.last() else { return };
        if self.program.page(page) == Some(content) {
            self.in_doubt = self.in_doubt.filter(|&in_doubt| in_doubt != page);
            self.pending.pop();
            self.to_read_back.remove(&page);
            self.written.push(page);
            self.unconfirmed = true;
            return self.write_next();
        }
        match left.checked_sub(1) {
            Some(left @ 1..) => self.state = State::Write { left },
            _ => self.give_up(ProgramError::NotTaken { page }),
        }
    }

    fn verify(&mut self, page: u16, content: &ProgramPage) {
        if self.program.page(page) != Some(content) {
            self.looked_at.push((page, true));
        }
        let (next, count) = (page.saturating_add(1), self.program.header().page_count());
        self.progress = (Phase::Verifying, next.into(), count.into());
        if next < count {
            self.state = State::Verify(next);
            self.confirm_between(page, next);
        } else {
            self.confirms = Some(Then::Verified);
        }
    }

    /// All have been read once more, and that is confirmed.
    fn verified(&mut self) {
        for (page, _) in std::mem::take(&mut self.looked_at) {
            self.differing.push(page);
            self.written.retain(|&written| written != page);
            self.touched = true;
        }
        if self.differing.is_empty() {
            self.state = State::Final;
        } else {
            let pages = self.differing.clone();
            self.fail(ProgramError::Differs { pages });
        }
    }

    fn ran(&mut self, left: u32, result: Result<(), Error>) {
        match result {
            Err(Error::Plc { error, repeated: false, .. }) => {
                self.failure = Some(ProgramError::RunRefused { error });
                self.state = State::Failed;
            }
            // An answer or none: its status tells.
            result => {
                self.controlled(&result);
                self.excuse = result.err().map(|source| ProgramError::Call { action: ProgramAction::Run, source });
                self.state = State::Running { left };
            }
        }
    }
}

#[cfg(all(test, feature = "sim"))]
mod tests;
