//! Slots of calls that have ended, and the timers of their deadlines, kept for later calls of the thread.
//! So most calls need no heap allocation and register no timer. A slot per link would be most of an
//! idle link's memory.
//!
//! Invariants:
//! - A slot is kept after its call has ended, and given out only when no other holder is left.
//! - A thread keeps a bounded number of slots, without the values of writes and without wakers.
//! - All kept timers are of one runtime, that of the timer kept last. A timer keeps the memory and the
//!   descriptors of its runtime.

use std::any::Any;
use std::cell::RefCell;
use std::sync::Arc;

use tokio::runtime::Id;

use super::deadline::CallTimer;
use super::slot::CallSlot;
use crate::command::Command;

struct Spare {
    slot: Arc<dyn Any + Send + Sync>,
    timer: KeptTimer,
}

/// The timer of a slot, which wakes the task of the slot. `None`: it was of another runtime.
pub(super) type KeptTimer = Option<Box<CallTimer>>;

struct Kept {
    spares: Vec<Spare>,
    /// The runtime of all timers.
    runtime: Option<Id>,
    /// The index of the one to be dropped next, when there are too many.
    evicted: usize,
}

thread_local! {
    static KEPT: RefCell<Kept> = const { RefCell::new(Kept { spares: Vec::new(), runtime: None, evicted: 0 }) };
}

/// Maximum number of slots that a thread keeps. This many calls under way at once need no new memory.
pub(super) const MAX_KEPT: usize = 256;

/// Takes a slot of this type, and its timer. The timer may be of another runtime.
pub(super) fn take<C: Command>() -> Option<(Arc<CallSlot<C>>, KeptTimer)> {
    let Spare { slot, timer } = with(|Kept { spares, .. }| {
        let is_free = |spare: &Spare| spare.slot.is::<CallSlot<C>>() && Arc::strong_count(&spare.slot) == 1;
        // Mostly it is the last one.
        let at = spares.iter().rposition(is_free)?;
        Some(spares.swap_remove(at))
    })??;
    Some((slot.downcast().ok()?, timer))
}

/// Leaves a slot to a later call.
pub(super) fn keep<C: Command>(mut slot: Arc<CallSlot<C>>, timer: KeptTimer) {
    if std::mem::needs_drop::<C>() {
        // The values of a write are not kept with its slot.
        match Arc::get_mut(&mut slot) {
            Some(slot) => slot.drop_request(),
            None => return,
        }
    }
    with(|Kept { spares, runtime, evicted }| {
        if let Some(timer) = &timer
            && *runtime != Some(timer.runtime())
        {
            *runtime = Some(timer.runtime());
            spares.iter_mut().for_each(|spare| spare.timer = None);
        }
        if spares.len() >= MAX_KEPT {
            // An old one: its type may be in use no longer.
            spares.swap_remove(*evicted);
            *evicted = evicted.wrapping_add(1) % MAX_KEPT;
        }
        spares.push(Spare { slot, timer });
    });
}

/// `None`: the thread is ending, or it drops a timer, which may end tasks whose calls have slots. It
/// keeps none then.
fn with<R>(work: impl FnOnce(&mut Kept) -> R) -> Option<R> {
    KEPT.try_with(|kept| kept.try_borrow_mut().ok().map(|mut kept| work(&mut kept))).ok().flatten()
}

/// The number of kept timers.
#[cfg(test)]
pub(super) fn timers() -> usize {
    with(|Kept { spares, .. }| spares.iter().filter(|spare| spare.timer.is_some()).count())
        .expect("the thread is alive")
}
