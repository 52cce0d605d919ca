//! The tags of a station by id.
//!
//! A sorted vector: a service has thousands of stations with few tags each, and a B-tree node has
//! room for eleven entries.

use super::TagId;
use super::tag_state::TagState;

#[derive(Debug, Default)]
#[expect(clippy::vec_box, reason = "removing one entry moves all entries behind it")]
pub(super) struct TagMap {
    /// Sorted by id, without duplicates.
    states: Vec<Box<TagState>>,
}

impl TagMap {
    pub(super) fn get(&self, id: TagId) -> Option<&TagState> {
        self.states.get(self.index_of(id)?).map(|state| &**state)
    }

    pub(super) fn get_mut(&mut self, id: TagId) -> Option<&mut TagState> {
        let index = self.index_of(id)?;
        self.states.get_mut(index).map(|state| &mut **state)
    }

    pub(super) fn contains(&self, id: TagId) -> bool {
        self.index_of(id).is_some()
    }

    /// Returns whether the tag is polled, and the PLC has refused it.
    pub(super) fn is_refused(&self, id: TagId) -> bool {
        self.get(id).is_some_and(TagState::is_refused)
    }

    /// Adds tags whose ids are not in the map.
    pub(super) fn extend(&mut self, states: impl ExactSizeIterator<Item = TagState>) {
        if self.states.is_empty() {
            self.states.reserve_exact(states.len());
        }
        self.states.extend(states.map(Box::new));
        // Ids ascend, except when two threads add tags at the same time.
        if !self.states.is_sorted_by_key(|state| state.id()) {
            self.states.sort_unstable_by_key(|state| state.id());
        }
    }

    pub(super) fn remove(&mut self, id: TagId) -> bool {
        let index = self.index_of(id);
        if let Some(index) = index {
            self.states.remove(index);
        }
        index.is_some()
    }

    pub(super) fn values(&self) -> impl Iterator<Item = &TagState> {
        self.states.iter().map(|state| &**state)
    }

    pub(super) fn values_mut(&mut self) -> impl Iterator<Item = &mut TagState> {
        self.states.iter_mut().map(|state| &mut **state)
    }

    fn index_of(&self, id: TagId) -> Option<usize> {
        self.states.binary_search_by_key(&id, |state| state.id()).ok()
    }
}
