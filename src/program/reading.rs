//! Reading a program as a [`Transfer`], as the [module](super) draws it.

use std::time::SystemTime;

use super::header::page_count;
use super::{InvalidProgram, MIN_PAGES, Program, ProgramAction, ProgramError, ProgramHeader, ends_the_ladder};
use crate::command::{BriefStatus, DetailedStatus, ProgramPage};
use crate::error::Error;
use crate::file::{Origin, whole_seconds};
use crate::progress::Phase;
use crate::transfer::{HoldLimit, Position, Reply, Request, Step, Transfer};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum ReadStage {
    Brief,
    Status,
    Header,
    /// The first page that is missing.
    Pages,
    /// That page was refused: the last page of the stated size, which must be refused, too.
    Behind,
    /// The page before it is read again: the PLC must have it.
    Before,
    /// No page is missing; this one is read again.
    Again(u16),
    LastHeader,
    /// The ladder ends early: the page behind it must still be refused.
    StillRefused,
    LastStatus,
    Done,
}

/// Where a request stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct ReadMark {
    stage: ReadStage,
    pages: usize,
    again: u16,
    status_known: bool,
}

/// The most pages that are held before a check, so the most that a run that fails can lose.
const MAX_HELD: usize = 64;

/// The reading of a program, for all its runs. Confirmed pages stay when a run fails.
#[derive(Debug)]
pub(super) struct Reading {
    stage: ReadStage,
    limit: HoldLimit,
    /// The number of pages that are confirmed.
    confirmed: usize,
    status_confirmed: bool,
    /// The result, until it is confirmed.
    verdict: Option<Verdict>,
    /// `true` if all pages are read again and compared.
    pub(super) twice: bool,
    brief: Option<BriefStatus>,
    status: Option<DetailedStatus>,
    /// Pages without gaps, the header first.
    pages: Vec<ProgramPage>,
    /// Pages of this run that have been read again.
    again: u16,
    /// The refusal of the first page that is missing, until the last page is refused, too.
    refusal: Option<Error>,
}

/// The result of a reading.
#[derive(Debug)]
enum Verdict {
    Changed(Option<u16>),
    Invalid(InvalidProgram),
    /// The PLC refused the first page that is missing.
    Refused,
    Good,
}

impl Default for Reading {
    fn default() -> Self {
        Self {
            stage: ReadStage::Brief,
            limit: HoldLimit::new(MAX_HELD),
            confirmed: 0,
            status_confirmed: false,
            verdict: None,
            twice: false,
            brief: None,
            status: None,
            pages: Vec::new(),
            again: 0,
            refusal: None,
        }
    }
}

impl Reading {
    /// Begins a run. Pages that were not confirmed are dropped.
    pub(super) fn begin(&mut self) {
        if self.pages.len() > self.confirmed {
            self.limit.lower();
        }
        self.stage = ReadStage::Brief;
        self.again = 0;
        self.verdict = None;
        self.refusal = None;
        self.pages.truncate(self.confirmed);
        if !self.status_confirmed {
            self.status = None;
        }
    }

    /// The program, after [`Step::Done`]. The reading is as new then.
    pub(super) fn finish(&mut self, now: SystemTime) -> Result<Program, ProgramError> {
        let Self { brief, status, pages, .. } = std::mem::take(self);
        debug_assert!(brief.is_some() && status.is_some(), "both are read before page 0");
        let origin = Origin { read_at: Some(whole_seconds(now)), brief, detailed: status };
        Ok(Program { origin, ..Program::from_plc(pages)? })
    }

    /// Confirmed pages.
    pub(super) fn pages_done(&self) -> usize {
        self.confirmed
    }

    fn status(&mut self, status: DetailedStatus) {
        if self.status.as_ref().is_some_and(|known| identity(known) != identity(&status)) {
            self.verdict = Some(Verdict::Changed(None));
            return;
        }
        if self.stage == ReadStage::LastStatus {
            self.verdict = Some(Verdict::Good);
        } else {
            self.stage = ReadStage::Header;
        }
        // The first one is kept: it says whether the PLC ran when the reading began.
        self.status.get_or_insert(status);
    }

    fn page(&mut self, content: ProgramPage) {
        match self.stage {
            ReadStage::Header => self.header(content),
            ReadStage::Pages => {
                self.pages.push(content);
                self.stage = self.after_pages();
            }
            ReadStage::Again(page) => {
                if self.is_same(page, &content) {
                    self.again = page;
                    // A page number is below the count of pages.
                    let next = page.saturating_add(1);
                    self.stage = if next < self.total() { ReadStage::Again(next) } else { ReadStage::LastHeader };
                }
            }
            ReadStage::Before => {
                if self.is_same(self.first_missing().saturating_sub(1), &content) {
                    let page = self.first_missing();
                    tracing::info!(page, "the PLC refuses this page of its ladder, which ends before it");
                    self.stage = self.after_last_page();
                }
            }
            ReadStage::LastHeader => {
                if self.is_same(0, &content) {
                    self.again = self.total();
                    let is_whole = self.first_missing() == self.stated();
                    self.stage = if is_whole { ReadStage::LastStatus } else { ReadStage::StillRefused };
                }
            }
            // The refusal has passed: the ladder goes on.
            ReadStage::StillRefused => {
                self.pages.push(content);
                self.stage = self.after_pages();
            }
            ReadStage::Brief | ReadStage::Status | ReadStage::Behind | ReadStage::LastStatus | ReadStage::Done => {
                debug_assert!(false, "a page in {:?}", self.stage);
            }
        }
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
        self.stage = self.after_pages();
    }

    fn check_header(&self, content: &ProgramPage) -> Result<(), InvalidProgram> {
        let header = ProgramHeader::parse(content)?.ladder_words();
        match self.status.as_ref().map(DetailedStatus::ladder_words) {
            Some(status) if status != header => Err(InvalidProgram::Size { header, status }),
            Some(_) | None => Ok(()),
        }
    }

    fn after_pages(&self) -> ReadStage {
        if self.first_missing() < self.stated() { ReadStage::Pages } else { self.after_last_page() }
    }

    fn after_last_page(&self) -> ReadStage {
        if self.twice && self.pages.len() > 1 { ReadStage::Again(1) } else { ReadStage::LastHeader }
    }

    /// Returns whether a page is unchanged; if not, that is the verdict.
    fn is_same(&mut self, page: u16, content: &ProgramPage) -> bool {
        let same = self.pages.get(usize::from(page)) == Some(content);
        if !same {
            self.verdict = Some(Verdict::Changed(Some(page)));
        }
        same
    }

    /// Drops all pages: they belong to a program that is gone.
    fn forget(&mut self) {
        *self = Self { twice: self.twice, limit: self.limit, ..Self::default() };
    }

    fn first_missing(&self) -> u16 {
        // There are at most 1025 pages.
        u16::try_from(self.pages.len()).unwrap_or(u16::MAX)
    }

    /// The number of pages to read; 0 before the size is known. Once all are read, it is theirs: the memory
    /// may end before the size in 53.
    fn total(&self) -> u16 {
        match self.stage {
            ReadStage::Brief
            | ReadStage::Status
            | ReadStage::Header
            | ReadStage::Pages
            | ReadStage::Behind
            | ReadStage::Before => self.stated(),
            ReadStage::Again(_)
            | ReadStage::LastHeader
            | ReadStage::StillRefused
            | ReadStage::LastStatus
            | ReadStage::Done => self.first_missing(),
        }
    }

    /// The number of pages by the size in 53; 0 before it is known.
    fn stated(&self) -> u16 {
        self.status.as_ref().map_or(0, |status| page_count(status.ladder_words()))
    }

    /// The request of this stage; `None` if there is none left.
    fn request(&self) -> Option<Request> {
        Some(match self.stage {
            ReadStage::Brief => Request::Status,
            ReadStage::Status | ReadStage::LastStatus => Request::DetailedStatus,
            ReadStage::Header | ReadStage::LastHeader => Request::ReadPage(0),
            ReadStage::Pages | ReadStage::StillRefused => Request::ReadPage(self.first_missing()),
            ReadStage::Behind => Request::ReadPage(self.stated().saturating_sub(1)),
            ReadStage::Before => Request::ReadPage(self.first_missing().saturating_sub(1)),
            ReadStage::Again(page) => Request::ReadPage(page),
            ReadStage::Done => return None,
        })
    }

    /// Handles a failed request. A refusal may show the end of the memory.
    fn failed(&mut self, source: Error) -> Result<(), ProgramError> {
        let ends = ends_the_ladder(&source);
        match self.stage {
            ReadStage::Pages if ends && self.pages.len() >= MIN_PAGES => {
                self.refusal = Some(source);
                self.verdict = Some(Verdict::Refused);
            }
            ReadStage::Behind if ends => self.stage = ReadStage::Before,
            ReadStage::StillRefused if ends => self.stage = ReadStage::LastStatus,
            ReadStage::Brief
            | ReadStage::Status
            | ReadStage::Header
            | ReadStage::Pages
            | ReadStage::Behind
            | ReadStage::Before
            | ReadStage::Again(_)
            | ReadStage::LastHeader
            | ReadStage::StillRefused
            | ReadStage::LastStatus
            | ReadStage::Done => {
                let page = if let Some(Request::ReadPage(page)) = self.request() { Some(page) } else { None };
                let action = page.map_or(ProgramAction::ReadStatus, ProgramAction::ReadPage);
                return Err(ProgramError::Call { action, source });
            }
        }
        Ok(())
    }
}

impl Transfer for Reading {
    type Mark = ReadMark;
    type Failure = ProgramError;

    const KEEPS_PARTIAL: bool = true;

    fn next(&mut self) -> Result<Step, ProgramError> {
        debug_assert!(self.confirmed <= self.pages.len(), "confirmed pages are kept");
        let held = self.pages.len().saturating_sub(self.confirmed);
        if self.verdict.is_some() || self.limit.is_reached(held) {
            return Ok(Step::Confirm);
        }
        Ok(self.request().map_or(Step::Done, Step::Send))
    }

    fn mark(&self) -> ReadMark {
        let (pages, status_known) = (self.pages.len(), self.status.is_some());
        ReadMark { stage: self.stage, pages, again: self.again, status_known }
    }

    fn handle(&mut self, result: Result<Reply, Error>) -> Result<(), ProgramError> {
        match result {
            Ok(Reply::Status(brief)) => {
                self.brief = Some(brief);
                self.stage = ReadStage::Status;
            }
            Ok(Reply::DetailedStatus(status)) => self.status(status),
            // The PLC has pages behind the one that it refused.
            Ok(Reply::Page(_)) if self.stage == ReadStage::Behind => {
                debug_assert!(self.refusal.is_some(), "it led here");
                if let Some(source) = self.refusal.take() {
                    return Err(ProgramError::Call { action: ProgramAction::ReadPage(self.first_missing()), source });
                }
            }
            Ok(Reply::Page(content)) => self.page(content),
            Ok(reply @ (Reply::Values(_) | Reply::Disabled(_) | Reply::Done)) => {
                debug_assert!(false, "{reply:?} in {:?}", self.stage);
            }
            Err(source) => return self.failed(source),
        }
        Ok(())
    }

    fn confirmed(&mut self, result: Result<(), Error>) -> Result<(), ProgramError> {
        result.map_err(|source| ProgramError::Call { action: ProgramAction::Confirm, source })?;
        self.keep(None);
        self.limit.raise();
        match self.verdict.take() {
            Some(Verdict::Changed(page)) => {
                self.forget();
                return Err(ProgramError::Changed { page });
            }
            Some(Verdict::Invalid(error)) => {
                self.forget();
                return Err(error.into());
            }
            Some(Verdict::Refused) if self.first_missing().saturating_add(1) < self.stated() => {
                self.stage = ReadStage::Behind;
            }
            Some(Verdict::Refused) => self.stage = ReadStage::Before,
            Some(Verdict::Good) => self.stage = ReadStage::Done,
            None => {}
        }
        Ok(())
    }

    fn rewind(&mut self, mark: ReadMark) {
        let ReadMark { stage, pages, again, status_known } = mark;
        (self.stage, self.again, self.verdict) = (stage, again, None);
        self.pages.truncate(pages);
        self.confirmed = self.confirmed.min(pages);
        if !status_known {
            (self.status, self.status_confirmed) = (None, false);
        }
    }

    fn keep(&mut self, first_held: Option<ReadMark>) {
        self.confirmed = first_held.map_or(self.pages.len(), |mark| mark.pages.max(self.confirmed));
        self.status_confirmed |= self.status.is_some() && first_held.is_none_or(|mark| mark.status_known);
    }

    fn position(&self) -> Position {
        let is_again = self.twice && self.again > 0;
        let (phase, done) =
            if is_again { (Phase::Verifying, self.again) } else { (Phase::Reading, self.first_missing()) };
        Position { phase, done: done.into(), total: self.total().into() }
    }
}

/// The part of 53 that identifies PLC and program: type, points, version, ladder size.
fn identity(status: &DetailedStatus) -> (Option<u8>, u8, (u8, u8), u16) {
    let main_unit = status.raw().get(1).copied();
    (main_unit, status.io_points_code(), status.os_version(), status.ladder_words())
}

#[cfg(all(test, feature = "sim"))]
mod tests;
