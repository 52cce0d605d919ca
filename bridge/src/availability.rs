//! Log of PLCs that do not answer, and of those that answer again.
//!
//! ```text
//!             answers
//! starting ─────────────▶ online ◀── answers: a line ──┐
//!    │                      │                          │
//!    └── 10 s: a line ──────┴── silent: a line ──▶ offline
//! ```
//!
//! A line names a PLC. There are at most five in 10 s, and one a minute that the same PLC is silent; the others are
//! counted, and named by their number when these 10 s are over. So a plant whose switch fails makes some lines, and
//! not a thousand.

use std::collections::HashMap;
use std::sync::Arc;
use std::time::Duration;

use tokio::time::{Instant, MissedTickBehavior, interval};

use crate::plc_state::PlcState;
use crate::registry::Registry;

/// The time between two looks.
const LOOK: Duration = Duration::from_secs(1);
/// The time in which a PLC must answer after the start, or after a reload that has added it.
const GRACE: Duration = Duration::from_secs(10);
/// The time in which at most [`MAX_LINES`] are made.
const WINDOW: Duration = Duration::from_secs(10);
/// The lines that name a PLC, in a window.
const MAX_LINES: usize = 5;
/// The time between two lines that the same PLC is silent.
const REPEAT: Duration = Duration::from_secs(60);

/// Looks at the PLCs until it is dropped, and logs what has changed. Never returns.
pub async fn run(registry: Registry) {
    let mut availability = Availability::default();
    let mut tick = interval(LOOK);
    tick.set_missed_tick_behavior(MissedTickBehavior::Delay);
    loop {
        let now = tick.tick().await;
        let states: Vec<(Arc<str>, Option<String>)> =
            registry.read().iter().map(|plc| (plc.plc.name().into(), PlcState::of(plc).why)).collect();
        availability.look(now, &states).iter().for_each(log);
    }
}

fn log(line: &Line) {
    match line {
        Line::Silent { plc, why } => tracing::warn!(plc = &**plc, why, "the PLC does not answer"),
        Line::Back { plc, after } => {
            tracing::info!(plc = &**plc, seconds = after.as_secs(), "the PLC answers again");
        }
        Line::MoreSilent { count, offline, all } => {
            tracing::warn!("{count} more PLCs do not answer: {offline} of {all} are offline");
        }
        Line::MoreBack { count, offline, all } => {
            tracing::info!("{count} more PLCs answer again: {offline} of {all} are offline");
        }
    }
}

/// A line of the log.
#[derive(Clone, Debug, PartialEq, Eq)]
enum Line {
    Silent { plc: Arc<str>, why: String },
    Back { plc: Arc<str>, after: Duration },
    MoreSilent { count: usize, offline: usize, all: usize },
    MoreBack { count: usize, offline: usize, all: usize },
}

/// The PLCs as they were at the last look. No I/O, and no clock.
#[derive(Debug, Default)]
struct Availability {
    plcs: HashMap<Arc<str>, Known>,
    /// When the present window has begun; `None`: the next line begins one.
    window: Option<Instant>,
    lines: usize,
    more_silent: usize,
    more_back: usize,
}

#[derive(Debug)]
struct Known {
    state: State,
    /// When a line has said last that it is silent.
    said: Option<Instant>,
}

#[derive(Clone, Copy, Debug)]
enum State {
    Starting(Instant),
    Online,
    Offline {
        since: Instant,
        /// A line has said so.
        is_said: bool,
    },
}

impl Availability {
    /// Takes the PLCs of the configuration with the reasons why they are not online, and returns the lines.
    fn look(&mut self, now: Instant, plcs: &[(Arc<str>, Option<String>)]) -> Vec<Line> {
        let mut before = std::mem::take(&mut self.plcs);
        let mut lines = Vec::new();
        for (plc, why) in plcs {
            let known = before.remove(plc).unwrap_or(Known { state: State::Starting(now), said: None });
            let known = self.step(now, plc, why.as_deref(), known, &mut lines);
            self.plcs.insert(plc.clone(), known);
        }
        self.end_window(now, &mut lines);
        lines
    }

    fn step(&mut self, now: Instant, plc: &Arc<str>, why: Option<&str>, known: Known, lines: &mut Vec<Line>) -> Known {
        let Known { state, said } = known;
        let is_grace = matches!(state, State::Starting(since) if now.duration_since(since) < GRACE);
        match (state, why) {
            (State::Starting(_) | State::Online, None) => Known { state: State::Online, said },
            (State::Starting(_), Some(_)) if is_grace => Known { state, said },
            (State::Starting(_) | State::Online, Some(why)) => {
                let is_repeated = said.is_some_and(|said| now.duration_since(said) < REPEAT);
                let is_said = !is_repeated && self.take_line(now);
                if is_said {
                    lines.push(Line::Silent { plc: plc.clone(), why: why.to_owned() });
                } else {
                    self.window.get_or_insert(now);
                    self.more_silent = self.more_silent.saturating_add(1);
                }
                let said = if is_said { Some(now) } else { said };
                Known { state: State::Offline { since: now, is_said }, said }
            }
            (State::Offline { .. }, Some(_)) => Known { state, said },
            (State::Offline { since, is_said }, None) => {
                if is_said && self.take_line(now) {
                    lines.push(Line::Back { plc: plc.clone(), after: now.duration_since(since) });
                } else {
                    self.window.get_or_insert(now);
                    self.more_back = self.more_back.saturating_add(1);
                }
                Known { state: State::Online, said }
            }
        }
    }

    /// Takes a line of the present window, if one is left.
    fn take_line(&mut self, now: Instant) -> bool {
        self.window.get_or_insert(now);
        let is_left = self.lines < MAX_LINES;
        self.lines = self.lines.saturating_add(usize::from(is_left));
        is_left
    }

    fn end_window(&mut self, now: Instant, lines: &mut Vec<Line>) {
        if self.window.is_none_or(|begin| now.duration_since(begin) < WINDOW) {
            return;
        }
        let all = self.plcs.len();
        let offline = self.plcs.values().filter(|plc| matches!(plc.state, State::Offline { .. })).count();
        let (silent, back) = (std::mem::take(&mut self.more_silent), std::mem::take(&mut self.more_back));
        if silent > 0 {
            lines.push(Line::MoreSilent { count: silent, offline, all });
        }
        if back > 0 {
            lines.push(Line::MoreBack { count: back, offline, all });
        }
        (self.window, self.lines) = (None, 0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Case {
        availability: Availability,
        begin: Instant,
    }

    impl Case {
        fn new() -> Self {
            Self { availability: Availability::default(), begin: Instant::now() }
        }

        /// Looks at a second at PLCs of which those with these numbers answer.
        fn look(&mut self, second: u64, all: u32, answers: impl Fn(u32) -> bool) -> Vec<Line> {
            let plc = |n: u32| (format!("plc{n}").into(), (!answers(n)).then(|| "no answer".to_owned()));
            let plcs: Vec<_> = (0..all).map(plc).collect();
            self.availability.look(self.begin + Duration::from_secs(second), &plcs)
        }
    }

    fn silent(n: u32) -> Line {
        Line::Silent { plc: format!("plc{n}").into(), why: "no answer".to_owned() }
    }

    fn back(n: u32, seconds: u64) -> Line {
        Line::Back { plc: format!("plc{n}").into(), after: Duration::from_secs(seconds) }
    }

    #[test]
    fn a_plc_that_does_not_answer_is_named_once_and_when_it_is_back() {
        let mut case = Case::new();
        for second in 0..10 {
            assert_eq!(case.look(second, 2, |n| n == 0), [], "it has time to answer");
        }
        assert_eq!(case.look(10, 2, |n| n == 0), [silent(1)]);
        assert_eq!(case.look(11, 2, |n| n == 0), []);
        assert_eq!(case.look(30, 2, |_| true), [back(1, 20)]);
        // One that has answered has no more time.
        assert_eq!(case.look(31, 2, |n| n == 1), [silent(0)]);
        assert_eq!(case.look(32, 2, |_| true), [back(0, 1)]);
        // A PLC that leaves the configuration is forgotten.
        assert_eq!(case.look(60, 1, |_| true), []);
        assert_eq!(case.look(61, 2, |n| n == 0), []);
    }

    #[test]
    fn a_plc_that_comes_and_goes_does_not_fill_the_log() {
        let mut case = Case::new();
        case.look(0, 1, |_| true);
        let lines: Vec<Line> = (1..=120).flat_map(|second| case.look(second, 1, |_| second % 2 == 0)).collect();
        let named = lines.iter().filter(|line| matches!(line, Line::Silent { .. } | Line::Back { .. })).count();
        let counted: usize = lines
            .iter()
            .map(|line| match line {
                Line::MoreSilent { count, .. } | Line::MoreBack { count, .. } => *count,
                Line::Silent { .. } | Line::Back { .. } => 0,
            })
            .sum();
        assert_eq!(named, 4, "{lines:?}");
        assert!(lines.len() <= 4 + 2 * 12 && counted >= 100, "{lines:?}");
    }

    /// Without the limit there were 1000 lines.
    #[test]
    fn a_thousand_plcs_make_some_lines_and_a_sum() {
        let mut case = Case::new();
        assert_eq!(case.look(0, 1000, |_| true), []);
        assert_eq!(case.look(1, 1000, |n| n >= 700), (0..5).map(silent).collect::<Vec<_>>());
        assert_eq!(case.look(5, 1000, |_| false), []);
        assert_eq!(case.look(11, 1000, |_| false), [Line::MoreSilent { count: 995, offline: 1000, all: 1000 }]);
        assert_eq!(case.look(12, 1000, |n| n < 900), (0..5).map(|n| back(n, 11)).collect::<Vec<_>>());
        assert_eq!(case.look(22, 1000, |n| n < 900), [Line::MoreBack { count: 895, offline: 100, all: 1000 }]);
        assert_eq!(case.look(40, 1000, |n| n < 900), []);
    }
}
