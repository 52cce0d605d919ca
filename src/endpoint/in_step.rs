//! How a line treats replies.
use std::time::Duration;

pub const DEFAULT_COPIES: u8 = 1;
pub const DEFAULT_COPY_WINDOW: Duration = Duration::from_millis(100);
pub const DEFAULT_QUIET: Duration = Duration::from_secs(1);

/// Stub.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub struct InStepSettings {
    copies: u8,
    window: Duration,
    quiet: Duration,
    one_request: bool,
}

impl Default for InStepSettings {
    fn default() -> Self {
        Self { copies: DEFAULT_COPIES, window: DEFAULT_COPY_WINDOW, quiet: DEFAULT_QUIET, one_request: false }
    }
}

impl InStepSettings {
    #[must_use]
    pub fn new() -> Self { Self::default() }
    #[must_use]
    pub fn copies(&self) -> u8 { self.copies }
    #[must_use]
    pub fn window(&self) -> Duration { self.window }
    #[must_use]
    pub fn quiet(&self) -> Duration { self.quiet }
    #[must_use]
    pub fn one_request(&self) -> bool { self.one_request }
    #[must_use]
    pub fn with_window(self, window: Duration) -> Self { Self { window, ..self } }
    #[must_use]
    pub fn with_quiet(self, quiet: Duration) -> Self { Self { quiet, ..self } }
    #[must_use]
    pub fn with_one_request(self, one_request: bool) -> Self { Self { one_request, ..self } }
}
