//! The points of a chart, and the scales of its axes.

use std::collections::VecDeque;
use std::time::Duration;

use fatek::tag::TagValue;
use tokio::time::Instant;

use crate::printable::printable;
use crate::top::history::number;

/// Points kept of each line.
const MAX_POINTS: usize = 20_000;
/// Readings shown at first.
const READINGS: u32 = 120;
/// Largest number that is drawn: differences of two are finite.
const LARGEST: f64 = 1e300;
/// Numbers that differ by less are drawn as one: a step between them has no logarithm.
const SMALLEST_SPAN: f64 = 1e-300;
const SHORTEST: Duration = Duration::from_secs(2);
const LONGEST: Duration = Duration::from_secs(86_400);

/// A line of a chart.
#[derive(Debug)]
pub(super) struct Series {
    /// Label and unit, printable.
    pub(super) label: String,
    pub(super) unit: String,
    /// Time and number; `None` where the value could not be read.
    points: VecDeque<(Instant, Option<f64>)>,
    /// The last value.
    pub(super) value: Option<TagValue>,
    /// Reason why the last value is not good.
    pub(super) reason: Option<String>,
}

/// A chart.
#[derive(Debug)]
pub(super) struct Plot {
    /// The tag as given, printable.
    pub(super) title: String,
    pub(super) series: Vec<Series>,
    pub(super) interval: Duration,
    /// Time shown.
    pub(super) window: Duration,
    /// Time at the right end.
    now: Instant,
    pub(super) is_paused: bool,
    /// Readings that were dropped, because the display was too slow.
    pub(super) missed: u64,
}

impl Series {
    pub(super) fn new(label: &str, unit: &str) -> Self {
        let text = |text: &str| printable(text).to_string();
        Self { label: text(label), unit: text(unit), points: VecDeque::new(), value: None, reason: None }
    }
}

impl Plot {
    pub(super) fn new(title: &str, series: Vec<Series>, interval: Duration, now: Instant) -> Self {
        let window = interval.saturating_mul(READINGS).clamp(SHORTEST, LONGEST);
        Self { title: printable(title).to_string(), series, interval, window, now, is_paused: false, missed: 0 }
    }

    /// Takes a value; `reason`: why it is not good.
    pub(super) fn take(&mut self, number_of: usize, at: Instant, value: Option<&TagValue>, reason: Option<&str>) {
        let Some(series) = self.series.get_mut(number_of) else { return };
        if series.points.len() == MAX_POINTS {
            series.points.pop_front();
        }
        let good = value.filter(|_| reason.is_none());
        series.points.push_back((at, good.and_then(number).filter(|number| number.abs() <= LARGEST)));
        series.value = value.cloned();
        series.reason = reason.map(|reason| printable(reason).to_string());
    }

    pub(super) fn miss(&mut self, readings: u64) {
        self.missed = self.missed.saturating_add(readings);
    }

    /// Moves the right end to this time, unless the chart is paused.
    pub(super) fn advance(&mut self, now: Instant) {
        if !self.is_paused {
            self.now = now;
        }
    }

    pub(super) fn pause(&mut self) {
        self.is_paused = !self.is_paused;
    }

    /// Shows a longer or a shorter time, by this factor.
    pub(super) fn zoom(&mut self, factor: f64) {
        self.window = Duration::from_secs_f64(
            (self.window.as_secs_f64() * factor).clamp(SHORTEST.as_secs_f64(), LONGEST.as_secs_f64()),
        );
    }

    /// The parts of a line without gaps: seconds, 0 at the right end, and numbers.
    pub(super) fn parts(&self, series: &Series) -> Vec<Vec<(f64, f64)>> {
        let oldest = self.now.checked_sub(self.window);
        let mut parts = vec![Vec::new()];
        for (at, number) in &series.points {
            // A value that came during a pause is not shown.
            if *at > self.now || oldest.is_some_and(|oldest| *at < oldest) {
                continue;
            }
            match (number, parts.last_mut()) {
                (Some(number), Some(part)) => part.push((-(self.now - *at).as_secs_f64(), *number)),
                (None, Some(part)) if !part.is_empty() => parts.push(Vec::new()),
                (None | Some(_), _) => {}
            }
        }
        parts.retain(|part| !part.is_empty());
        parts
    }
}

/// The lowest and the highest number of some points; `None` without points.
pub(super) fn extremes<'p>(points: impl Iterator<Item = &'p (f64, f64)>) -> Option<(f64, f64)> {
    points.fold(None, |extremes, &(_, number)| match extremes {
        None => Some((number, number)),
        Some((low, high)) => Some((f64::min(low, number), f64::max(high, number))),
    })
}

/// The axis of numbers: from a multiple of a round step to another one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct NumberAxis {
    pub(super) low: f64,
    pub(super) high: f64,
    step: f64,
    steps: u32,
}

impl NumberAxis {
    /// An axis of 2 to 8 steps that holds the numbers between these.
    pub(super) fn new(extremes: Option<(f64, f64)>) -> Self {
        let (low, high) = extremes.unwrap_or((0.0, 1.0));
        let largest = low.abs().max(high.abs());
        // A constant, or nearly one: numbers on both sides of it.
        let is_constant = high - low <= (largest * 1e-9).max(SMALLEST_SPAN);
        let margin = if is_constant { (largest / 10.0).max(1.0) } else { 0.0 };
        let (low, high) = (low - margin, high + margin);
        let step = round_step((high - low) / 4.0);
        let (first, last) = ((low / step).floor(), (high / step).ceil());
        Self { low: first * step, high: last * step, step, steps: (last - first) as u32 }
    }

    /// Texts from the lower to the upper end: of each step, or of the ends alone.
    pub(super) fn labels(&self, has_steps: bool) -> Vec<String> {
        let largest = self.low.abs().max(self.high.abs());
        // As many places as tell two steps apart.
        let places = (-self.step.log10().floor()).clamp(0.0, 12.0) as usize;
        let digits = (largest / self.step).log10().ceil().clamp(1.0, 12.0) as usize;
        let is_long = largest >= 1e9 || self.step < 1e-6;
        let text = |number: f64| if is_long { format!("{number:.digits$e}") } else { format!("{number:.places$}") };
        // No negative zero.
        let label = |step: u32| text(self.low + self.step * f64::from(step) + 0.0);
        let every = if has_steps { 1 } else { self.steps.max(1) as usize };
        (0..=self.steps).step_by(every).map(label).collect()
    }
}

/// The smallest of 1, 2 and 5 times a power of ten that is not less than this.
fn round_step(least: f64) -> f64 {
    let power = 10_f64.powf(least.log10().floor());
    let factor = [1.0, 2.0, 5.0].into_iter().find(|factor| factor * power >= least).unwrap_or(10.0);
    factor * power
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn plot() -> (Plot, Instant) {
        let start = Instant::now();
        (Plot::new("R0", vec![Series::new("R0", "")], SECOND, start), start)
    }

    #[test]
    fn a_line_has_a_gap_where_no_value_was_read() {
        let (mut plot, start) = plot();
        for (second, value) in [(1, Some(1)), (2, Some(2)), (3, None), (4, None), (5, Some(5))] {
            let value = value.map(TagValue::U16);
            plot.take(0, start + SECOND * second, value.as_ref(), value.is_none().then_some("bad\n"));
        }
        plot.advance(start + SECOND * 6);
        assert_eq!(plot.parts(&plot.series[0]), [vec![(-5.0, 1.0), (-4.0, 2.0)], vec![(-1.0, 5.0)]]);
        // A stale value is not drawn.
        plot.take(0, start + SECOND * 6, Some(&TagValue::U16(9)), Some("stale\n"));
        assert_eq!(plot.parts(&plot.series[0]).len(), 2);
        assert_eq!(plot.series[0].reason.as_deref(), Some("stale\\n"));
    }

    #[test]
    fn the_window_hides_older_and_the_pause_newer_values() {
        let (mut plot, start) = plot();
        assert_eq!(plot.window, SECOND * 120);
        for second in 1..=10 {
            plot.take(0, start + SECOND * second, Some(&TagValue::Bool(second % 2 == 0)), None);
        }
        plot.advance(start + SECOND * 10);
        (0..10).for_each(|_| plot.zoom(0.5));
        assert_eq!(plot.window, SHORTEST);
        assert_eq!(plot.parts(&plot.series[0]), [[(-2.0, 1.0), (-1.0, 0.0), (0.0, 1.0)]]);
        plot.pause();
        plot.take(0, start + SECOND * 11, Some(&TagValue::Bool(false)), None);
        plot.advance(start + SECOND * 11);
        assert_eq!(plot.parts(&plot.series[0])[0].len(), 3);
        (0..40).for_each(|_| plot.zoom(2.0));
        assert_eq!(plot.window, LONGEST);
    }

    #[test]
    fn the_number_of_points_is_bounded() {
        let (mut plot, start) = plot();
        (0..MAX_POINTS + 5).for_each(|_| plot.take(0, start, Some(&TagValue::U16(1)), None));
        assert_eq!(plot.series[0].points.len(), MAX_POINTS);
        plot.take(9, start, None, None);
    }

    #[test]
    fn the_axis_has_round_numbers_and_holds_all_values() {
        let labels = |low, high| NumberAxis::new(Some((low, high))).labels(true).join(" ");
        assert_eq!(labels(0.0, 39.0), "0 10 20 30 40");
        assert_eq!(labels(-0.3, 0.41), "-0.4 -0.2 0.0 0.2 0.4 0.6");
        assert_eq!(labels(21.5, 21.5), "18 20 22 24");
        assert_eq!(labels(0.0, 1.0), "0.0 0.5 1.0");
        assert_eq!(labels(0.0, 4_294_967_295.0), "0.0e0 2.0e9 4.0e9 6.0e9");
        assert_eq!(NumberAxis::new(Some((0.0, 39.0))).labels(false), ["0", "40"]);
        assert_eq!(NumberAxis::new(None), NumberAxis::new(Some((0.0, 1.0))));
        for (low, high) in [
            (-LARGEST, LARGEST),
            (LARGEST, LARGEST),
            (1.0, 1.001),
            (5e-324, 5e-324),
            (0.0, 5e-324),
            (-5e-324, 1e-299),
            (1e12, 1.001e12),
            (0.0, 1e-9),
        ] {
            let axis = NumberAxis::new(Some((low, high)));
            assert!(axis.low <= low && high <= axis.high && axis.low < axis.high, "{axis:?}");
            assert!(axis.low.is_finite() && axis.high.is_finite() && (2..=8).contains(&axis.steps), "{axis:?}");
            let mut labels = axis.labels(true);
            assert!(labels.iter().all(|label| label.len() <= 12), "{labels:?}");
            labels.dedup();
            assert_eq!(labels.len(), axis.steps as usize + 1, "{labels:?}");
        }
    }
}
