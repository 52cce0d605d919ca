//! The gate in front of each write to a PLC.
//!
//! A member owns its links until a deadline that each renewal of its session moves. It may be stopped, suspended or
//! cut off at any point, and wake after another member has taken its links. So the deadline is compared with the
//! clock before each write, by the code that writes.
//!
//! The check and the write are two steps. A process that is stopped exactly between them for longer than the rest
//! of the lease, which is at least a tenth of it, sends one request late. PLCs know no tokens, so no program can
//! close this gap.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use rustix::time::{ClockId, clock_gettime};

/// The time of `CLOCK_BOOTTIME` in nanoseconds. It goes on while the machine is suspended.
#[must_use]
pub fn boot_time() -> u64 {
    let time = clock_gettime(ClockId::Boottime);
    let seconds = u64::try_from(time.tv_sec).unwrap_or(0);
    let nanoseconds = u64::try_from(time.tv_nsec).unwrap_or(0);
    seconds.saturating_mul(1_000_000_000).saturating_add(nanoseconds)
}

/// The right to write to one link, for one ownership. Cheap to clone and to check.
#[derive(Clone, Debug)]
pub struct Gate(Option<Arc<State>>);

#[derive(Debug)]
struct State {
    deadline: Arc<AtomicU64>,
    is_revoked: AtomicBool,
}

impl Gate {
    /// The gate of a link that no other member can reach: always open.
    #[must_use]
    pub fn always_open() -> Self {
        Self(None)
    }

    /// A gate that is closed for ever.
    #[cfg(test)]
    pub(crate) fn closed() -> Self {
        Deadline::default().gate()
    }

    /// Returns whether a request may be written now. Asked before each write; the answer is void afterwards.
    #[must_use]
    pub fn is_open(&self) -> bool {
        #[cfg(feature = "naive-fleet")]
        if super::naive::has_no_deadline() {
            return self.is_open_at(0);
        }
        self.is_open_at(boot_time())
    }

    /// Returns whether a request may be written at a time of [`boot_time`].
    #[must_use]
    pub fn is_open_at(&self, now: u64) -> bool {
        let Some(state) = &self.0 else { return true };
        !state.is_revoked.load(Ordering::Acquire) && now < state.deadline.load(Ordering::Acquire)
    }

    /// Closes it for ever.
    pub(super) fn revoke(&self) {
        if let Some(state) = &self.0 {
            state.is_revoked.store(true, Ordering::Release);
        }
    }
}

/// The deadline that all gates of one session share. A new session has a new one.
#[derive(Debug, Default)]
pub(super) struct Deadline(Arc<AtomicU64>);

impl Deadline {
    /// Moves it. 0 closes all gates of the session.
    pub(super) fn set(&self, until: u64) {
        self.0.store(until, Ordering::Release);
    }

    /// The gate of a link that the session owns.
    pub(super) fn gate(&self) -> Gate {
        Gate(Some(Arc::new(State { deadline: self.0.clone(), is_revoked: AtomicBool::new(false) })))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gate_is_open_before_its_deadline_alone() {
        let deadline = Deadline::default();
        let gate = deadline.gate();
        assert!(!gate.is_open_at(0), "closed at first");
        deadline.set(100);
        assert!(gate.is_open_at(99));
        assert!(!gate.is_open_at(100), "closed at the deadline");
        deadline.set(u64::MAX);
        assert!(gate.is_open());
        deadline.set(0);
        assert!(!gate.is_open());
        assert!(Gate::always_open().is_open_at(u64::MAX));
    }

    #[test]
    fn a_revoked_gate_stays_closed() {
        let deadline = Deadline::default();
        let (gate, other) = (deadline.gate(), deadline.gate());
        deadline.set(100);
        gate.clone().revoke();
        assert!(!gate.is_open_at(1));
        assert!(other.is_open_at(1), "the other links of the session go on");
        deadline.set(200);
        assert!(!gate.is_open_at(1), "no renewal opens it again");
    }

    #[test]
    fn the_clock_goes_forward() {
        let before = boot_time();
        assert!(before > 0 && boot_time() >= before);
    }
}
