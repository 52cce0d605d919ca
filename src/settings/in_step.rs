use std::fmt;
use std::time::Duration;

use super::{InvalidSettings, UrlOptions};
use crate::printable::excerpt;

/// Assumptions about late and duplicate replies: when a duplicate can come, and how a station is
/// proven to be in step.
///
/// A reply is only accepted if no earlier reply can be mistaken for it. These settings say which
/// earlier replies can still come. The defaults suit Ethernet modules, serial device servers and
/// serial ports.
///
/// ```
/// use std::time::Duration;
///
/// use fatek::Endpoint;
/// use fatek::endpoint::InStepSettings;
///
/// let settings = InStepSettings::new().with_copies(2)?.with_window(Duration::from_millis(250));
/// let endpoint = Endpoint::tcp("192.168.2.3", 500).with_in_step(settings);
/// assert_eq!(endpoint.to_string(), "tcp://192.168.2.3:500?copies=2&window=250ms");
/// # Ok::<(), fatek::endpoint::InvalidSettings>(())
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub struct InStepSettings {
    copies: u8,
    window: Duration,
    quiet: Duration,
    one_request: bool,
    settle: Duration,
}

/// Default number of exchanges after which a duplicate of a reply can still come.
pub const DEFAULT_COPIES: u8 = 1;

/// Maximum number of exchanges after which a duplicate of a reply can still come.
pub const MAX_COPIES: u8 = 8;

/// Default of the copy window: silence of a station after which no duplicate of a reply comes.
pub const DEFAULT_COPY_WINDOW: Duration = Duration::from_millis(100);

/// Default of the quiet time: silence that replaces the check of a station that refuses it (4E).
pub const DEFAULT_QUIET: Duration = Duration::from_secs(1);

/// Names of the options in a URL.
pub(crate) const URL_OPTIONS: [&str; 5] = ["copies", "window", "quiet", "one_request", "settle"];

/// Maximum of the copy window and of the quiet time: a day.
const MAX_TIME: Duration = Duration::from_secs(86_400);

impl InStepSettings {
    /// The default settings: 1 copy within 100 ms, a quiet time of 1 s, and connections for any
    /// number of requests.
    #[must_use]
    pub const fn new() -> Self {
        Self {
            copies: DEFAULT_COPIES,
            window: DEFAULT_COPY_WINDOW,
            quiet: DEFAULT_QUIET,
            one_request: false,
            settle: Duration::ZERO,
        }
    }

    /// Sets the number of exchanges after which a duplicate of a reply can still come.
    ///
    /// 1, the default: a duplicate comes before the reply to the next request. A higher number is
    /// for lines that deliver it later, and costs more checks. 0: no duplicates.
    ///
    /// # Errors
    /// [`InvalidSettings::Copies`] if it is more than [`MAX_COPIES`].
    pub const fn with_copies(mut self, copies: u8) -> Result<Self, InvalidSettings> {
        if copies > MAX_COPIES {
            return Err(InvalidSettings::Copies { copies });
        }
        self.copies = copies;
        Ok(self)
    }

    /// Sets the copy window: silence of a station after which no duplicate of a reply comes.
    ///
    /// After an exchange that took longer than half of it, twice the duration of that exchange
    /// applies. Requests with a longer pause between them cost no checks. Limited to a day.
    #[must_use]
    pub const fn with_window(mut self, window: Duration) -> Self {
        self.window = bounded(window);
        self
    }

    /// Sets the quiet time: silence that replaces the check of a station that refuses it (4E).
    ///
    /// It should be longer than the longest delay of a reply on the line. Limited to a day.
    #[must_use]
    pub const fn with_quiet(mut self, quiet: Duration) -> Self {
        self.quiet = bounded(quiet);
        self
    }

    /// Sets whether the gateway closes the connection after each reply.
    ///
    /// A check would use up such a connection, so the quiet time replaces it.
    #[must_use]
    pub const fn with_one_request(mut self, one_request: bool) -> Self {
        self.one_request = one_request;
        self
    }

    /// Sets the settle time: a pause between opening a connection and the first request on it.
    ///
    /// For devices that lose what they are sent just after a connection was opened. Default: none.
    /// Limited to a day.
    #[must_use]
    pub const fn with_settle(mut self, settle: Duration) -> Self {
        self.settle = bounded(settle);
        self
    }

    /// Number of exchanges after which a duplicate of a reply can still come; 0 is no duplicates.
    #[must_use]
    pub const fn copies(&self) -> u8 {
        self.copies
    }

    /// The copy window: silence of a station after which no duplicate of a reply comes.
    #[must_use]
    pub const fn window(&self) -> Duration {
        self.window
    }

    /// The quiet time: silence that replaces the check of a station that refuses it (4E).
    #[must_use]
    pub const fn quiet(&self) -> Duration {
        self.quiet
    }

    /// Returns whether the gateway closes the connection after each reply.
    #[must_use]
    pub const fn one_request(&self) -> bool {
        self.one_request
    }

    /// Reads [`URL_OPTIONS`]. The error is the rule that one of them breaks.
    pub(crate) fn from_url(options: &UrlOptions<'_>) -> Result<Self, String> {
        let mut settings = Self::new();
        if let Some(text) = options.get("copies") {
            let copies = text.parse().ok().filter(|_| text.bytes().all(|b| b.is_ascii_digit()));
            settings = copies.and_then(|copies| settings.with_copies(copies).ok()).ok_or_else(|| {
                format!("the option `copies={}` must be a number from 0 to {MAX_COPIES}", excerpt(text))
            })?;
        }
        if let Some(text) = options.get("window") {
            settings = settings.with_window(time("window", text)?);
        }
        if let Some(text) = options.get("quiet") {
            settings = settings.with_quiet(time("quiet", text)?);
        }
        if let Some(text) = options.get("one_request") {
            settings = settings.with_one_request(match text {
                "true" => true,
                "false" => false,
                _ => return Err(format!("the option `one_request={}` must be `true` or `false`", excerpt(text))),
            });
        }
        if let Some(text) = options.get("settle") {
            settings = settings.with_settle(time("settle", text)?);
        }
        Ok(settings)
    }

    /// The settle time: a pause between opening a connection and the first request on it.
    #[must_use]
    pub const fn settle(&self) -> Duration {
        self.settle
    }

    /// The options for a URL: those that differ from their defaults.
    pub(crate) fn url_options(self) -> impl Iterator<Item = String> {
        let usual = Self::new();
        let options = [
            (self.copies != usual.copies).then(|| format!("copies={}", self.copies)),
            (self.window != usual.window).then(|| format!("window={}", Time(self.window))),
            (self.quiet != usual.quiet).then(|| format!("quiet={}", Time(self.quiet))),
            (self.one_request != usual.one_request).then(|| format!("one_request={}", self.one_request)),
            (self.settle != usual.settle).then(|| format!("settle={}", Time(self.settle))),
        ];
        options.into_iter().flatten()
    }
}

impl Default for InStepSettings {
    fn default() -> Self {
        Self::new()
    }
}

const fn bounded(time: Duration) -> Duration {
    if time.as_nanos() > MAX_TIME.as_nanos() { MAX_TIME } else { time }
}

fn time(name: &str, text: &str) -> Result<Duration, String> {
    parse_time(text).filter(|&time| time <= MAX_TIME).ok_or_else(|| {
        format!(
            "the option `{name}={}` must be a time in `ms` or `s`, such as `100ms` or `1.5s`, at most a day",
            excerpt(text)
        )
    })
}

/// Parses a decimal number of milliseconds or seconds, to the nanosecond.
fn parse_time(text: &str) -> Option<Duration> {
    let (number, decimals) = match text.strip_suffix("ms") {
        Some(number) => (number, 6),
        None => (text.strip_suffix('s')?, 9),
    };
    let (whole, fraction) = match number.split_once('.') {
        Some((_, "")) => return None,
        Some((whole, fraction)) => (whole, fraction),
        None => (number, ""),
    };
    let digits = |text: &str| text.bytes().all(|b| b.is_ascii_digit());
    if whole.is_empty() || !digits(whole) || !digits(fraction) || fraction.len() > decimals {
        return None;
    }
    // Without the decimal point, the digits are nanoseconds.
    format!("{whole}{fraction:0<decimals$}").parse().ok().map(Duration::from_nanos)
}

/// Displays a time in seconds from 1 s on, else in milliseconds, without trailing zeros.
struct Time(Duration);

impl fmt::Display for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let nanos = self.0.subsec_nanos();
        let (number, unit) = match self.0.as_secs() {
            0 => (format!("{}.{:06}", nanos / 1_000_000, nanos % 1_000_000), "ms"),
            seconds => (format!("{seconds}.{nanos:09}"), "s"),
        };
        write!(f, "{}{unit}", number.trim_end_matches('0').trim_end_matches('.'))
    }
}
