//! Slots of calls that have ended, and their timers, kept for later calls of the link.

use std::any::Any;
use std::sync::{Arc, Mutex};

use tokio::runtime::Id;

use super::deadline::CallTimer;
use super::lock;
use super::slot::CallSlot;
use crate::command::Command;

/// Slots and timers of ended calls, so that most calls need no heap allocation.
#[derive(Default)]
pub(crate) struct SpareSlots {
    spares: Mutex<Spares>,
}

#[derive(Default)]
struct Spares {
    slots: Vec<Arc<dyn Any + Send + Sync>>,
    timers: Vec<CallTimer>,
}

/// Maximum number of slots and of timers that are kept. This many calls under way at once need no new
/// memory.
const MAX_SPARES: usize = 16;

impl SpareSlots {
    pub(super) fn take<S: Any + Send + Sync>(&self) -> Option<Arc<S>> {
        let slots = &mut lock(&self.spares).slots;
        let at = slots.iter().rposition(|slot| slot.is::<S>() && Arc::strong_count(slot) == 1)?;
        slots.swap_remove(at).downcast().ok()
    }

    pub(super) fn keep<C: Command>(&self, mut slot: Arc<CallSlot<C>>) {
        if std::mem::needs_drop::<C>() {
            // The values of a write are not kept with its slot.
            match Arc::get_mut(&mut slot) {
                Some(slot) => slot.drop_request(),
                None => return,
            }
        }
        keep(&mut lock(&self.spares).slots, slot);
    }

    /// Takes a timer of this runtime. Timers of other runtimes are dropped: theirs may have ended, and
    /// a timer keeps the memory of its runtime.
    pub(super) fn take_timer(&self, runtime: Id) -> Option<CallTimer> {
        let timers = &mut lock(&self.spares).timers;
        let timer = timers.pop()?;
        if timer.runtime() == runtime {
            return Some(timer);
        }
        timers.retain(|timer| timer.runtime() == runtime);
        timers.pop()
    }

    pub(super) fn keep_timer(&self, timer: CallTimer) {
        keep(&mut lock(&self.spares).timers, timer);
    }

    /// Drops all timers: their runtime may have ended.
    pub(crate) fn forget_timers(&self) {
        let timers = std::mem::take(&mut lock(&self.spares).timers);
        drop(timers);
    }
}

fn keep<T>(spares: &mut Vec<T>, spare: T) {
    if spares.len() >= MAX_SPARES {
        spares.remove(0);
    }
    // Most links have one caller at a time.
    spares.reserve_exact(1);
    spares.push(spare);
}
