//! Messages in flight: packet ids, and acknowledgements in any order. No I/O, and no clock.

use std::collections::{HashMap, HashSet, VecDeque};
use std::sync::Arc;

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
///
/// Invariants, when the batches are read again:
/// - a batch that was given up stays so;
/// - one that was taken stays so, unless one before it of the same PLC is sent again: the order of a PLC is kept.
#[derive(Debug, Default)]
pub(super) struct Prefix {
    read: VecDeque<Read>,
    /// Batches that were settled before the batches are read again, and are not read yet.
    settled_before: VecDeque<(u64, Settled)>,
}

#[derive(Debug)]
struct Read {
    position: u64,
    plc: Arc<str>,
    settled: Option<Settled>,
}

/// Why a batch needs no more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Settled {
    /// The broker has taken it.
    Taken,
    /// It is never sent again.
    GivenUp,
}

impl Prefix {
    /// Notes a batch that is sent now, or kept. Positions grow. Returns how it was settled before: then it is not
    /// sent, and to be settled again.
    pub(super) fn push(&mut self, position: u64, plc: &Arc<str>) -> Option<Settled> {
        debug_assert!(self.read.back().is_none_or(|last| last.position < position));
        self.read.push_back(Read { position, plc: plc.clone(), settled: None });
        // The buffer may have dropped some of them.
        while self.settled_before.front().is_some_and(|(settled, _)| *settled < position) {
            self.settled_before.pop_front();
        }
        let (_, how) = self.settled_before.front().copied().filter(|(settled, _)| *settled == position)?;
        self.settled_before.pop_front();
        Some(how)
    }

    /// The number of batches from the first that is not settled.
    pub(super) fn len(&self) -> usize {
        self.read.len()
    }

    /// Notes that a batch needs no more. Returns the last position of those at the front that are settled, all of
    /// which may be acknowledged, if there are new ones.
    pub(super) fn settle(&mut self, position: u64, how: Settled) -> Option<u64> {
        let at = self.read.partition_point(|read| read.position < position);
        let read = self.read.get_mut(at).filter(|read| read.position == position)?;
        read.settled = Some(how);
        let mut last = None;
        while let Some(front) = self.read.front().filter(|front| front.settled.is_some()) {
            last = Some(front.position);
            self.read.pop_front();
        }
        last
    }

    /// Forgets the batches, which are read again, but for the settled ones.
    pub(super) fn rewind(&mut self) {
        let mut sent_again = HashSet::new();
        let mut settled = VecDeque::new();
        for Read { position, plc, settled: how } in self.read.drain(..) {
            match how {
                Some(Settled::GivenUp) => settled.push_back((position, Settled::GivenUp)),
                Some(Settled::Taken) if !sent_again.contains(&plc) => settled.push_back((position, Settled::Taken)),
                Some(Settled::Taken) | None => {
                    sent_again.insert(plc);
                }
            }
        }
        // Those that were not read again are behind all that were.
        settled.append(&mut self.settled_before);
        self.settled_before = settled;
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

    fn plc(name: &str) -> Arc<str> {
        name.into()
    }

    #[test]
    fn positions_are_acknowledged_as_a_prefix_alone() {
        let mut prefix = Prefix::default();
        [4, 5, 7, 8].into_iter().for_each(|position| assert_eq!(prefix.push(position, &plc("mixer")), None));
        assert_eq!(prefix.settle(5, Settled::Taken), None);
        assert_eq!(prefix.settle(8, Settled::Taken), None);
        assert_eq!(prefix.len(), 4);
        assert_eq!(prefix.settle(4, Settled::Taken), Some(5));
        assert_eq!(prefix.len(), 2);
        // Unknown, and settled before.
        let unknown = [6, 4, 99].map(|position| prefix.settle(position, Settled::Taken));
        assert_eq!(unknown, [None; 3]);
        assert_eq!(prefix.settle(7, Settled::Taken), Some(8));
        prefix.push(9, &plc("mixer"));
        prefix.rewind();
        assert_eq!(prefix.settle(9, Settled::Taken), None);
    }

    #[test]
    fn settled_positions_stay_so_in_the_order_of_each_plc() {
        let mut prefix = Prefix::default();
        let plcs = [plc("mixer"), plc("boiler")];
        let read = |prefix: &mut Prefix, positions: &[u64]| -> Vec<u64> {
            let of = |position: u64| &plcs[usize::try_from(position).unwrap() % 2];
            positions.iter().copied().filter(|position| prefix.push(*position, of(*position)).is_some()).collect()
        };
        // Those of the boiler are odd.
        assert_eq!(read(&mut prefix, &[1, 2, 3, 4, 5, 6]), Vec::<u64>::new());
        assert_eq!(prefix.settle(2, Settled::Taken), None);
        assert_eq!(prefix.settle(3, Settled::Taken), None);
        assert_eq!(prefix.settle(5, Settled::GivenUp), None);
        assert_eq!(prefix.settle(6, Settled::Taken), None);
        prefix.rewind();
        assert_eq!(prefix.len(), 0);
        // 3 comes behind 1, which is sent again, and 6 behind 4.
        assert_eq!(read(&mut prefix, &[1, 2]), [2]);
        assert_eq!(prefix.settle(2, Settled::Taken), None);
        // Again, before all were read; 3 is gone from the buffer.
        prefix.rewind();
        assert_eq!(read(&mut prefix, &[1, 2, 4, 5, 6]), [2, 5]);
        [(2, Settled::Taken), (5, Settled::GivenUp), (6, Settled::Taken)].into_iter().for_each(|(position, how)| {
            assert_eq!(prefix.settle(position, how), None);
        });
        assert_eq!(prefix.settle(1, Settled::Taken), Some(2));
        assert_eq!(prefix.settle(4, Settled::Taken), Some(6));
    }
}
