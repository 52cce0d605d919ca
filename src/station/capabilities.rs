//! The capabilities of a station.

use crate::capabilities::Capabilities;
use crate::station::Station;

/// Capabilities of the PLC.
impl Station {
    /// Returns what is known of the capabilities of the station, over all handles of the link.
    ///
    /// They are those of [`set_capabilities`](Self::set_capabilities) and [`probe`](Self::probe), and what
    /// was learned since: a refusal of mixed reads or of words of discretes, for ten minutes; an answer to a
    /// broadcast; and, except on a serial line, the smoothed round trip as the response time.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.read_status().await?;
    /// let known = station.capabilities();
    /// assert!(known.response_time().is_some());
    /// assert_eq!(known.max_registers(), None);
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn capabilities(&self) -> Capabilities {
        let mut known = self.link.known_capabilities(self.number);
        let stats = self.stats();
        if stats.broadcast_answers > 0 {
            known = known.with_answers_broadcasts(true);
        }
        // On a serial line the round trip is mostly the time of the bytes of the reply.
        if let (None, None, Some(round_trip)) = (known.response_time(), self.link.line(), stats.round_trip) {
            known = known.with_response_time(round_trip.smoothed);
        }
        known
    }

    /// Declares the capabilities of the station, for all handles of the link, in place of all that was
    /// declared or learned before.
    ///
    /// Reads and writes of any length, [`read`](Self::read) and its like, and plans and pollers that are made
    /// from now on keep to them. The link no longer uses the commands that are refused or unanswered for its
    /// own checks: without the loop-back (4E), the [quiet
    /// time](crate::endpoint::InStepSettings::with_quiet) of a connection without a proof takes its place.
    pub fn set_capabilities(&self, capabilities: Capabilities) {
        self.link.declare_capabilities(self.number, capabilities);
    }
}
