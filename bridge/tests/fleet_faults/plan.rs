//! The faults of a round, drawn from a seed.

use std::fmt;
use std::time::Duration;

use super::proxy::Act;

/// The lease of the members.
pub(crate) const LEASE: Duration = Duration::from_millis(500);

/// A fault, or an act of an operator.
#[derive(Clone, Debug, PartialEq)]
pub(crate) enum Fault {
    /// SIGKILL, and started again.
    Kill { again: Duration },
    /// SIGSTOP, then SIGCONT.
    Stop { time: Duration },
    /// The way to NATS is cut in one direction or both.
    Cut { time: Duration, up: bool, down: bool, end: CutEnd },
    /// Messages are late.
    Delay { time: Duration, up: Duration, down: Duration, entries: Duration },
    /// Messages come twice.
    Repeat { is_up: bool, count: u32, later: Duration },
    /// SIGTERM, and started again.
    Terminate { again: Duration },
    /// A link is moved by hand.
    Move { link: usize },
    /// A member is drained by hand.
    Drain { time: Duration },
    /// The wall clock steps, by seconds.
    Clock { step: i64 },
    /// The server is killed, and started again.
    Server { down: Duration },
    /// The store is deleted, and made again.
    Delete { again: Duration },
    /// The store is set back by a time. `is_fresh`: a member that knows neither state joins.
    SetBack { by: Duration, down: Duration, is_fresh: bool },
}

/// The end of a connection of a way that is cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum CutEnd {
    /// Held messages are delivered.
    Delivered,
    /// The connection is reset at the end of the cut: held messages are lost.
    ResetLate,
    /// The connection is reset at once, and new ones are refused.
    Refused,
}

/// The moment of a fault: this time after an act of a member, or after the begin of the round.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Moment {
    pub(crate) act: Option<Act>,
    /// It is an act of the member that the fault is for; else of any.
    pub(crate) is_own: bool,
    pub(crate) after: Duration,
}

/// A fault with its moment.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Planned {
    pub(crate) member: usize,
    pub(crate) fault: Fault,
    pub(crate) moment: Moment,
}

/// The kinds of faults, as the table has them.
pub(crate) const KINDS: [&str; 12] = [
    "SIGKILL, restart",
    "SIGSTOP, SIGCONT",
    "cut from NATS",
    "delayed messages",
    "doubled messages",
    "SIGTERM, restart",
    "moved by hand",
    "drained by hand",
    "clock step",
    "server kill -9, restart",
    "store deleted",
    "store set back",
];

impl Fault {
    pub(crate) fn kind(&self) -> usize {
        match self {
            Self::Kill { .. } => 0,
            Self::Stop { .. } => 1,
            Self::Cut { .. } => 2,
            Self::Delay { .. } => 3,
            Self::Repeat { .. } => 4,
            Self::Terminate { .. } => 5,
            Self::Move { .. } => 6,
            Self::Drain { .. } => 7,
            Self::Clock { .. } => 8,
            Self::Server { .. } => 9,
            Self::Delete { .. } => 10,
            Self::SetBack { .. } => 11,
        }
    }

    /// Returns whether all members must stop.
    pub(crate) fn ends_fleet(&self) -> bool {
        matches!(self, Self::Delete { .. } | Self::SetBack { .. })
    }
}

impl fmt::Display for Planned {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Moment { act, is_own, after } = self.moment;
        let of = if is_own { "its" } else { "any" };
        let act = act.map_or_else(|| "begin".to_owned(), |act| format!("{of} {act:?}"));
        write!(f, "hall-{}, {after:.0?} after {act}: {:?}", self.member + 1, self.fault)
    }
}

/// Draws the faults of a round.
pub(crate) fn draw(seed: u64, members: usize, links: usize) -> Vec<Planned> {
    let mut rng = fastrand::Rng::with_seed(seed);
    // A store that ends is a round of its own.
    if rng.u8(..100) < 7 {
        let (down, moment) = (part(&mut rng, 0.0, 2.0), moment(&mut rng));
        let fault = match rng.bool() {
            true => Fault::Delete { again: part(&mut rng, 0.0, 5.0) },
            false => Fault::SetBack { by: part(&mut rng, 0.1, 5.0), down, is_fresh: rng.bool() },
        };
        return vec![Planned { member: rng.usize(..members), fault, moment }];
    }
    let count = [1, 2, 3, 3, 4, 4, 5, 6][rng.usize(..8)];
    let mut faults: Vec<Planned> = Vec::new();
    // Faults of one member at once are worse than faults of many.
    let worst = rng.usize(..members);
    while faults.len() < count {
        let member = if rng.bool() { worst } else { rng.usize(..members) };
        let planned = Planned { member, fault: fault(&mut rng, links), moment: moment(&mut rng) };
        let is_server = |planned: &Planned| matches!(planned.fault, Fault::Server { .. });
        if !is_server(&planned) || !faults.iter().any(is_server) {
            faults.push(planned);
        }
    }
    faults
}

/// A time in leases.
fn part(rng: &mut fastrand::Rng, from: f64, to: f64) -> Duration {
    LEASE.mul_f64(from + (to - from) * rng.f64())
}

/// A time of a fault: short, about the deadline, about the takeover, or long.
fn time(rng: &mut fastrand::Rng) -> Duration {
    match rng.u8(..10) {
        0..=1 => part(rng, 0.1, 0.8),
        2..=3 => part(rng, 0.8, 1.0),
        4..=6 => part(rng, 1.0, 1.5),
        _ => part(rng, 1.5, 5.0),
    }
}

fn moment(rng: &mut fastrand::Rng) -> Moment {
    let is_own = rng.u8(..3) > 0;
    let just = part(rng, 0.0, 0.04);
    let (act, after) = match rng.u8(..20) {
        // Before or after the reply to a renewal.
        0..=5 => (Some(Act::Renew), just),
        // Before the next one.
        6..=7 => (Some(Act::Renew), part(rng, 0.29, 0.33)),
        8..=11 => (Some(Act::Take), just),
        12..=13 => (Some(Act::Release), just),
        14..=15 => (Some(Act::Fence), just),
        _ => (None, part(rng, 0.0, 3.0)),
    };
    Moment { act, is_own: is_own && act != Some(Act::Fence), after }
}

fn fault(rng: &mut fastrand::Rng, links: usize) -> Fault {
    match rng.u8(..100) {
        0..=13 => Fault::Kill { again: part(rng, 0.0, 4.0) },
        14..=37 => Fault::Stop { time: time(rng) },
        38..=53 => {
            let (up, down) = [(true, true), (true, true), (true, false), (false, true)][rng.usize(..4)];
            let end = [CutEnd::Delivered, CutEnd::ResetLate, CutEnd::Refused][rng.usize(..3)];
            Fault::Cut { time: time(rng), up, down, end }
        }
        54..=65 => {
            // Requests, replies, both, or entries of the watch alone.
            let of =
                [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]][rng.usize(..5)];
            let [up, down, entries] = of.map(|of| part(rng, 0.05, 1.5).mul_f64(of));
            Fault::Delay { time: part(rng, 1.0, 5.0), up, down, entries }
        }
        66..=73 => Fault::Repeat { is_up: rng.u8(..4) > 0, count: rng.u32(1..20), later: part(rng, 0.0, 1.5) },
        74..=79 => Fault::Terminate { again: part(rng, 0.0, 2.0) },
        80..=83 => Fault::Move { link: rng.usize(..links) },
        84..=87 => Fault::Drain { time: time(rng) },
        88..=93 => Fault::Clock { step: [3600, -3600, 1, -1][rng.usize(..4)] },
        94.. => Fault::Server { down: if rng.bool() { Duration::ZERO } else { time(rng) } },
    }
}

#[test]
fn a_seed_gives_the_same_faults_and_all_kinds_come() {
    let mut counts = [0; KINDS.len()];
    for seed in 0..500 {
        let plan = draw(seed, 4, 10);
        assert_eq!(plan, draw(seed, 4, 10));
        assert!(plan.len() == 1 || !plan.iter().any(|planned| planned.fault.ends_fleet()));
        plan.iter().for_each(|planned| counts[planned.fault.kind()] += 1);
    }
    assert!(counts.iter().all(|count| *count > 5), "{counts:?}");
}
