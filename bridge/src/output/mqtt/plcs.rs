//! The PLCs of the registry as retained messages: their states, and their discovery. No I/O.

use std::collections::{HashMap, HashSet};
use std::sync::Arc;

use fatek::plant::PlantTag;

use super::discovery::Discovery;
use super::retained::{Priority, Retained};
use crate::plc_state::PlcState;
use crate::registry::{Elsewhere, PolledPlc, Registry};
use crate::topic::Topics;

/// The PLCs as they were published.
#[derive(Debug, Default)]
pub(super) struct PublishedPlcs {
    plcs: HashMap<Arc<str>, Published>,
    /// The generation of the registry that they are from; `None` before the first.
    generation: Option<u64>,
    /// PLCs that were announced as lost on this connection.
    lost: HashSet<Arc<str>>,
}

#[derive(Debug)]
struct Published {
    state: PlcState,
    tags: Vec<PlantTag>,
}

impl PublishedPlcs {
    /// Brings the retained messages up to date with the registry. `anew`: states with present round trips.
    pub(super) fn refresh(
        &mut self,
        registry: &Registry,
        topics: &Topics,
        discovery: Option<&Discovery>,
        retained: &mut Retained,
        anew: bool,
    ) {
        let mut gone = std::mem::take(&mut self.plcs);
        let plcs = registry.read();
        let generation = Some(plcs.generation());
        let is_same_plant = self.generation == generation;
        self.generation = generation;
        for plc in plcs.iter() {
            let (name, known) = match gone.remove_entry(plc.plc.name()) {
                Some((name, known)) => (name, Some(known)),
                None => (plc.plc.name().into(), None),
            };
            let (state, tags) = known.map_or((None, None), |known| (Some(known.state), Some(known.tags)));
            let is_same = |tags: &Vec<PlantTag>| is_same_plant || plc.plc.tags().eq(tags.iter());
            let tags = tags.filter(is_same).unwrap_or_else(|| {
                let messages = discovery.map(|discovery| discovery.messages(&plc.plc)).unwrap_or_default();
                retained.replace(&name, Priority::Between, messages);
                plc.plc.tags().cloned().collect()
            });
            let state = state.filter(|state| !anew && !Self::is_changed(state, plc)).unwrap_or_else(|| {
                let state = PlcState::of(plc);
                retained.set(topics.plc_state(&name), state.to_json(), Priority::First, Some(&name));
                state
            });
            self.plcs.insert(name, Published { state, tags });
        }
        for name in gone.keys() {
            match plcs.elsewhere(name) {
                None => retained.remove_owner(name),
                Some(Elsewhere::Member | Elsewhere::Lost) => retained.forget_owner(name),
            }
        }
        if anew {
            self.lost.clear();
        }
        self.lost.retain(|name| plcs.elsewhere(name) == Some(Elsewhere::Lost));
        // Also those that were polled for so short a time that their states were not published.
        for name in plcs.lost().filter(|name| self.lost.insert(Arc::clone(name))) {
            retained.announce(topics.plc_state(name), PlcState::without_member().to_json());
        }
    }

    fn is_changed(state: &PlcState, plc: &PolledPlc) -> bool {
        PlcState::of(plc).differs_from(state)
    }
}
