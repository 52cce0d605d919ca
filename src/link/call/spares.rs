//! Slots of calls that have ended, kept for later calls of the link.

use std::any::Any;
use std::sync::{Arc, Mutex};

use super::lock;
use super::slot::CallSlot;
use crate::command::Command;

/// Slots of ended calls, so that most calls need no heap allocation.
#[derive(Default)]
pub(crate) struct SpareSlots {
    slots: Mutex<Vec<Arc<dyn Any + Send + Sync>>>,
}

/// Maximum number of slots that are kept. This many calls under way at once need no new memory.
const MAX_SPARES: usize = 16;

impl SpareSlots {
    pub(super) fn take<S: Any + Send + Sync>(&self) -> Option<Arc<S>> {
        let mut slots = lock(&self.slots);
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
        let mut slots = lock(&self.slots);
        if slots.len() >= MAX_SPARES {
            slots.remove(0);
        }
        // Most links have one caller at a time.
        slots.reserve_exact(1);
        slots.push(slot);
    }
}
