//! Messages in flight: packet ids, and acknowledgements in any order. No I/O, and no clock.

use std::collections::{HashMap, VecDeque};

/// Packets that wait for an acknowledgement, by their packet id.
///
/// Invariants:
/// - there are at most as many as the broker takes at once (receive maximum);
/// - an id is not used again before its acknowledgement.
#[derive(Debug)]
pub(super) struct Window<T> {
    items: HashMap<u16, T>,
    limit: usize,
    last_id: u16,
}

impl<T> Window<T> {
    /// `limit`: at least 1.
    pub(super) fn new(limit: u16) -> Self {
        Self { items: HashMap::new(), limit: usize::from(limit.max(1)), last_id: 0 }
    }

    /// The packets that may be sent now.
    pub(super) fn room(&self) -> usize {
        self.limit.saturating_sub(self.items.len())
    }

    pub(super) fn is_empty(&self) -> bool {
        self.items.is_empty()
    }

    /// An id for the next packet, from 1; the one that was free for the longest time. `None`: there is no room.
    pub(super) fn free_id(&mut self) -> Option<u16> {
        if self.room() == 0 {
            return None;
        }
        let is_free = |id: &u16| *id != 0 && !self.items.contains_key(id);
        let id = (1..=u16::MAX).map(|step| self.last_id.wrapping_add(step)).find(is_free)?;
        self.last_id = id;
        Some(id)
    }

    /// Notes a packet that is sent with an id of [`free_id`](Self::free_id).
    pub(super) fn insert(&mut self, id: u16, item: T) {
        self.items.insert(id, item);
    }

    /// Takes the packet that an acknowledgement names; `None`: there is none, as of a second acknowledgement.
    pub(super) fn take(&mut self, id: u16) -> Option<T> {
        self.items.remove(&id)
    }

    /// The packets in flight.
    pub(super) fn iter(&self) -> impl Iterator<Item = &T> {
        self.items.values()
    }

    /// Takes all packets, after the connection was lost.
    pub(super) fn drain(&mut self) -> impl Iterator<Item = T> + '_ {
        self.items.drain().map(|(_, item)| item)
    }
}

/// Batches that were read, in the order of their positions, of which the settled ones at the front may be
/// acknowledged in the buffer.
#[derive(Debug, Default)]
pub(super) struct Prefix {
    sent: VecDeque<Sent>,
}

#[derive(Debug)]
struct Sent {
    position: u64,
    is_settled: bool,
}

impl Prefix {
    /// Notes a batch that is sent now, or kept. Positions grow.
    pub(super) fn push(&mut self, position: u64) {
        debug_assert!(self.sent.back().is_none_or(|last| last.position < position));
        self.sent.push_back(Sent { position, is_settled: false });
    }

    /// The number of batches from the first that is not settled.
    pub(super) fn len(&self) -> usize {
        self.sent.len()
    }

    /// Notes that a batch needs no more: it was acknowledged or given up. Returns the last position of
    /// those at the front that are settled, all of which may be acknowledged, if there are new ones.
    pub(super) fn settle(&mut self, position: u64) -> Option<u64> {
        let at = self.sent.partition_point(|sent| sent.position < position);
        let sent = self.sent.get_mut(at).filter(|sent| sent.position == position)?;
        sent.is_settled = true;
        let mut last = None;
        while let Some(front) = self.sent.front().filter(|front| front.is_settled) {
            last = Some(front.position);
            self.sent.pop_front();
        }
        last
    }

    /// Forgets all, before they are sent again.
    pub(super) fn clear(&mut self) {
        self.sent.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_window_gives_as_many_ids_as_the_broker_takes() {
        let mut window = Window::new(3);
        for expected in 1..=3 {
            let id = window.free_id().unwrap();
            assert_eq!(id, expected);
            window.insert(id, expected);
        }
        assert_eq!((window.room(), window.free_id()), (0, None));
        assert_eq!((window.take(2), window.take(2), window.take(7)), (Some(2), None, None));
        assert_eq!((window.room(), window.free_id()), (1, Some(4)));
        assert_eq!(Window::<()>::new(0).room(), 1);
    }

    #[test]
    fn ids_in_flight_are_not_used_again() {
        let mut window = Window::new(u16::MAX);
        for _ in 0..u16::MAX {
            let id = window.free_id().unwrap();
            assert!(id != 0 && window.take(id).is_none());
            window.insert(id, ());
        }
        assert_eq!(window.free_id(), None);
        window.take(500);
        assert_eq!(window.free_id(), Some(500));
        window.drain().for_each(drop);
        assert!(window.is_empty());
    }

    #[test]
    fn positions_are_acknowledged_as_a_prefix_alone() {
        let mut prefix = Prefix::default();
        [4, 5, 7, 8].into_iter().for_each(|position| prefix.push(position));
        assert_eq!(prefix.settle(5), None);
        assert_eq!(prefix.settle(8), None);
        assert_eq!(prefix.len(), 4);
        assert_eq!(prefix.settle(4), Some(5));
        assert_eq!(prefix.len(), 2);
        // Unknown, and settled before.
        assert_eq!((prefix.settle(6), prefix.settle(4), prefix.settle(99)), (None, None, None));
        assert_eq!(prefix.settle(7), Some(8));
        prefix.push(9);
        prefix.clear();
        assert_eq!(prefix.settle(9), None);
    }
}
