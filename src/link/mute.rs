//! Detects a connection over which nothing is answered any more.
//!
//! A device or a network in between can drop a connection without closing it: the operating system
//! still sends, and nothing comes back, while a new connection would be served. A station that is
//! switched off looks the same, so all stations of the connection count: one frame from any of
//! them, and the connection is not mute.

use std::time::Duration;

use tokio::time::Instant;

#[derive(Debug)]
pub(crate) struct MuteDetector {
    /// Silence after which a connection is mute; `None`: never.
    limit: Option<Duration>,
    /// Boxed: most connections are answered.
    unanswered: Option<Box<Unanswered>>,
    /// One request without an answer is enough.
    on_trial: bool,
}

/// Requests without any frame since.
#[derive(Debug)]
struct Unanswered {
    /// When the first of them was sent.
    since: Instant,
    /// When the last of them was sent.
    last: Instant,
    requests: u32,
    /// One of them was for a call.
    for_call: bool,
}

/// A connection is not mute before this number of requests.
const MIN_REQUESTS: u32 = 3;

impl MuteDetector {
    pub(crate) fn new(limit: Option<Duration>) -> Self {
        Self { limit, unanswered: None, on_trial: false }
    }

    /// Notes a frame, or a new connection.
    pub(crate) fn reset(&mut self) {
        self.unanswered = None;
        self.on_trial = false;
    }

    /// Notes that a new connection may be to the wrong address.
    pub(crate) fn begin_trial(&mut self) {
        self.on_trial = true;
    }

    /// Notes that a request, begun at `began`, was not answered. `for_call`: not the probe of a station
    /// that is offline, which decides no trial.
    pub(crate) fn unanswered(&mut self, began: Instant, for_call: bool) {
        let first = || Box::new(Unanswered { since: began, last: began, requests: 0, for_call: false });
        // A time without requests is no silence.
        let is_old =
            |it: &mut Box<Unanswered>| self.limit.is_some_and(|limit| began.saturating_duration_since(it.last) > limit);
        self.unanswered.take_if(is_old);
        let unanswered = self.unanswered.get_or_insert_with(first);
        unanswered.last = began;
        unanswered.for_call |= for_call;
        unanswered.requests = unanswered.requests.saturating_add(1);
    }

    /// The time of silence if the connection is mute.
    pub(crate) fn mute_for(&self, now: Instant) -> Option<Duration> {
        let unanswered = self.unanswered.as_ref()?;
        let silent = now.saturating_duration_since(unanswered.since);
        if self.on_trial && unanswered.for_call && self.limit.is_some() {
            return Some(silent);
        }
        (unanswered.requests >= MIN_REQUESTS && silent >= self.limit?).then_some(silent)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    #[test]
    fn it_takes_several_requests_and_the_limit() {
        let now = Instant::now();
        let mut detector = MuteDetector::new(Some(5 * SECOND));
        detector.unanswered(now, true);
        detector.unanswered(now + SECOND, true);
        assert_eq!(detector.mute_for(now + 9 * SECOND), None, "two requests");
        detector.unanswered(now + 2 * SECOND, true);
        assert_eq!(detector.mute_for(now + 4 * SECOND), None, "4 s");
        assert_eq!(detector.mute_for(now + 5 * SECOND), Some(5 * SECOND));
        detector.reset();
        assert_eq!(detector.mute_for(now + 9 * SECOND), None);
    }

    #[test]
    fn a_connection_on_trial_is_mute_after_one_request() {
        let now = Instant::now();
        for (limit, mute_for) in [(Some(5 * SECOND), Some(SECOND)), (None, None)] {
            let mut detector = MuteDetector::new(limit);
            detector.begin_trial();
            assert_eq!(detector.mute_for(now), None);
            detector.unanswered(now, false);
            assert_eq!(detector.mute_for(now + SECOND), None, "a probe of a station that is off");
            detector.unanswered(now, true);
            assert_eq!(detector.mute_for(now + SECOND), mute_for);
            detector.reset();
            detector.unanswered(now, true);
            assert_eq!(detector.mute_for(now + SECOND), None, "a frame came: the address is right");
        }
    }

    #[test]
    fn without_a_limit_no_connection_is_mute() {
        let now = Instant::now();
        let mut detector = MuteDetector::new(None);
        (0..9).for_each(|_| detector.unanswered(now, true));
        assert_eq!(detector.mute_for(now + 900 * SECOND), None);
    }

    #[test]
    fn a_time_without_requests_is_no_silence() {
        let now = Instant::now();
        let mut detector = MuteDetector::new(Some(5 * SECOND));
        detector.unanswered(now, true);
        detector.unanswered(now + 6 * SECOND, true);
        detector.unanswered(now + 7 * SECOND, true);
        assert_eq!(detector.mute_for(now + 13 * SECOND), None, "two requests since");
        detector.unanswered(now + 8 * SECOND, true);
        assert_eq!(detector.mute_for(now + 13 * SECOND), Some(7 * SECOND));
    }
}
