//! Restoring a backup as a [`Transfer`], as the [module](super) draws it: compare, write, verify.

mod control;
mod origin;
mod report;

use std::ops::Range;

use self::ElementStage::{Check, Compare, Forced, Verify, Write};
use self::control::ControlStage::{self, LastLook, Look};
use super::block::{Chunk, Chunks, discretes, is_never_restored, runs, runs_of_values};
use super::options::{IfRunning, RestoreOptions, SpecialElements};
use super::target::{ElementState, Target, TargetElement};
use super::{Backup, Difference, MissingRange, RestoreFailure};
use crate::command::{RequestLengths, Value};
use crate::error::{Error, ErrorCode};
use crate::file::{Origin, PlcDifference};
use crate::progress::Phase;
use crate::tag::Tag;
use crate::transfer::{Position, Reply, Request, RunControl, Step, Transfer};

/// The purpose of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RestoreGoal {
    /// Change nothing.
    Compare,
    Restore,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum RestoreStage {
    Control(ControlStage),
    Elements(ElementStage),
    Done,
}

/// A stage that reads or writes elements.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ElementStage {
    Compare,
    Forced,
    Write,
    /// The result of a write without a reply.
    Check,
    Verify,
}

impl ElementStage {
    /// Returns whether it is left only when all replies are confirmed. Replies may be shorter.
    fn only_reads(self) -> bool {
        matches!(self, Self::Compare | Self::Forced | Self::Verify)
    }

    /// The action on a chunk, for an error.
    fn doing(self, chunk: Chunk) -> String {
        match self {
            Self::Compare | Self::Check | Self::Verify => format!("reading {}", chunk.tag()),
            Self::Forced => format!("reading which of {} are forced", chunk.tag()),
            Self::Write => format!("writing {}", chunk.tag()),
        }
    }
}

/// An action that waits for a check, besides a status of run control.
#[derive(Clone, Debug)]
enum Pending {
    /// The stage is to be left.
    Leave,
    /// A write without a reply has been read back.
    Checked(Vec<Value>),
}

/// The restoring of one backup, for all its runs.
#[derive(Clone, Debug)]
pub(super) struct Restoring {
    options: RestoreOptions,
    /// The PLC that was read.
    station: Option<u8>,
    origin: Origin,
    /// How the PLC of this run differs from it.
    other_plc: Vec<PlcDifference>,
    targets: Vec<Target>,
    /// Ranges that are compared and never written.
    left_out: Vec<Target>,
    missing: Vec<MissingRange>,
    /// Special elements that are not to be written.
    special: Vec<Tag>,
    goal: RestoreGoal,
    stage: RestoreStage,
    control: RunControl,
    /// The requests that are left in this stage.
    chunks: Chunks,
    /// The longest requests of this run.
    lengths: RequestLengths,
    /// Elements of this stage, and those that are settled.
    total: usize,
    done: usize,
    /// States of the elements before the last write of them was sent.
    before: Vec<ElementState>,
    /// Attempts at the same write without a reply or an effect.
    tries: u32,
    to_confirm: Option<Pending>,
    remaining: Vec<Difference>,
}

impl Restoring {
    pub(super) fn new(backup: &Backup, options: RestoreOptions) -> Self {
        let (left_out, restored): (Vec<_>, Vec<_>) =
            backup.blocks.iter().partition(|block| is_never_restored(block.range));
        let mut targets: Vec<_> = restored.into_iter().map(Target::new).collect();
        let mut special: Vec<_> = targets.iter().flat_map(Target::special).collect();
        match options.special {
            SpecialElements::Refuse => {}
            SpecialElements::Skip => targets.iter_mut().for_each(Target::skip_special),
            SpecialElements::Write => special.clear(),
        }
        Self {
            options,
            station: backup.station,
            origin: backup.origin.clone(),
            other_plc: Vec::new(),
            targets,
            left_out: left_out.into_iter().map(Target::new).collect(),
            missing: backup.missing(),
            special,
            goal: RestoreGoal::Compare,
            stage: RestoreStage::Done,
            control: RunControl::new(options.attempts),
            chunks: Chunks::EMPTY,
            lengths: RequestLengths::PROTOCOL,
            total: 0,
            done: 0,
            before: Vec::new(),
            tries: 0,
            to_confirm: None,
            remaining: Vec::new(),
        }
    }

    /// Begins a run with requests of these lengths. Unless the last one succeeded, it inherits whether
    /// the PLC was stopped.
    pub(super) fn begin(&mut self, goal: RestoreGoal, lengths: RequestLengths) {
        self.lengths = lengths;
        self.control.begin(self.is_over());
        self.forget();
        self.remaining.clear();
        self.other_plc.clear();
        self.to_confirm = None;
        self.goal = goal;
        // A comparison does not depend on whether the PLC runs.
        let looks = goal == RestoreGoal::Restore || self.options.if_running != IfRunning::Continue;
        if looks {
            self.control(Look);
        } else {
            self.read_or_write(Compare);
        }
    }

    /// Returns whether earlier runs have left something in their PLC: a STOP.
    pub(super) fn is_bound(&self) -> bool {
        self.control.was_stopped() && !self.is_over()
    }

    fn is_over(&self) -> bool {
        self.goal == RestoreGoal::Restore && self.stage == RestoreStage::Done
    }

    /// Enters a stage that reads or writes elements.
    fn read_or_write(&mut self, stage: ElementStage) {
        self.stage = RestoreStage::Elements(stage);
        self.control.cancel();
        let is_unknown = |element: &TargetElement| element.state == ElementState::Unknown;
        let is_verified = |element: &TargetElement| element.wanted.is_some() && element.state != ElementState::Forced;
        let wanted = |target: &Target| match stage {
            Compare => runs(&target.elements, is_unknown),
            Forced if self.options.write_forced || discretes(target.range).is_none() => Vec::new(),
            Forced => target.differing(),
            Write | Check => target.to_write(self.options.bridge, self.lengths),
            Verify => runs(&target.elements, is_verified),
        };
        // They come after the others, as in `all`, whose numbers chunks have.
        let left_out = self.left_out.iter().filter(|_| (stage, self.goal) == (Compare, RestoreGoal::Compare));
        let targets = self.targets.iter().chain(left_out).enumerate();
        let runs =
            targets.flat_map(|(block, target)| wanted(target).into_iter().map(move |run| (block, target.range, run)));
        self.queue(runs.collect());
    }

    fn queue(&mut self, runs: Vec<(usize, Tag, Range<usize>)>) {
        (self.tries, self.done) = (0, 0);
        self.total = runs.iter().map(|(_, _, run)| run.len()).sum();
        self.chunks = Chunks::new(runs, self.lengths);
    }

    // Compare, write, verify.

    fn handle_chunk(
        &mut self,
        stage: ElementStage,
        chunk: Chunk,
        reply: Result<Reply, Error>,
    ) -> Result<(), RestoreFailure> {
        match (stage, reply) {
            (Compare, Ok(Reply::Values(values))) => {
                let chunk = chunk.first(values.len());
                for (element, value) in self.elements(chunk).iter_mut().zip(values) {
                    let is_same = element.wanted == Some(value);
                    element.found = Some(value);
                    element.state = if is_same { ElementState::Same } else { ElementState::Differs };
                }
                self.settled(chunk);
            }
            (Compare, Err(Error::Plc { error, .. })) => self.mark_refused(ElementState::NotGiven(error)),
            (Forced, Ok(Reply::Disabled(disabled))) => {
                let per_value = chunk.range.elements_per_value().max(1);
                let values = chunk.count.div_ceil(per_value);
                // Discretes of one value.
                let discretes = disabled.len().checked_div(values).unwrap_or(1).max(1);
                for (value, disabled) in self.elements(chunk).chunks_mut(per_value).zip(disabled.chunks(discretes)) {
                    if disabled.contains(&true) {
                        value.iter_mut().for_each(|element| element.state = ElementState::Forced);
                    }
                }
                self.settled(chunk);
            }
            (Write, Ok(_)) => {
                self.elements(chunk).iter_mut().for_each(|element| element.state = ElementState::Written);
                self.tries = 0;
                self.settled(chunk);
            }
            (Write, Err(error)) => return self.not_written(chunk, error),
            (Check, Ok(Reply::Values(values))) => self.to_confirm = Some(Pending::Checked(values)),
            (Verify, Ok(Reply::Values(values))) => {
                let chunk = chunk.first(values.len());
                self.verified(chunk, values.into_iter().map(Some));
                self.settled(chunk);
            }
            (Verify, Err(Error::Plc { .. })) => {
                if let Some(single) = self.refused() {
                    self.verified(single, std::iter::repeat(None));
                }
            }
            (stage, Err(source)) => return Err(RestoreFailure::Call { doing: stage.doing(chunk), source }),
            (stage, Ok(reply)) => debug_assert!(false, "{reply:?} in {stage:?}"),
        }
        Ok(())
    }

    fn not_written(&mut self, chunk: Chunk, error: Error) -> Result<(), RestoreFailure> {
        let doing = Write.doing(chunk);
        if let Error::Plc { error, repeated: false, .. } = error
            // The PLC takes no write at all: its elements need not be tried one by one.
            && error != ErrorCode::WriteProhibited
        {
            self.unsent(chunk);
            self.mark_refused(ElementState::NotTaken(error));
            return Ok(());
        }
        if error.may_have_executed() {
            // Counted up to the limit only.
            self.tries = self.tries.saturating_add(1);
            if self.tries >= self.options.attempts {
                return Err(RestoreFailure::Call { doing, source: error });
            }
            self.stage = RestoreStage::Elements(Check);
            return Ok(());
        }
        self.unsent(chunk);
        Err(RestoreFailure::Call { doing, source: error })
    }

    /// A write without a reply has been read back.
    fn checked(&mut self, chunk: Chunk, values: &[Value]) {
        for (element, &value) in self.elements(chunk).iter_mut().zip(values) {
            element.state = if element.wanted == Some(value) { ElementState::Written } else { ElementState::ToRepeat };
        }
        let differing =
            runs_of_values(self.elements(chunk), chunk.range.elements_per_value(), |element| element.state.differs());
        let differing: Vec<_> =
            differing.into_iter().map(|run| (chunk.block, chunk.range, chunk.within(&run))).collect();
        let left: usize = differing.iter().map(|(_, _, run)| run.len()).sum();
        debug_assert!(left <= chunk.count, "runs of a chunk do not overlap");
        self.chunks.done();
        self.chunks.prepend(Chunks::new(differing, self.lengths));
        self.done = self.done.saturating_add(chunk.count.saturating_sub(left));
        if left == 0 {
            self.tries = 0;
        }
        self.stage = RestoreStage::Elements(Write);
    }

    fn verified(&mut self, chunk: Chunk, values: impl Iterator<Item = Option<Value>>) {
        let targets = self.targets.get(chunk.block).and_then(|target| target.elements.get(chunk.indices()));
        let expected = targets.unwrap_or_default().iter().map(|element| element.wanted);
        for ((element, expected), found) in chunk.tag().elements().zip(expected).zip(values) {
            if let Some(expected) = expected.filter(|&expected| found != Some(expected)) {
                self.remaining.push(Difference { element, expected, found });
            }
        }
    }

    /// A chunk was refused: its halves come next. A single element is settled.
    fn refused(&mut self) -> Option<Chunk> {
        let single = self.chunks.refused();
        self.done = self.done.saturating_add(single.map_or(0, |single| single.count));
        single
    }

    fn mark_refused(&mut self, state: ElementState) {
        if let Some(single) = self.refused() {
            self.elements(single).iter_mut().for_each(|element| element.state = state);
        }
    }

    /// The write of a chunk certainly had no effect.
    fn unsent(&mut self, chunk: Chunk) {
        let before = std::mem::take(&mut self.before);
        self.elements(chunk).iter_mut().zip(before).for_each(|(element, state)| element.state = state);
    }

    fn settled(&mut self, chunk: Chunk) {
        self.chunks.done_first(chunk.count);
        self.done = self.done.saturating_add(chunk.count);
    }

    // Duplicates.

    /// No element has been compared.
    fn forget(&mut self) {
        self.targets.iter_mut().chain(&mut self.left_out).for_each(Target::forget);
    }

    /// Written elements are in doubt: the replies may belong to other requests.
    fn doubt(&mut self) {
        let elements = self.targets.iter_mut().flat_map(|target| &mut target.elements);
        let written = elements.filter(|element| element.state == ElementState::Written);
        written.for_each(|element| element.state = ElementState::InDoubt);
    }

    /// All elements are read back and confirmed: those in doubt that do not differ are written.
    fn settle_doubts(&mut self) {
        for target in &mut self.targets {
            for (element, known) in target.range.elements().zip(&mut target.elements) {
                let differs = || self.remaining.iter().any(|difference| difference.element == element);
                if known.state == ElementState::InDoubt && !differs() {
                    known.state = ElementState::Written;
                }
            }
        }
    }

    fn verify_again(&mut self) {
        if self.goal == RestoreGoal::Restore {
            self.doubt();
            self.remaining.clear();
            self.read_or_write(Verify);
        }
    }

    // Elements.

    /// All targets by number; those that are never written come last.
    fn all(&self) -> impl Iterator<Item = &Target> {
        self.targets.iter().chain(&self.left_out)
    }

    pub(super) fn ranges(&self) -> impl Iterator<Item = Tag> {
        self.all().map(|target| target.range)
    }

    fn count(&self, holds: impl Fn(ElementState) -> bool) -> usize {
        self.targets.iter().flat_map(|target| &target.elements).filter(|element| holds(element.state)).count()
    }

    fn elements(&mut self, chunk: Chunk) -> &mut [TargetElement] {
        let target = self.targets.iter_mut().chain(&mut self.left_out).nth(chunk.block);
        let elements = target.and_then(|target| target.elements.get_mut(chunk.indices()));
        debug_assert!(elements.is_some(), "{chunk:?} is no part of a target");
        elements.unwrap_or_default()
    }

    /// The request for the next chunk of a stage.
    fn request(&self, stage: ElementStage, chunk: Chunk) -> Option<Request> {
        match stage {
            Compare | Check | Verify => Some(chunk.read(stage.only_reads())),
            Forced => discretes(chunk.tag()).map(|(first, count)| Request::ReadDisabled(first, count)),
            Write => {
                let elements = self.all().nth(chunk.block)?.elements.get(chunk.indices())?;
                Some(Request::Write(chunk.tag(), elements.iter().filter_map(|element| element.wanted).collect()))
            }
        }
    }
}

impl Transfer for Restoring {
    /// A stage begins again as a whole after an out-of-order duplicate.
    type Mark = RestoreStage;
    type Failure = RestoreFailure;

    fn next(&mut self) -> Result<Step, RestoreFailure> {
        loop {
            if self.to_confirm.is_some() || self.control.must_confirm() {
                return Ok(Step::Confirm);
            }
            let stage = match (self.stage, self.control.next()) {
                (RestoreStage::Done, _) => return Ok(Step::Done),
                (_, Some(request)) => return Ok(Step::Send(request)),
                (RestoreStage::Elements(stage), None) => stage,
                (RestoreStage::Control(stage), None) => {
                    debug_assert!(false, "{stage:?} is a stage of run control, which is idle");
                    return Err(RestoreFailure::StillRunning);
                }
            };
            let chunk = self.chunks.next();
            match chunk.zip(chunk.and_then(|chunk| self.request(stage, chunk))) {
                Some((chunk, request)) => {
                    if stage == Write {
                        // The future may be dropped while it is sent.
                        let elements = self.elements(chunk).iter_mut();
                        let sent = elements.map(|element| std::mem::replace(&mut element.state, ElementState::InDoubt));
                        self.before = sent.collect();
                    }
                    return Ok(Step::Send(request));
                }
                None if stage.only_reads() && self.total > 0 => self.to_confirm = Some(Pending::Leave),
                None => self.leave(stage)?,
            }
        }
    }

    fn mark(&self) -> RestoreStage {
        self.stage
    }

    fn handle(&mut self, result: Result<Reply, Error>) -> Result<(), RestoreFailure> {
        match (self.stage, self.chunks.next()) {
            (RestoreStage::Control(stage), _) => {
                self.control.handle(result).map_or(Ok(()), |event| self.controlled(stage, event))
            }
            (RestoreStage::Elements(stage), Some(chunk)) => self.handle_chunk(stage, chunk, result),
            (RestoreStage::Elements(_), None) | (RestoreStage::Done, _) => Ok(()),
        }
    }

    fn confirmed(&mut self, result: Result<(), Error>) -> Result<(), RestoreFailure> {
        match (self.stage, self.to_confirm.take(), result) {
            (RestoreStage::Control(stage), _, result) => {
                self.control.confirmed(result).map_or(Ok(()), |event| self.controlled(stage, event))
            }
            (RestoreStage::Elements(stage), Some(Pending::Leave), Ok(())) => {
                if stage == Verify {
                    self.settle_doubts();
                }
                self.leave(stage)
            }
            (RestoreStage::Elements(_), Some(Pending::Checked(values)), Ok(())) => {
                if let Some(chunk) = self.chunks.next() {
                    self.checked(chunk, &values);
                }
                Ok(())
            }
            (RestoreStage::Elements(_), Some(_), Err(source)) => {
                Err(RestoreFailure::Call { doing: "confirming what was read".to_owned(), source })
            }
            (RestoreStage::Elements(_), None, _) | (RestoreStage::Done, ..) => Ok(()),
        }
    }

    fn rewind(&mut self, mark: RestoreStage) {
        self.to_confirm = None;
        let wrote = mark == RestoreStage::Elements(Write);
        match self.stage {
            RestoreStage::Elements(Compare) => {
                self.forget();
                // The status before the comparison is not certain either.
                if matches!(mark, RestoreStage::Control(_)) {
                    self.control(Look);
                } else {
                    self.read_or_write(Compare);
                }
            }
            RestoreStage::Elements(Forced) => {
                self.targets.iter_mut().for_each(Target::unforce);
                self.read_or_write(Forced);
            }
            // The reply to the write may be that of another. Verify shows the result.
            RestoreStage::Elements(Write) => {
                self.doubt();
                if let Some(chunk) = self.chunks.next() {
                    self.settled(chunk);
                }
            }
            RestoreStage::Elements(Check) if wrote => self.doubt(),
            RestoreStage::Elements(Verify) => self.verify_again(),
            RestoreStage::Control(LastLook) if wrote || mark == RestoreStage::Elements(Verify) => self.verify_again(),
            RestoreStage::Control(_) => self.control.rewind(),
            RestoreStage::Elements(Check) | RestoreStage::Done => {}
        }
    }

    /// Written elements are in doubt.
    fn distrust(&mut self, _: RestoreStage) {
        self.doubt();
    }

    fn position(&self) -> Position {
        let phase = match self.stage {
            RestoreStage::Elements(Forced | Write | Check) => Phase::Writing,
            RestoreStage::Elements(Verify) => Phase::Verifying,
            RestoreStage::Elements(Compare) | RestoreStage::Control(_) | RestoreStage::Done => Phase::Comparing,
        };
        Position { phase, done: self.done, total: self.total }
    }
}

#[cfg(test)]
mod tests;
