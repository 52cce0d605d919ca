use std::time::Duration;

use crate::command::Class;

/// How one call is treated: how long it may take, and how often it may be sent.
///
/// A link has one for all its stations ([`LinkBuilder::options`](super::LinkBuilder::options)), and
/// [`Station::with_options`](crate::Station::with_options) makes a handle with its own.
///
/// ```
/// use std::time::Duration;
/// use fatek::CallOptions;
///
/// let patient = CallOptions::new().response_timeout(Duration::from_secs(3)).retry_writes(true);
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
    /// The defaults: the link's time for the response, 10 s for the whole call, 2 retries, reads only.
    #[must_use]
    pub fn new() -> Self {
        Self {
            response_timeout: None,
            call_timeout: Duration::from_secs(10),
            retries: 2,
            retry_writes: false,
            background: false,
            adaptive: None,
        }
    }

    /// How long the PLC has for its answer, from the moment the request has been sent. Default: that of the link, which is
    /// 1 s, on a serial line 300 ms.
    #[must_use]
    pub fn response_timeout(mut self, timeout: Duration) -> Self {
        self.response_timeout = Some(timeout);
        self
    }

    /// How long the whole call may take: queueing, connecting and retries included. Default: 10 s.
    ///
    /// A read or write that is longer than one request is several calls, each with this time.
    #[must_use]
    pub fn call_timeout(mut self, timeout: Duration) -> Self {
        self.call_timeout = timeout;
        self
    }

    /// How often a request is sent again after no answer, or a bad one, has come. Default: 2.
    ///
    /// Only reads are, unless [`retry_writes`](Self::retry_writes) says otherwise.
    #[must_use]
    pub fn retries(mut self, retries: u32) -> Self {
        self.retries = retries;
        self
    }

    /// Whether writes and control commands may be sent again, too. Default: `false`.
    ///
    /// The PLC may have executed the first one: choose it only where doing it twice does no harm.
    #[must_use]
    pub fn retry_writes(mut self, retry: bool) -> Self {
        self.retry_writes = retry;
        self
    }

    /// Whether reads give way to all other calls of the link, as polling should. Default: `false`.
    #[must_use]
    pub fn background(mut self, background: bool) -> Self {
        self.background = background;
        self
    }

    /// Gives each station the time that its answers have needed so far, and some more, instead of the whole response
    /// timeout: between `shortest` and [`response_timeout`](Self::response_timeout). Default: not.
    ///
    /// The estimate is that of TCP: the smoothed round trip and four times its deviation, doubled with each timeout.
    #[must_use]
    pub fn adaptive_timeout(mut self, shortest: Duration) -> Self {
        self.adaptive = Some(shortest);
        self
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

/// Whether the line sends back what is sent on it, as some RS-485 adapters do.
///
/// In the ASCII framing the echo of a request looks like a frame, and the echo of a loop-back or of STOP looks like its
/// reply; so it has to be known. The binary framing tells echoes by their header.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum EchoMode {
    /// Found out with a status request at the beginning of each connection. The default for serial lines.
    Auto,
    /// It does.
    On,
    /// It does not. The default for networks and for streams.
    #[default]
    Off,
}

/// Which calls come first, the first one first.
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
    fn only_reads_give_way_and_only_if_asked_to() {
        let background = CallOptions::new().background(true);
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
    fn only_reads_are_repeated_unless_writes_shall_be_too() {
        let once = CallOptions::new().retries(5);
        assert_eq!(
            (once.retries_for(Class::Read), once.retries_for(Class::Write), once.retries_for(Class::Control)),
            (5, 0, 0)
        );
        let all = once.retry_writes(true);
        assert_eq!(
            (all.retries_for(Class::Read), all.retries_for(Class::Write), all.retries_for(Class::Control)),
            (5, 5, 5)
        );
    }

    #[test]
    fn each_option_changes_itself_and_leaves_the_others() {
        let time = Duration::from_millis(7);
        let options = CallOptions::new().response_timeout(time).retries(9).background(true).adaptive_timeout(time / 2);
        assert_eq!((options.response_timeout, options.retries, options.adaptive), (Some(time), 9, Some(time / 2)));
        assert_eq!((options.call_timeout, options.retry_writes), (CallOptions::default().call_timeout, false));
        assert_eq!(options.call_timeout(time), CallOptions { call_timeout: time, ..options });
    }
}
