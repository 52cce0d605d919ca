//! Options of calls.

use std::convert::Infallible;

use serde::{Deserialize, Serialize};

use super::{DurationText, through_forms};
use crate::link::CallOptions;

through_forms! {
    CallOptions => CallOptionsForm;
}

/// The form of [`CallOptions`].
#[derive(Serialize, Deserialize)]
#[serde(rename = "CallOptions", deny_unknown_fields, default)]
struct CallOptionsForm {
    response_timeout: Option<DurationText>,
    call_timeout: DurationText,
    retries: u32,
    retry_writes: bool,
    background: bool,
    adaptive_timeout: Option<DurationText>,
}

impl CallOptionsForm {
    fn of(options: &CallOptions) -> Result<Self, Infallible> {
        Ok(Self::with(options))
    }

    fn with(options: &CallOptions) -> Self {
        Self {
            response_timeout: options.response_timeout().map(DurationText),
            call_timeout: DurationText(options.call_timeout()),
            retries: options.retries(),
            retry_writes: options.retry_writes(),
            background: options.background(),
            adaptive_timeout: options.adaptive_timeout().map(DurationText),
        }
    }

    fn make(self) -> Result<CallOptions, Infallible> {
        let mut options = CallOptions::new()
            .with_call_timeout(self.call_timeout.0)
            .with_retries(self.retries)
            .with_retry_writes(self.retry_writes)
            .with_background(self.background);
        if let Some(DurationText(timeout)) = self.response_timeout {
            options = options.with_response_timeout(timeout);
        }
        if let Some(DurationText(shortest)) = self.adaptive_timeout {
            options = options.with_adaptive_timeout(shortest);
        }
        Ok(options)
    }
}

impl Default for CallOptionsForm {
    fn default() -> Self {
        Self::with(&CallOptions::new())
    }
}
