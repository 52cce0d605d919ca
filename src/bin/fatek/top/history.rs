//! Recent values of a tag, and their sparkline.

use std::collections::VecDeque;

use fatek::tag::TagValue;

/// Values kept: more than a wide terminal shows.
const CAPACITY: usize = 240;

/// The lowest to the highest value.
const LEVELS: [char; 8] = ['▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];

/// The last values of a tag as numbers, the newest last. `None`: no good value, or one that is no
/// number.
#[derive(Clone, Debug, Default)]
pub(super) struct History(VecDeque<Option<f64>>);

impl History {
    pub(super) fn push(&mut self, value: Option<&TagValue>) {
        if self.0.len() == CAPACITY {
            self.0.pop_front();
        }
        self.0.push_back(value.and_then(number).filter(|number| number.is_finite()));
    }

    /// The last values as a line of this width at most: a character for each, a blank for a missing
    /// one. Between the lowest and the highest of them the scale is linear; a constant is shown at
    /// half height.
    pub(super) fn sparkline(&self, width: usize) -> String {
        let shown = self.0.range(self.0.len().saturating_sub(width)..);
        let numbers = || shown.clone().flatten().copied();
        let (low, high) = (numbers().fold(f64::INFINITY, f64::min), numbers().fold(f64::NEG_INFINITY, f64::max));
        let level = |number: f64| {
            // Halves: the difference of two large numbers would be infinite.
            let share = (number / 2.0 - low / 2.0) / (high / 2.0 - low / 2.0);
            let last = LEVELS.len() - 1;
            // NaN for a constant.
            let level = if share.is_nan() { last / 2 } else { (share * last as f64).round() as usize };
            LEVELS[level.min(last)]
        };
        shown.clone().map(|value| value.map_or(' ', level)).collect()
    }
}

/// The number of a value: 0 or 1 of a state.
pub(crate) fn number(value: &TagValue) -> Option<f64> {
    if let TagValue::Bool(state) = value { Some(f64::from(u8::from(*state))) } else { value.as_f64() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn history(values: impl IntoIterator<Item = TagValue>) -> History {
        let mut history = History::default();
        values.into_iter().for_each(|value| history.push(Some(&value)));
        history
    }

    #[test]
    fn a_sparkline_is_scaled_between_its_extremes() {
        let line = |values: &[f64]| history(values.iter().map(|&value| TagValue::F64(value))).sparkline(20);
        assert_eq!(line(&[0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]), "▁▂▃▄▅▆▇█");
        assert_eq!(line(&[-70.0, 0.0]), "▁█");
        assert_eq!(line(&[5.0, 5.0]), "▄▄");
        assert_eq!(line(&[f64::MIN, 0.0, f64::MAX, f64::NAN, f64::INFINITY]), "▁▅█  ");
        assert_eq!(line(&[]), "");
    }

    #[test]
    fn states_have_two_levels_and_texts_none() {
        let states = history([true, false, true].map(TagValue::Bool));
        assert_eq!(states.sparkline(20), "█▁█");
        assert_eq!(history([TagValue::Text("9".to_owned())]).sparkline(20), " ");
    }

    #[test]
    fn the_newest_values_are_shown_and_the_oldest_dropped() {
        let mut history = history((0..1000).map(TagValue::U16));
        history.push(None);
        assert_eq!(history.0.len(), CAPACITY);
        assert_eq!(history.sparkline(4), "▁▅█ ");
        assert_eq!(history.sparkline(0), "");
        assert_eq!(history.sparkline(5000).chars().count(), CAPACITY);
    }
}
