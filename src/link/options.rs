use std::time::Duration;

use super::defaults;
use crate::command::Class;

/// How a call is treated: its timeouts, retries and priority.
///
/// A link has one for all its stations ([`LinkBuilder::options`](super::LinkBuilder::options)), and
/// [`Station::with_options`](crate::Station::with_options) makes a handle with its own.
///
/// ```
/// use std::time::Duration;
/// use fatek::CallOptions;
///
/// let timeout = Duration::from_secs(3);
/// let patient = CallOptions::new().with_response_timeout(timeout).with_retry_writes(true);
/// assert_eq!((patient.response_timeout(), patient.retry_writes()), (Some(timeout), true));
/// // All others have their defaults.
/// assert_eq!((patient.call_timeout(), patient.retries()), (Duration::from_secs(10), 2));
/// assert_eq!((patient.background(), patient.adaptive_timeout()), (false, None));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct CallOptions {
    pub(crate) response_timeout: Option<Duration>,
    pub(crate) call_timeout: Duration,
    pub(crate) retries: u32,
    pub(crate) retry_writes: bool,
    pub(crate) background: bool,
    pub(crate) adaptive: Option<Duration>,
}

impl CallOptions {
    /// The defaults: the response timeout of the link, and those of [`defaults`].
    #[must_use]
    pub fn new() -> Self {
        Self {
            response_timeout: None,
            call_timeout: defaults::CALL_TIMEOUT,
            retries: defaults::RETRIES,
            retry_writes: false,
            background: false,
            adaptive: None,
        }
    }

    /// Sets the response timeout, counted from the end of the request. Default: that of the link,
    /// [`RESPONSE_TIMEOUT`](defaults::RESPONSE_TIMEOUT), or
    /// [`SERIAL_RESPONSE_TIMEOUT`](defaults::SERIAL_RESPONSE_TIMEOUT) on a serial line.
    #[must_use]
    pub fn with_response_timeout(mut self, timeout: Duration) -> Self {
        self.response_timeout = Some(timeout);
        self
    }

    /// Sets the timeout of the whole call: queueing, connecting and retries included. Default:
    /// [`CALL_TIMEOUT`](defaults::CALL_TIMEOUT).
    ///
    /// A read or write of more than one request is several calls, each with this timeout.
    #[must_use]
    pub fn with_call_timeout(mut self, timeout: Duration) -> Self {
        self.call_timeout = timeout;
        self
    }

    /// Sets how often a request is sent again after a timeout or a bad reply. Default:
    /// [`RETRIES`](defaults::RETRIES).
    ///
    /// Only reads are retried, unless [`with_retry_writes`](Self::with_retry_writes) is set.
    #[must_use]
    pub fn with_retries(mut self, retries: u32) -> Self {
        self.retries = retries;
        self
    }

    /// Sets whether writes and control commands are retried. Default: `false`.
    ///
    /// The PLC may have executed the first one: allow it only for requests that are idempotent.
    #[must_use]
    pub fn with_retry_writes(mut self, retry: bool) -> Self {
        self.retry_writes = retry;
        self
    }

    /// Sets whether reads have the lowest priority on the link, as suits polling. Default: `false`.
    #[must_use]
    pub fn with_background(mut self, background: bool) -> Self {
        self.background = background;
        self
    }

    /// Adapts the response timeout of each station to its round trips, between `shortest` and
    /// [`response_timeout`](Self::response_timeout). Default: not adapted.
    ///
    /// The estimate is that of TCP (RFC 6298): the smoothed round trip and four times its
    /// deviation, doubled with each timeout.
    #[must_use]
    pub fn with_adaptive_timeout(mut self, shortest: Duration) -> Self {
        self.adaptive = Some(shortest);
        self
    }

    /// The response timeout; `None`: that of the link. The options of a
    /// [`Station`](crate::Station) without options of its own have that of its link.
    #[must_use]
    pub fn response_timeout(&self) -> Option<Duration> {
        self.response_timeout
    }

    /// The timeout of the whole call.
    #[must_use]
    pub fn call_timeout(&self) -> Duration {
        self.call_timeout
    }

    /// How often a request is sent again after a timeout or a bad reply.
    #[must_use]
    pub fn retries(&self) -> u32 {
        self.retries
    }

    /// Returns whether writes and control commands are retried.
    #[must_use]
    pub fn retry_writes(&self) -> bool {
        self.retry_writes
    }

    /// Returns whether reads have the lowest priority on the link.
    #[must_use]
    pub fn background(&self) -> bool {
        self.background
    }

    /// The shortest adapted response timeout; `None`: it is not adapted.
    #[must_use]
    pub fn adaptive_timeout(&self) -> Option<Duration> {
        self.adaptive
    }

    pub(crate) fn lane(&self, class: Class) -> Lane {
        match class {
            Class::Control => Lane::Control,
            Class::Write => Lane::Write,
            Class::Read if self.background => Lane::Background,
            Class::Read => Lane::Read,
        }
    }

    pub(crate) fn retries_for(&self, class: Class) -> u32 {
        if class == Class::Read || self.retry_writes { self.retries } else { 0 }
    }
}

impl Default for CallOptions {
    fn default() -> Self {
        Self::new()
    }
}

/// Echo behaviour of the line: some RS-485 adapters echo requests.
///
/// In the ASCII framing the echo of a request looks like a frame, and the echo of a loop-back or of
/// STOP looks like its reply. So the link must know. The binary framing marks requests by their
/// header.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum EchoMode {
    /// Learned with a status request at the beginning of each connection. The default for serial
    /// lines.
    Auto,
    /// The line echoes.
    On,
    /// The line does not echo. The default for networks and for streams.
    #[default]
    Off,
}

/// Priority of a call, highest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Lane {
    Control,
    Write,
    Read,
    Background,
}

impl Lane {
    pub(crate) const COUNT: usize = 4;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_background_reads_have_the_lowest_priority() {
        let background = CallOptions::new().with_background(true);
        for (class, lane, in_background) in [
            (Class::Control, Lane::Control, Lane::Control),
            (Class::Write, Lane::Write, Lane::Write),
            (Class::Read, Lane::Read, Lane::Background),
        ] {
            assert_eq!((CallOptions::new().lane(class), background.lane(class)), (lane, in_background), "{class:?}");
        }
        assert!(Lane::Control < Lane::Write && Lane::Write < Lane::Read && Lane::Read < Lane::Background);
    }

    #[test]
    fn only_reads_are_retried_unless_writes_are_allowed() {
        let once = CallOptions::new().with_retries(5);
        assert_eq!(
            (once.retries_for(Class::Read), once.retries_for(Class::Write), once.retries_for(Class::Control)),
            (5, 0, 0)
        );
        let all = once.with_retry_writes(true);
        assert_eq!(
            (all.retries_for(Class::Read), all.retries_for(Class::Write), all.retries_for(Class::Control)),
            (5, 5, 5)
        );
    }

    #[test]
    fn each_option_is_read_as_it_was_set() {
        let (one, two, three) = (Duration::from_millis(1), Duration::from_millis(2), Duration::from_millis(3));
        let read = |options: CallOptions| {
            (
                (options.response_timeout(), options.call_timeout(), options.adaptive_timeout()),
                (options.retries(), options.retry_writes(), options.background()),
            )
        };
        let plain = CallOptions::new();
        assert_eq!(read(plain), ((None, defaults::CALL_TIMEOUT, None), (defaults::RETRIES, false, false)));
        let timed = plain.with_response_timeout(one).with_call_timeout(two).with_adaptive_timeout(three);
        assert_eq!(read(timed.with_retries(7)), ((Some(one), two, Some(three)), (7, false, false)));
        assert_eq!(read(plain.with_retry_writes(true).with_retries(0)).1, (0, true, false));
        assert_eq!(read(plain.with_background(true)).1, (defaults::RETRIES, false, true));
    }

    #[test]
    fn each_option_changes_itself_and_leaves_the_others() {
        let time = Duration::from_millis(7);
        let options = CallOptions::new()
            .with_response_timeout(time)
            .with_retries(9)
            .with_background(true)
            .with_adaptive_timeout(time / 2);
        assert_eq!((options.response_timeout, options.retries, options.adaptive), (Some(time), 9, Some(time / 2)));
        assert_eq!((options.call_timeout, options.retry_writes), (CallOptions::default().call_timeout, false));
        assert_eq!(options.with_call_timeout(time), CallOptions { call_timeout: time, ..options });
    }
}
