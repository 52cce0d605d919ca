//! The capabilities of a station.

use crate::capabilities::Capabilities;
use crate::command::RequestLengths;
use crate::station::Station;

/// Capabilities of the PLC.
impl Station {
    /// Returns what is known of the capabilities of the station, over all handles of the link.
    ///
    /// They are those of [`set_capabilities`](Self::set_capabilities) and [`probe`](Self::probe), and what
    /// calls, plans and pollers have learned since: a refusal of mixed reads or writes, or of words of
    /// discretes, for ten minutes, and of longer requests, which only pollers learn; an answer to a
    /// broadcast; and, except on a serial line, the smoothed round trip as the response time. A poller
    /// ignores refusals of others: it learns for itself. Learned lengths apply to plans and
    /// [`read`](Self::read), but not to reads and writes of [any length](Self#any-length), backups and
    /// restores.
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

    /// The declared capabilities, without those learned, which expire.
    pub(crate) fn declared_capabilities(&self) -> Capabilities {
        self.link.declared_capabilities(self.number)
    }

    /// The longest requests for consecutive elements, within the declared capabilities.
    ///
    /// Lengths that a poller has learned do not count: a refused read may be one of its place, it
    /// says nothing of writes, and callers rely on the scan of one request.
    pub(crate) fn request_lengths(&self) -> RequestLengths {
        if self.link.knows_capabilities() {
            self.declared_capabilities().request_lengths()
        } else {
            RequestLengths::PROTOCOL
        }
    }

    /// Declares the capabilities of the station, for all handles of the link, in place of all that was
    /// declared or learned before.
    ///
    /// Reads and writes of any length, [`read`](Self::read) and its like, backups, restores, and plans and
    /// pollers that are made from now on follow them. Pages of programs have one length. The link sends
    /// nothing by itself that is refused or unanswered, but for a refused loop-back (4E). If that is
    /// unanswered, the status (40 or 53) and the
    /// [quiet time](crate::endpoint::InStepSettings::with_quiet) behind it take its place.
    ///
    /// Another link to the same PLC, such as one of a [`Pool`](crate::Pool) or after an eviction, does not
    /// know them.
    pub fn set_capabilities(&self, capabilities: Capabilities) {
        self.link.declare_capabilities(self.number, capabilities);
    }
}
