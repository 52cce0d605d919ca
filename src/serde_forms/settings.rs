//! Settings of a line that stand alone; those of an endpoint are in its URL, with the same names.

use std::convert::Infallible;

use serde::{Deserialize, Serialize};

use super::{DurationText, check_kept, through_forms};
use crate::endpoint::{InStepSettings, SerialSettings};
use crate::settings::UrlOptions;
use crate::wire::Framing;

through_forms! {
    InStepSettings => InStepForm;
    SerialSettings => SerialForm;
}

/// The form of [`InStepSettings`].
#[derive(Serialize, Deserialize)]
#[serde(rename = "InStepSettings", deny_unknown_fields, default)]
struct InStepForm {
    copies: u8,
    window: DurationText,
    quiet: DurationText,
    one_request: bool,
    settle: DurationText,
}

impl InStepForm {
    fn of(settings: &InStepSettings) -> Result<Self, Infallible> {
        Ok(Self::with(settings))
    }

    fn with(settings: &InStepSettings) -> Self {
        Self {
            copies: settings.copies(),
            window: DurationText(settings.window()),
            quiet: DurationText(settings.quiet()),
            one_request: settings.one_request(),
            settle: DurationText(settings.settle()),
        }
    }

    fn make(self) -> Result<InStepSettings, String> {
        let settings = InStepSettings::new()
            .with_copies(self.copies)
            .map_err(|error| error.to_string())?
            .with_window(self.window.0)
            .with_quiet(self.quiet.0)
            .with_one_request(self.one_request)
            .with_settle(self.settle.0);
        check_kept("window", self.window, DurationText(settings.window()))?;
        check_kept("quiet", self.quiet, DurationText(settings.quiet()))?;
        check_kept("settle", self.settle, DurationText(settings.settle()))?;
        Ok(settings)
    }
}

impl Default for InStepForm {
    fn default() -> Self {
        Self::with(&InStepSettings::new())
    }
}

/// The form of [`SerialSettings`]: the options of a URL.
#[derive(Default, Serialize, Deserialize)]
#[serde(rename = "SerialSettings", deny_unknown_fields, default)]
struct SerialForm {
    baud: Option<u32>,
    frame: Option<String>,
    dtr: Option<String>,
    rts: Option<String>,
    rs485: Option<String>,
}

impl SerialForm {
    fn of(settings: &SerialSettings) -> Result<Self, Infallible> {
        let [_, (_, frame), (_, dtr), (_, rts), (_, rs485)] = settings.option_texts();
        Ok(Self { baud: Some(settings.baud()), frame, dtr, rts, rs485 })
    }

    fn make(self) -> Result<SerialSettings, String> {
        let baud = self.baud.map(|baud| baud.to_string());
        let mut options = UrlOptions::default();
        let texts =
            [("baud", &baud), ("frame", &self.frame), ("dtr", &self.dtr), ("rts", &self.rts), ("rs485", &self.rs485)];
        for (name, text) in texts {
            if let Some(text) = text
                && !options.add(name, text)
            {
                return Err(format!("the option `{name}` is given twice"));
            }
        }
        SerialSettings::from_url(&options, Framing::Ascii)
    }
}
