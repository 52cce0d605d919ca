//! A list on the display: its order, the selected item, and the part that is shown.

/// A list of items, which are numbers. Invariants: the selected item is one of the order, and there
/// is one unless the order is empty.
#[derive(Clone, Debug, Default)]
pub(super) struct List {
    order: Vec<usize>,
    selected: Option<usize>,
    /// Position of the first item shown.
    offset: usize,
}

impl List {
    /// Sets the items and their order. The selected item stays selected; if it has gone, its place
    /// is kept.
    pub(super) fn set_order(&mut self, order: Vec<usize>) {
        let place = self.place();
        self.order = order;
        if !self.selected.is_some_and(|selected| self.order.contains(&selected)) {
            self.select_place(place);
        }
    }

    pub(super) fn selected(&self) -> Option<usize> {
        self.selected
    }

    pub(super) fn len(&self) -> usize {
        self.order.len()
    }

    /// Moves the selection down by this number of items, or up if negative.
    pub(super) fn move_by(&mut self, items: isize) {
        self.select_place(self.place().saturating_add_signed(items));
    }

    /// Selects the item at this place, or the last one.
    pub(super) fn select_place(&mut self, place: usize) {
        let last = self.order.len().saturating_sub(1);
        self.selected = self.order.get(place.min(last)).copied();
    }

    /// Scrolls so that the selected item is one of this number of items that are shown.
    pub(super) fn scroll(&mut self, shown: usize) {
        let place = self.place();
        // No empty lines at the end while there are items above.
        let last_offset = self.order.len().saturating_sub(shown);
        let least = place.saturating_sub(shown.saturating_sub(1));
        self.offset = self.offset.clamp(least.min(place), place).min(last_offset.max(least));
    }

    /// The items shown, at most this number of them.
    pub(super) fn shown(&self, number: usize) -> &[usize] {
        let from = self.offset.min(self.order.len());
        &self.order[from..self.order.len().min(from.saturating_add(number))]
    }

    fn place(&self) -> usize {
        let place = |selected| self.order.iter().position(|item| *item == selected);
        self.selected.and_then(place).unwrap_or(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn list(items: usize) -> List {
        let mut list = List::default();
        list.set_order((0..items).collect());
        list
    }

    #[test]
    fn the_selection_follows_its_item_and_keeps_its_place() {
        let mut list = list(5);
        list.move_by(2);
        list.set_order(vec![4, 3, 2, 1, 0]);
        assert_eq!(list.selected(), Some(2));
        list.move_by(1);
        assert_eq!(list.selected(), Some(1));
        list.set_order(vec![4, 3, 2, 0]);
        assert_eq!(list.selected(), Some(0), "1 has gone from the fourth place");
        list.set_order(vec![]);
        assert_eq!(list.selected(), None);
        list.move_by(-3);
        list.set_order(vec![7]);
        assert_eq!(list.selected(), Some(7));
    }

    #[test]
    fn moves_end_at_the_first_and_the_last_item() {
        let mut list = list(5);
        list.move_by(-1);
        assert_eq!(list.selected(), Some(0));
        list.move_by(100);
        assert_eq!(list.selected(), Some(4));
        list.select_place(usize::MAX);
        assert_eq!(list.selected(), Some(4));
    }

    #[test]
    fn the_selected_item_is_shown_at_every_height() {
        for height in 1..8 {
            let mut list = list(6);
            for step in [0, 1, 2, 5, -1, -3, -100, 100] {
                list.move_by(step);
                list.scroll(height);
                let (shown, selected) = (list.shown(height), list.selected().unwrap());
                assert!(shown.contains(&selected), "{height}: {selected} in {shown:?}");
                assert_eq!(shown.len(), height.min(6), "{height}");
            }
        }
        let mut list = list(6);
        list.scroll(0);
        assert!(list.shown(0).is_empty());
    }
}
