//! The states of restoring, as the [module](super) draws them. No I/O, and no clock.

mod confirm;
mod states;

use self::confirm::Then;
pub(super) use self::states::{Goal, Reply, State, Step};
use super::block::{Chunk, Chunks, discretes, is_not_for_restoring, runs, runs_of_values};
use super::restore::{IfRunning, RestoreOptions};
use super::target::{Mark, Slot, Target};
use super::{Backup, Difference, MissingRange, RestoreFailure, RestoreReport};
use crate::command::Value;
use crate::error::{Error, ErrorCode};
use crate::program::PlcState;
use crate::progress::Phase;

/// A backup that is being restored.
#[derive(Clone, Debug)]
pub(super) struct Restoring {
    options: RestoreOptions,
    targets: Vec<Target>,
    /// What is compared, and never written.
    left_out: Vec<Target>,
    missing: Vec<MissingRange>,
    goal: Goal,
    state: State,
    /// What this state has still to ask for.
    chunks: Chunks,
    /// Elements that this state has settled, and all that it has to.
    done: usize,
    total: usize,
    /// What the elements that were sent last were before.
    before: Vec<Mark>,
    /// How often in a row the same was tried without an answer, or without effect.
    tries: u32,
    /// All that was read is to be confirmed, and this follows.
    confirms: Option<Then>,
    /// Whether the PLC was running before it was stopped, and whether it was: also by earlier runs.
    ran: bool,
    was_stopped: bool,
    plc: PlcState,
    remaining: Vec<Difference>,
}

impl Restoring {
    pub(super) fn new(backup: &Backup, options: RestoreOptions) -> Self {
        let (left_out, taken): (Vec<_>, Vec<_>) =
            backup.blocks.iter().partition(|block| is_not_for_restoring(block.range));
        Self {
            options,
            targets: taken.into_iter().map(Target::new).collect(),
            left_out: left_out.into_iter().map(Target::new).collect(),
            missing: backup.missing(),
            goal: Goal::Compare,
            state: State::Done,
            chunks: Chunks::default(),
            done: 0,
            total: 0,
            before: Vec::new(),
            tries: 0,
            confirms: None,
            ran: false,
            was_stopped: false,
            plc: PlcState::Unknown,
            remaining: Vec::new(),
        }
    }

    /// A run begins: the first, or another after a failure.
    pub(super) fn begin(&mut self, goal: Goal) {
        // What has come to its end is over: whoever stops the PLC afterwards does not want it run by the next run.
        if self.goal == Goal::Restore && self.state == State::Done {
            (self.ran, self.was_stopped) = (false, false);
        }
        self.targets.iter_mut().chain(&mut self.left_out).for_each(Target::forget);
        self.remaining.clear();
        self.confirms = None;
        self.plc = PlcState::Unknown;
        self.goal = goal;
        match goal {
            // It is no matter whether it runs.
            Goal::Compare if self.options.if_running == IfRunning::GoOn => self.enter(State::Compare),
            _ => self.enter(State::Look),
        }
    }

    /// Whether the last runs have left something that belongs to this one PLC: that it was told to stop.
    pub(super) fn is_bound(&self) -> bool {
        self.was_stopped && (self.goal, self.state) != (Goal::Restore, State::Done)
    }

    pub(super) fn next(&mut self) -> Result<Step, RestoreFailure> {
        loop {
            if self.confirms.is_some() {
                return Ok(Step::Confirm);
            }
            let Some(step) = self.step() else {
                if self.state.reads() && self.total > 0 {
                    self.confirms = Some(Then::Leave);
                } else {
                    self.leave()?;
                }
                continue;
            };
            // What is sent may be done, whether anybody waits for the answer or not.
            match (&step, self.chunks.next()) {
                (Step::Write(..), Some(chunk)) => {
                    let slots = self.slots(chunk).iter_mut();
                    self.before = slots.map(|slot| std::mem::replace(&mut slot.mark, Mark::Doubt)).collect();
                }
                (Step::Stop, _) => (self.was_stopped, self.plc) = (true, PlcState::Unknown),
                (Step::Run, _) => self.plc = PlcState::Unknown,
                _ => {}
            }
            return Ok(step);
        }
    }

    /// What this state asks for; `None` if it has nothing left to ask for.
    fn step(&self) -> Option<Step> {
        match self.state {
            State::Look | State::Stopped | State::Ready | State::LastLook | State::Running => Some(Step::Status),
            State::Stop => Some(Step::Stop),
            State::Run => Some(Step::Run),
            State::PauseToStop | State::PauseToRun => Some(Step::Pause),
            State::Done => Some(Step::Done),
            State::Compare | State::Check | State::Verify => self.chunks.next().map(Step::Read),
            State::Forced => {
                let (first, count) = discretes(self.chunks.next()?.names())?;
                Some(Step::ReadForced(first, count))
            }
            State::Write => {
                let chunk = self.chunks.next()?;
                let slots = self.targets.get(chunk.block)?.slots.get(chunk.places())?;
                Some(Step::Write(chunk.names(), slots.iter().filter_map(|slot| slot.wanted).collect()))
            }
        }
    }

    /// All that this state had to ask for is settled.
    fn leave(&mut self) -> Result<(), RestoreFailure> {
        match self.state {
            State::Compare => {
                let count = self.count(|mark| matches!(mark, Mark::NotGiven(_)));
                if count > 0 {
                    return Err(RestoreFailure::NotThere { count });
                }
                self.enter(State::Forced);
            }
            State::Forced if self.goal == Goal::Compare => self.enter(State::Done),
            State::Forced if self.options.if_running == IfRunning::GoOn || self.count(Mark::differs) == 0 => {
                self.enter(State::Write);
            }
            // Only now it is known that there is something to write, and that it can be.
            State::Forced if self.plc == PlcState::Running => self.enter(State::Stop),
            // The comparing has taken its time.
            State::Forced => self.enter(State::Ready),
            // What was sent is looked at, whatever came of it.
            State::Write if self.has_sent() => self.enter(State::Verify),
            State::Write | State::Verify
                if self.options.if_running != IfRunning::GoOn && self.plc != PlcState::Running =>
            {
                self.enter(State::LastLook);
            }
            State::Write | State::Verify => self.end()?,
            _ => self.enter(State::Done),
        }
        Ok(())
    }

    /// Whether anything was sent that is settled.
    fn has_sent(&self) -> bool {
        self.count(|mark| matches!(mark, Mark::Written | Mark::Doubt | Mark::NotTaken(_))) > 0
    }

    /// All is read back, and what is known of the PLC is so.
    fn end(&mut self) -> Result<(), RestoreFailure> {
        if !self.remaining.is_empty() {
            return Err(RestoreFailure::Differs { count: self.remaining.len() });
        }
        let run = self.options.run_again && self.ran && self.was_stopped && self.plc != PlcState::Running;
        self.enter(if run { State::Run } else { State::Done });
        Ok(())
    }

    /// Somebody has set it running, who wants it to run: it is not stopped again. Nor is it run again by a later run, should
    /// they have stopped it by then.
    fn set_running(&mut self) -> RestoreFailure {
        self.ran = false;
        RestoreFailure::SetRunning { differing: self.remaining.len() }
    }

    fn enter(&mut self, state: State) {
        self.state = state;
        (self.tries, self.done) = (0, 0);
        let bridge = self.options.bridge;
        let wanted = |target: &Target| match state {
            State::Compare => runs(&target.slots, |slot| slot.mark == Mark::Unknown),
            State::Forced if self.options.write_forced || discretes(target.range).is_none() => Vec::new(),
            State::Forced => target.differing(),
            State::Write => target.to_write(bridge),
            State::Verify => runs(&target.slots, |slot| slot.wanted.is_some() && slot.mark != Mark::Forced),
            _ => Vec::new(),
        };
        // They come behind the others, and so do their numbers.
        let compared_only = self.left_out.iter().filter(|_| (state, self.goal) == (State::Compare, Goal::Compare));
        let all = self
            .targets
            .iter()
            .chain(compared_only)
            .enumerate()
            .flat_map(|(block, target)| wanted(target).into_iter().map(move |run| (block, target.range, run)));
        let all: Vec<_> = all.collect();
        self.total = all.iter().map(|(_, _, run)| run.len()).sum();
        self.chunks = Chunks::new(all);
    }

    pub(super) fn handle(&mut self, reply: Result<Reply, Error>) -> Result<(), RestoreFailure> {
        match self.state {
            State::Look => {
                let running = self.running(reply)?;
                if running {
                    // If it was stopped by an earlier run, somebody has run it since.
                    (self.ran, self.was_stopped) = (true, false);
                }
                if running && self.options.if_running == IfRunning::Refuse {
                    return Err(RestoreFailure::Running);
                }
                self.enter(State::Compare);
            }
            State::Stop => {
                // It runs, so it is known what it means if this was refused, or not sent.
                self.was_stopped = reply.as_ref().err().is_none_or(Error::may_have_executed);
                self.told("stopping the PLC, which still runs", reply, PlcState::Running, State::Stopped)?;
            }
            State::Stopped => match self.running(reply)? {
                true => {
                    self.was_stopped = false;
                    self.again(State::PauseToStop, RestoreFailure::StillRunning)?;
                }
                false => {
                    // What was compared may have changed until it stood still.
                    self.targets.iter_mut().for_each(Target::forget);
                    self.enter(State::Compare);
                }
            },
            State::PauseToStop => self.state = State::Stop,
            State::Ready | State::LastLook | State::Running => match reply {
                Ok(reply) => self.confirms = Some(Then::Look(reply)),
                Err(error) => self.look(Err(error))?,
            },
            State::Run => {
                self.told("running the PLC, which is still stopped", reply, PlcState::Stopped, State::Running)?;
            }
            State::PauseToRun => self.state = State::Run,
            State::Compare | State::Forced | State::Write | State::Check | State::Verify => {
                if let Some(chunk) = self.chunks.next() {
                    return self.handle_chunk(chunk, reply);
                }
            }
            State::Done => {}
        }
        Ok(())
    }

    /// 41 was sent: whatever came of it, the status tells; unless nothing can have, and it is as it was.
    fn told(
        &mut self,
        doing: &str,
        reply: Result<Reply, Error>,
        before: PlcState,
        next: State,
    ) -> Result<(), RestoreFailure> {
        if let Err(error) = reply
            && !error.may_have_executed()
        {
            self.plc = before;
            return Err(RestoreFailure::Call { doing: doing.to_owned(), source: error });
        }
        self.state = next;
        Ok(())
    }

    fn running(&mut self, reply: Result<Reply, Error>) -> Result<bool, RestoreFailure> {
        let reply = reply.map_err(|source| RestoreFailure::Call { doing: "reading the status".to_owned(), source })?;
        let running = reply == Reply::Running(true);
        self.plc = if running { PlcState::Running } else { PlcState::Stopped };
        Ok(running)
    }

    fn again(&mut self, state: State, failure: RestoreFailure) -> Result<(), RestoreFailure> {
        self.tries = self.tries.saturating_add(1);
        if self.tries >= self.options.attempts {
            return Err(failure);
        }
        self.state = state;
        Ok(())
    }

    fn handle_chunk(&mut self, chunk: Chunk, reply: Result<Reply, Error>) -> Result<(), RestoreFailure> {
        match (self.state, reply) {
            (State::Compare, Ok(Reply::Values(values))) => {
                let chunk = first(chunk, &values);
                for (slot, value) in self.slots(chunk).iter_mut().zip(values) {
                    slot.found = Some(value);
                    slot.mark = if slot.wanted == Some(value) { Mark::Same } else { Mark::Differs };
                }
                self.settled(chunk);
            }
            (State::Compare, Err(Error::Plc { error, .. })) => self.refused(Mark::NotGiven(error)),
            (State::Forced, Ok(Reply::Forced(forced))) => {
                let per_value = chunk.range.elements_per_value().max(1);
                let values = chunk.count.div_ceil(per_value);
                let discretes = forced.len().checked_div(values).unwrap_or(1).max(1);
                for (value, forced) in self.slots(chunk).chunks_mut(per_value).zip(forced.chunks(discretes)) {
                    if forced.contains(&true) {
                        value.iter_mut().for_each(|slot| slot.mark = Mark::Forced);
                    }
                }
                self.settled(chunk);
            }
            (State::Write, Ok(_)) => {
                self.slots(chunk).iter_mut().for_each(|slot| slot.mark = Mark::Written);
                self.tries = 0;
                self.settled(chunk);
            }
            (State::Write, Err(error)) => return self.not_written(chunk, error),
            (State::Check, Ok(Reply::Values(values))) => self.confirms = Some(Then::Checked(values)),
            (State::Verify, Ok(Reply::Values(values))) => {
                let chunk = first(chunk, &values);
                self.verified(chunk, &values.into_iter().map(Some).collect::<Vec<_>>());
                self.settled(chunk);
            }
            (State::Verify, Err(Error::Plc { .. })) => {
                if let Some(single) = self.chunks.refused() {
                    self.verified(single, &vec![None; single.count]);
                    self.done = self.done.saturating_add(single.count);
                }
            }
            (_, Err(source)) => {
                return Err(RestoreFailure::Call { doing: self.state.doing(chunk), source });
            }
            // No step has such a reply.
            (_, Ok(_)) => self.settled(chunk),
        }
        Ok(())
    }

    fn not_written(&mut self, chunk: Chunk, error: Error) -> Result<(), RestoreFailure> {
        let doing = self.state.doing(chunk);
        match error {
            // Nothing in this PLC can be written: no need to try each.
            Error::Plc { error: ErrorCode::WriteProhibited, repeated: false, .. } => {}
            Error::Plc { error, repeated: false, .. } => {
                self.unsent(chunk);
                self.refused(Mark::NotTaken(error));
                return Ok(());
            }
            error if error.may_have_executed() => {
                return self.again(State::Check, RestoreFailure::Call { doing, source: error });
            }
            _ => {}
        }
        self.unsent(chunk);
        Err(RestoreFailure::Call { doing, source: error })
    }

    /// A write that was not confirmed has been read back.
    fn checked(&mut self, chunk: Chunk, values: &[Value]) {
        for (slot, &value) in self.slots(chunk).iter_mut().zip(values) {
            slot.mark = if slot.wanted == Some(value) { Mark::Written } else { Mark::Again };
        }
        let tries = self.tries;
        let per_value = chunk.range.elements_per_value();
        let differing = runs_of_values(self.slots(chunk), per_value, |slot| slot.mark.differs());
        let shifted = differing.into_iter().map(|run| {
            let shift = |place: usize| place.saturating_add(chunk.start);
            (chunk.block, chunk.range, shift(run.start)..shift(run.end))
        });
        let shifted: Vec<_> = shifted.collect();
        let left: usize = shifted.iter().map(|(_, _, run)| run.len()).sum();
        self.chunks.done();
        self.chunks.prepend(Chunks::new(shifted));
        self.done = self.done.saturating_add(chunk.count.saturating_sub(left));
        self.tries = if left == 0 { 0 } else { tries };
        self.state = State::Write;
    }

    fn verified(&mut self, chunk: Chunk, values: &[Option<Value>]) {
        let elements = chunk.names().elements();
        let slots = self.targets.get(chunk.block).and_then(|target| target.slots.get(chunk.places()));
        let differences =
            elements.zip(slots.unwrap_or_default()).zip(values).filter_map(|((element, slot), &found)| {
                let expected = slot.wanted?;
                (found != Some(expected)).then_some(Difference { element, expected, found })
            });
        self.remaining.extend(differences);
    }

    /// The request for these was refused: its halves come next, and a single element is marked.
    fn refused(&mut self, mark: Mark) {
        if let Some(single) = self.chunks.refused() {
            self.slots(single).iter_mut().for_each(|slot| slot.mark = mark);
            self.done = self.done.saturating_add(single.count);
        }
    }

    /// This time it has not been written, for certain: all is as it was before.
    fn unsent(&mut self, chunk: Chunk) {
        let before = std::mem::take(&mut self.before);
        self.slots(chunk).iter_mut().zip(before).for_each(|(slot, mark)| slot.mark = mark);
    }

    fn settled(&mut self, chunk: Chunk) {
        self.chunks.done_first(chunk.count);
        self.done = self.done.saturating_add(chunk.count);
    }

    /// What it is about, how many of its elements are settled, and how many there are.
    pub(super) fn progress(&self) -> (Phase, usize, usize) {
        let phase = match self.state {
            State::Write | State::Check | State::Forced => Phase::Writing,
            State::Verify => Phase::Verifying,
            _ => Phase::Comparing,
        };
        (phase, self.done, self.total)
    }

    pub(super) fn report(&self) -> RestoreReport {
        let ranges = |holds: fn(Mark) -> bool| self.targets.iter().flat_map(|target| target.ranges(holds)).collect();
        RestoreReport {
            compared: self.all().flat_map(|target| &target.slots).filter(|slot| slot.found.is_some()).count(),
            differences: self.targets.iter().flat_map(Target::differences).collect(),
            written: ranges(|mark| mark == Mark::Written),
            in_doubt: ranges(|mark| matches!(mark, Mark::Doubt | Mark::Again)),
            unwritten: ranges(|mark| mark == Mark::Differs),
            to_write: self.targets.iter().flat_map(|target| target.ranges_to_write(self.options.bridge)).collect(),
            refused: self.all().flat_map(Target::refused).collect(),
            forced: ranges(|mark| mark == Mark::Forced),
            left_out: self.left_out.iter().map(|target| target.range).collect(),
            left_out_differences: self.left_out.iter().flat_map(Target::differences).collect(),
            missing: self.missing.clone(),
            remaining: self.remaining.clone(),
            was_stopped: self.was_stopped,
            plc: self.plc,
        }
    }

    /// Those that are never written come last.
    fn all(&self) -> impl Iterator<Item = &Target> {
        self.targets.iter().chain(&self.left_out)
    }

    fn count(&self, holds: impl Fn(Mark) -> bool) -> usize {
        self.targets.iter().flat_map(|target| &target.slots).filter(|slot| holds(slot.mark)).count()
    }

    fn slots(&mut self, chunk: Chunk) -> &mut [Slot] {
        let target = self.targets.iter_mut().chain(&mut self.left_out).nth(chunk.block);
        let slots = target.and_then(|target| target.slots.get_mut(chunk.places()));
        slots.unwrap_or_default()
    }
}

/// The part of a chunk that a reply has values of.
fn first(chunk: Chunk, values: &[Value]) -> Chunk {
    Chunk { count: chunk.count.min(values.len()), ..chunk }
}

#[cfg(test)]
mod tests;
