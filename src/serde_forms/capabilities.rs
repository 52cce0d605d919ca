//! Capabilities of a station.

use std::collections::BTreeMap;
use std::convert::Infallible;

use serde::{Deserialize, Serialize};

use super::{DurationText, through_forms};
use crate::capabilities::{Capabilities, Support, WordSupport};
use crate::command::Code;
use crate::element::Symbol;
use crate::plan::WordAreas;

through_forms! {
    Capabilities => CapabilitiesForm;
}

/// The form of [`Capabilities`]. Unknown support is left out.
#[derive(Default, Serialize, Deserialize)]
#[serde(rename = "Capabilities", deny_unknown_fields, default)]
struct CapabilitiesForm {
    /// By the two digits of the code.
    commands: BTreeMap<String, SupportForm>,
    words: BTreeMap<Symbol, WordSupportForm>,
    max_registers: Option<usize>,
    max_points: Option<usize>,
    max_mixed: Option<usize>,
    counter_step: Option<u8>,
    answers_broadcasts: Option<bool>,
    response_time: Option<DurationText>,
}

#[derive(Serialize, Deserialize)]
#[serde(rename = "Support", rename_all = "snake_case")]
enum SupportForm {
    Supported,
    Refused,
    Unanswered,
}

#[derive(Serialize, Deserialize)]
#[serde(rename = "WordSupport", rename_all = "snake_case")]
enum WordSupportForm {
    #[serde(rename = "multiples_of_8")]
    MultiplesOf8,
    #[serde(rename = "multiples_of_16")]
    MultiplesOf16,
    Refused,
}

impl CapabilitiesForm {
    fn of(known: &Capabilities) -> Result<Self, Infallible> {
        let command = |code: &Code| {
            let support = match known.command(*code) {
                Support::Unknown => return None,
                Support::Supported => SupportForm::Supported,
                Support::Refused => SupportForm::Refused,
                Support::Unanswered => SupportForm::Unanswered,
            };
            Some((digits(*code), support))
        };
        let words = |symbol: Symbol| {
            let support = match known.words_of(symbol) {
                WordSupport::Unknown => return None,
                WordSupport::MultiplesOf8 => WordSupportForm::MultiplesOf8,
                WordSupport::MultiplesOf16 => WordSupportForm::MultiplesOf16,
                WordSupport::Refused => WordSupportForm::Refused,
            };
            Some((symbol, support))
        };
        Ok(Self {
            commands: Code::ALL.iter().filter_map(command).collect(),
            words: WordAreas::SYMBOLS.into_iter().filter_map(words).collect(),
            max_registers: known.max_registers(),
            max_points: known.max_points(),
            max_mixed: known.max_mixed(),
            counter_step: known.counter_step(),
            answers_broadcasts: known.answers_broadcasts(),
            response_time: known.response_time().map(DurationText),
        })
    }

    fn make(self) -> Result<Capabilities, String> {
        let mut known = Capabilities::new();
        for (name, support) in self.commands {
            let code = Code::ALL.iter().find(|code| digits(**code) == name);
            let Some(code) = code else {
                return Err(format!("`{}` is not a command code, such as 4E", crate::printable::excerpt(&name)));
            };
            known = known.with_command(
                *code,
                match support {
                    SupportForm::Supported => Support::Supported,
                    SupportForm::Refused => Support::Refused,
                    SupportForm::Unanswered => Support::Unanswered,
                },
            );
        }
        let rule = |error: crate::plan::PlanError| error.to_string();
        for (symbol, support) in self.words {
            let support = match support {
                WordSupportForm::MultiplesOf8 => WordSupport::MultiplesOf8,
                WordSupportForm::MultiplesOf16 => WordSupport::MultiplesOf16,
                WordSupportForm::Refused => WordSupport::Refused,
            };
            known = known.with_words_of(symbol, support).map_err(rule)?;
        }
        if let Some(units) = self.max_registers {
            known = known.with_max_registers(units).map_err(rule)?;
        }
        if let Some(points) = self.max_points {
            known = known.with_max_points(points).map_err(rule)?;
        }
        if let Some(units) = self.max_mixed {
            known = known.with_max_mixed(units).map_err(rule)?;
        }
        if let Some(step) = self.counter_step {
            known = known.with_counter_step(step).map_err(rule)?;
        }
        if let Some(answers) = self.answers_broadcasts {
            known = known.with_answers_broadcasts(answers);
        }
        if let Some(DurationText(time)) = self.response_time {
            known = known.with_response_time(time);
        }
        Ok(known)
    }
}

/// The two digits of a command code.
fn digits(code: Code) -> String {
    format!("{:02X}", u8::from(code))
}
