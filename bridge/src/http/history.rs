//! The last values of each tag, for the lines of a page that has just been opened.

use std::iter::repeat_n;

/// The values of all tags at equal intervals: the newest ones, up to a limit.
///
/// Times are slots, counted from 1 since the bridge was started. Values that were not good, and those that
/// are no numbers, are NaN.
#[derive(Debug)]
pub(super) struct History {
    /// The slots that are kept.
    kept: usize,
    /// The slot of the newest values.
    newest: u64,
    /// A ring of `kept` values for each tag.
    values: Vec<f32>,
}

/// The slots that are kept, at most.
pub(super) const MAX_SLOTS: usize = 150;
/// The values that are kept of all tags, at most: 16 MiB.
const MAX_VALUES: usize = 4 << 20;

impl History {
    pub(super) fn new() -> Self {
        Self { kept: 0, newest: 0, values: Vec::new() }
    }

    /// The slot of the newest values; 0 before the first.
    pub(super) fn newest(&self) -> u64 {
        self.newest
    }

    /// Takes over another list of tags, with the earlier place of each.
    pub(super) fn rebuild(&mut self, moved: &[Option<usize>]) {
        let kept = MAX_VALUES.checked_div(moved.len()).unwrap_or(0).min(MAX_SLOTS);
        let mut values = Vec::with_capacity(kept.saturating_mul(moved.len()));
        for place in moved {
            let known = place.filter(|_| kept == self.kept).and_then(|place| self.ring(place));
            match known {
                Some(ring) => values.extend_from_slice(ring),
                None => values.extend(repeat_n(f32::NAN, kept)),
            }
        }
        *self = Self { kept, newest: self.newest, values };
    }

    /// Adds a slot. `numbers`: of all tags in their order.
    #[expect(clippy::cast_possible_truncation, reason = "lines need no more than seven digits")]
    pub(super) fn push(&mut self, numbers: impl Iterator<Item = Option<f64>>) {
        self.newest = self.newest.saturating_add(1);
        let Some(slot) = self.slot(self.newest) else { return };
        for (ring, number) in self.values.chunks_exact_mut(self.kept).zip(numbers) {
            if let Some(value) = ring.get_mut(slot) {
                *value = number.map_or(f32::NAN, |number| number as f32);
            }
        }
    }

    /// The values of a tag, the oldest first and the newest last, from its first good one.
    pub(super) fn values(&self, place: usize) -> Vec<Option<f32>> {
        let Some(ring) = self.ring(place) else { return Vec::new() };
        let Some(newest) = self.slot(self.newest) else { return Vec::new() };
        let (late, early) = ring.split_at_checked(newest.saturating_add(1)).unwrap_or_default();
        let values = early.iter().chain(late).map(|value| value.is_finite().then_some(*value));
        values.skip_while(Option::is_none).collect()
    }

    fn ring(&self, place: usize) -> Option<&[f32]> {
        let first = place.checked_mul(self.kept)?;
        self.values.get(first..first.checked_add(self.kept)?)
    }

    fn slot(&self, slot: u64) -> Option<usize> {
        usize::try_from(slot).ok()?.checked_rem(self.kept)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_values_are_kept() {
        let mut history = History::new();
        history.push([].into_iter());
        history.rebuild(&[None, None]);
        assert_eq!((history.values(0), history.values(2)), (vec![], vec![]));
        history.push([Some(1.0), None].into_iter());
        history.push([None, Some(7.5)].into_iter());
        history.push([Some(f64::MAX), Some(8.5)].into_iter());
        assert_eq!(history.values(0), [Some(1.0), None, None]);
        assert_eq!(history.values(1), [Some(7.5), Some(8.5)]);
        (0..MAX_SLOTS).for_each(|slot| history.push([Some(slot as f64), None].into_iter()));
        let values = history.values(0);
        assert_eq!((values.len(), values[0], values[MAX_SLOTS - 1]), (150, Some(0.0), Some(149.0)));
        assert_eq!((history.values(1), history.newest()), (vec![], 154));
    }

    #[test]
    fn tags_keep_their_values_in_another_list() {
        let mut history = History::new();
        history.rebuild(&[None, None]);
        history.push([Some(1.0), Some(2.0)].into_iter());
        history.rebuild(&[None, Some(1), Some(0)]);
        history.push([Some(9.0), Some(3.0), None].into_iter());
        assert_eq!(history.values(0), [Some(9.0)]);
        assert_eq!(history.values(1), [Some(2.0), Some(3.0)]);
        assert_eq!(history.values(2), [Some(1.0), None]);
    }

    #[test]
    fn memory_is_bounded_with_many_tags() {
        let mut history = History::new();
        history.rebuild(&vec![None; MAX_VALUES / 2]);
        assert_eq!((history.kept, history.values.len()), (2, MAX_VALUES));
        history.rebuild(&vec![None; MAX_VALUES + 1]);
        history.push([Some(1.0)].into_iter());
        assert_eq!((history.kept, history.values(0)), (0, vec![]));
    }
}
