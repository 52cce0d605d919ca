//! How many replies a reading holds before a check.

/// The limit of replies that are held. A run that fails loses the held ones, so the limit falls
/// after such a run and rises again with each check.
#[derive(Clone, Copy, Debug)]
pub(crate) struct HoldLimit {
    limit: usize,
    max: usize,
}

impl HoldLimit {
    pub(crate) const fn new(max: usize) -> Self {
        Self { limit: max, max }
    }

    /// Returns whether a check is due.
    pub(crate) fn is_reached(self, held: usize) -> bool {
        held >= self.limit
    }

    /// A run ended with held replies: short runs must keep something, too.
    pub(crate) fn lower(&mut self) {
        self.limit = (self.limit / 4).max(1);
    }

    /// A check has confirmed all replies.
    pub(crate) fn raise(&mut self) {
        self.limit = self.limit.saturating_mul(2).min(self.max);
    }
}
