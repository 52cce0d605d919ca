//! The states of reading a program, as the [module](super) draws them. No I/O, and no clock.

use std::time::SystemTime;

use super::header::page_count;
use super::{InvalidProgram, Origin, Program, ProgramError, ProgramHeader};
use crate::command::{BriefStatus, DetailedStatus, ProgramPage};
use crate::progress::Phase;

/// What is to be done next.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Step {
    /// Ask for 40, and say [`Reading::brief`].
    Brief,
    /// Ask for 53, and say [`Reading::status`].
    Status,
    /// Ask for this page, and say [`Reading::page`].
    Page(u16),
    /// Confirm all that was read, and say [`Reading::confirmed`].
    Confirm,
    /// Take the program.
    Done,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    Brief,
    Status,
    Header,
    /// The first page that is not there yet.
    Pages,
    /// All are there; this one is read again.
    Again(u16),
    LastHeader,
    LastStatus,
    Done,
}

/// Where a request stands: a reading can go back there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Mark {
    state: State,
    pages: usize,
    again: u16,
    status_known: bool,
}

/// The most pages that are held: then a check confirms them. A run that is broken off loses no more than these.
const MOST_HELD: usize = 64;

/// A program that is being read. What has been read and confirmed stays when a request fails; [`begin`](Self::begin) then goes on.
#[derive(Debug)]
pub(super) struct Reading {
    state: State,
    /// The most pages that are held now.
    most_held: usize,
    /// The pages that are confirmed.
    confirmed: usize,
    /// The status is confirmed.
    status_confirmed: bool,
    /// All that was read is to be confirmed, and this follows.
    verdict: Option<Verdict>,
    /// Whether all pages are read once more, and compared.
    pub(super) twice: bool,
    brief: Option<BriefStatus>,
    status: Option<DetailedStatus>,
    /// What has been read, the header first, without gaps.
    pages: Vec<ProgramPage>,
    /// Pages of this run that have been read once more.
    again: u16,
}

/// What follows when all that was read is confirmed.
#[derive(Debug)]
enum Verdict {
    /// The program cannot be taken.
    Changed(Option<u16>),
    Invalid(InvalidProgram),
    /// It can be taken.
    Good,
}

impl Default for Reading {
    fn default() -> Self {
        Self {
            state: State::Brief,
            most_held: MOST_HELD,
            confirmed: 0,
            status_confirmed: false,
            verdict: None,
            twice: false,
            brief: None,
            status: None,
            pages: Vec::new(),
            again: 0,
        }
    }
}

impl Reading {
    /// A run begins: the first, or another after a failure. Pages that were not confirmed are dropped; after that, fewer are held
    /// at a time, so that short runs keep something, too.
    pub(super) fn begin(&mut self) {
        if self.pages.len() > self.confirmed {
            self.most_held = self.most_held.checked_div(4).unwrap_or(1).max(1);
        }
        self.state = State::Brief;
        self.again = 0;
        self.verdict = None;
        self.pages.truncate(self.confirmed);
        if !self.status_confirmed {
            self.status = None;
        }
    }

    pub(super) fn next(&self) -> Step {
        let full = self.pages.len().saturating_sub(self.confirmed) >= self.most_held;
        if self.verdict.is_some() || full {
            return Step::Confirm;
        }
        match self.state {
            State::Brief => Step::Brief,
            State::Status | State::LastStatus => Step::Status,
            State::Header | State::LastHeader => Step::Page(0),
            State::Pages => Step::Page(self.first_missing()),
            State::Again(page) => Step::Page(page),
            State::Done => Step::Done,
        }
    }

    /// The mark of what is asked for now.
    pub(super) fn mark(&self) -> Mark {
        let (pages, status_known) = (self.pages.len(), self.status.is_some());
        Mark { state: self.state, pages, again: self.again, status_known }
    }

    /// All before this mark is confirmed; `None`: all.
    pub(super) fn confirmed_before(&mut self, first_held: Option<Mark>) {
        self.confirmed = first_held.map_or(self.pages.len(), |mark| mark.pages.max(self.confirmed));
        self.status_confirmed |= self.status.is_some() && first_held.is_none_or(|mark| mark.status_known);
    }

    /// Results from this mark on are not good: goes back to it.
    pub(super) fn rewind(&mut self, mark: Mark) {
        let Mark { state, pages, again, status_known } = mark;
        (self.state, self.again, self.verdict) = (state, again, None);
        self.pages.truncate(pages);
        self.confirmed = self.confirmed.min(pages);
        if !status_known {
            (self.status, self.status_confirmed) = (None, false);
        }
    }

    /// All that was read is confirmed.
    ///
    /// # Errors
    /// Why the program cannot be taken. Nothing is kept then.
    pub(super) fn confirmed(&mut self) -> Result<(), ProgramError> {
        self.confirmed_before(None);
        self.most_held = self.most_held.saturating_mul(2).min(MOST_HELD);
        match self.verdict.take() {
            Some(Verdict::Changed(page)) => {
                self.forget();
                Err(ProgramError::Changed { page })
            }
            Some(Verdict::Invalid(error)) => {
                self.forget();
                Err(error.into())
            }
            Some(Verdict::Good) => {
                self.state = State::Done;
                Ok(())
            }
            None => Ok(()),
        }
    }

    pub(super) fn brief(&mut self, brief: BriefStatus) {
        self.brief = Some(brief);
        self.state = State::Status;
    }

    pub(super) fn status(&mut self, status: DetailedStatus) {
        if self.status.as_ref().is_some_and(|known| identity(known) != identity(&status)) {
            self.verdict = Some(Verdict::Changed(None));
            return;
        }
        if self.state == State::LastStatus {
            self.verdict = Some(Verdict::Good);
        } else {
            self.state = State::Header;
        }
        // The first one is kept: it tells whether the PLC ran when the reading began.
        self.status.get_or_insert(status);
    }

    pub(super) fn page(&mut self, content: ProgramPage) {
        match self.state {
            State::Header => self.header(content),
            State::Pages => {
                self.pages.push(content);
                self.state = self.behind_pages();
            }
            State::Again(page) => {
                if self.is_same(page, &content) {
                    self.again = page;
                    let next = page.saturating_add(1);
                    self.state = if next < self.total() { State::Again(next) } else { State::LastHeader };
                }
            }
            State::LastHeader => {
                if self.is_same(0, &content) {
                    self.again = self.total();
                    self.state = State::LastStatus;
                }
            }
            State::Brief | State::Status | State::LastStatus | State::Done => {}
        }
    }

    /// The program, when all is done; nothing is left here then.
    pub(super) fn finish(&mut self, now: SystemTime) -> Result<Program, ProgramError> {
        let Self { brief, status, pages, .. } = std::mem::take(self);
        let program = Program::from_pages(pages)?;
        Ok(match (brief, status) {
            (Some(brief), Some(status)) => program.with_origin(Origin { brief, status, read_at: whole_seconds(now) }),
            _ => program,
        })
    }

    /// What it is about, how many of its steps are done, and how many there are. There are none before the size is known.
    pub(super) fn progress(&self) -> (Phase, usize, usize) {
        let total = self.total();
        let again = self.twice && self.again > 0;
        let (phase, done) = if again { (Phase::Verifying, self.again) } else { (Phase::Reading, self.first_missing()) };
        (phase, done.into(), total.into())
    }

    /// Pages that have been read and confirmed: they are kept if the run ends now.
    pub(super) fn pages_done(&self) -> usize {
        self.confirmed
    }

    fn header(&mut self, content: ProgramPage) {
        if self.pages.is_empty() {
            if let Err(error) = self.check_header(&content) {
                self.verdict = Some(Verdict::Invalid(error));
                return;
            }
            self.pages.push(content);
        } else if !self.is_same(0, &content) {
            return;
        }
        self.state = self.behind_pages();
    }

    fn check_header(&self, content: &ProgramPage) -> Result<(), InvalidProgram> {
        let header = ProgramHeader::parse(content)?.ladder_words();
        match self.status.as_ref().map(DetailedStatus::ladder_words) {
            Some(status) if status != header => Err(InvalidProgram::Size { header, status }),
            _ => Ok(()),
        }
    }

    fn behind_pages(&self) -> State {
        match (self.first_missing() < self.total(), self.twice && self.total() > 1) {
            (true, _) => State::Pages,
            (false, true) => State::Again(1),
            (false, false) => State::LastHeader,
        }
    }

    /// Whether a page is still the same; if not, that is the verdict.
    fn is_same(&mut self, page: u16, content: &ProgramPage) -> bool {
        let same = self.pages.get(usize::from(page)) == Some(content);
        if !same {
            self.verdict = Some(Verdict::Changed(Some(page)));
        }
        same
    }

    /// What has been read belongs to nothing that there is now.
    fn forget(&mut self) {
        *self = Self { twice: self.twice, most_held: self.most_held, ..Self::default() };
    }

    fn first_missing(&self) -> u16 {
        u16::try_from(self.pages.len()).unwrap_or(u16::MAX)
    }

    fn total(&self) -> u16 {
        self.status.as_ref().map_or(0, |status| page_count(status.ladder_words()))
    }
}

/// What of 53 belongs to the PLC and its program, and to nothing that comes and goes: type, points, version, ladder size.
fn identity(status: &DetailedStatus) -> (u8, u8, (u8, u8), u16) {
    let main_unit = status.raw().get(1).copied().unwrap_or_default();
    (main_unit, status.io_points_code(), status.os_version(), status.ladder_words())
}

fn whole_seconds(time: SystemTime) -> SystemTime {
    let fraction = time.duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().subsec_nanos();
    time.checked_sub(std::time::Duration::from_nanos(fraction.into())).unwrap_or(time)
}

#[cfg(all(test, feature = "sim"))]
mod tests;
