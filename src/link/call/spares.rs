//! Slots of calls that have ended, kept for later calls of the thread, so that most calls need no heap
//! allocation. A slot per link would be most of an idle link's memory.
//!
//! Invariants:
//! - A slot is kept after its call has ended, and given out only when no other holder is left.
//! - A thread keeps a bounded number of slots, without the values of writes and without wakers.

use std::any::Any;
use std::cell::RefCell;
use std::sync::Arc;

use super::slot::CallSlot;
use crate::command::Command;

type Slots = Vec<Arc<dyn Any + Send + Sync>>;

thread_local! {
    static KEPT: RefCell<Slots> = const { RefCell::new(Vec::new()) };
}

/// Maximum number of slots that a thread keeps. This many calls under way at once need no new memory.
const MAX_KEPT: usize = 64;

/// Takes a slot of this type.
pub(super) fn take<C: Command>() -> Option<Arc<CallSlot<C>>> {
    let slot = with(|slots| {
        let at = slots.iter().rposition(|slot| slot.is::<CallSlot<C>>() && Arc::strong_count(slot) == 1)?;
        Some(slots.swap_remove(at))
    })?;
    slot?.downcast().ok()
}

/// Leaves a slot to a later call.
pub(super) fn keep<C: Command>(mut slot: Arc<CallSlot<C>>) {
    if std::mem::needs_drop::<C>() {
        // The values of a write are not kept with its slot.
        match Arc::get_mut(&mut slot) {
            Some(slot) => slot.drop_request(),
            None => return,
        }
    }
    with(|slots| {
        if slots.len() >= MAX_KEPT {
            slots.remove(0);
        }
        slots.push(slot);
    });
}

/// `None`: the thread is ending, and keeps none.
fn with<R>(work: impl FnOnce(&mut Slots) -> R) -> Option<R> {
    KEPT.try_with(|slots| slots.try_borrow_mut().ok().map(|mut slots| work(&mut slots))).ok().flatten()
}
