//! Faults with their chances as text: `drop=1%,late=5%:300ms`.

use std::fmt;
use std::str::FromStr;
use std::time::Duration;

use super::{DisconnectAt, Fault, Rule, Timing};
use crate::ErrorCode;
use crate::printable::excerpt;

/// A fault with its chance, written as text: `drop=1%`, `late=5%:300ms`.
///
/// The text is `NAME=CHANCE`, or `NAME=CHANCE:DETAIL`. A chance is from 0% to 100%, with up to four decimals.
///
/// | name | fault | detail, and its default |
/// |---|---|---|
/// | `drop` | [`DropReply`](Fault::DropReply): executed, no reply | |
/// | `ignore` | [`Ignore`](Fault::Ignore): not executed, no reply | |
/// | `late` | [`Delay`](Fault::Delay) of the reply | time, or times: `500ms..1500ms` |
/// | `stuck` | as `late`, with a longer default | time, or times: `5s` |
/// | `double` | [`Duplicate`](Fault::Duplicate) of the reply | time after it, or times: `0s` |
/// | `corrupt` | [`BadChecksum`](Fault::BadChecksum) | |
/// | `garbage` | [`GarbageBefore`](Fault::GarbageBefore) the reply | most bytes: `8` |
/// | `noise` | [`GarbageInside`](Fault::GarbageInside) the reply | most bytes: `8` |
/// | `split` | [`Split`](Fault::Split) into two pieces | pause: `20ms` |
/// | `short` | [`Truncated`](Fault::Truncated) data, good checksum | missing characters: `1` |
/// | `long` | [`Extended`](Fault::Extended) data, good checksum | more characters: `2` |
/// | `wrong-station` | [`WrongStation`](Fault::WrongStation) in the reply | |
/// | `wrong-command` | [`WrongCommand`](Fault::WrongCommand) in the reply | |
/// | `error` | [`Error`](Fault::Error) in place of the execution | error code, a hexadecimal digit: `4` |
/// | `echo` | [`Echo`](Fault::Echo) of the request | |
/// | `disconnect` | [`Disconnect`](Fault::Disconnect) before the reply | |
/// | `refuse` | [`Refuse`](Fault::Refuse) a connection | |
///
/// A station is busy until its late reply is sent: later requests to it wait.
///
/// Each fault of a list is drawn for itself. Of faults of one kind, the first that applies counts, and the
/// others are not drawn: `late` and `stuck` are one kind, [`Delay`](Fault::Delay).
///
/// ```
/// use fatek::sim::{Fault, FaultRate, Faults, Rule};
///
/// let rates = FaultRate::parse_list("drop=1%,late=5%:300ms..1s")?;
/// assert_eq!(rates[0].rule(), Rule::new(Fault::DropReply).per_million(10_000));
/// let faults = Faults::new(7);
/// rates.iter().for_each(|rate| faults.add_rule(rate.rule().station(3)));
///
/// let error = FaultRate::parse_list("drop=1").unwrap_err();
/// assert_eq!(error.to_string(), "`drop=1` is not a fault: a chance is 0% to 100%, as in `drop=1%`");
/// # Ok::<(), fatek::sim::ParseFaultError>(())
/// ```
///
/// Two are equal if fault and chance are, however they were written.
#[derive(Clone, Debug)]
pub struct FaultRate {
    text: String,
    name: &'static str,
    fault: Fault,
    per_million: u32,
}

/// A text that is not a [`FaultRate`], with the rule that it breaks.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("`{}` is not a fault: {rule}", excerpt(input))]
pub struct ParseFaultError {
    input: String,
    rule: String,
}

impl ParseFaultError {
    /// The text: the item of a list.
    #[must_use]
    pub fn input(&self) -> &str {
        &self.input
    }

    /// The rule that it breaks.
    #[must_use]
    pub fn rule(&self) -> &str {
        &self.rule
    }
}

/// The faults by name, each with its default detail. The table of [`FaultRate`] describes them.
const FAULTS: [(&str, Fault); 17] = [
    ("drop", Fault::DropReply),
    ("ignore", Fault::Ignore),
    ("late", Fault::Delay { min: Duration::from_millis(500), max: Duration::from_millis(1500) }),
    ("stuck", Fault::Delay { min: Duration::from_secs(5), max: Duration::from_secs(5) }),
    ("double", Fault::duplicate()),
    ("corrupt", Fault::BadChecksum),
    ("garbage", Fault::GarbageBefore { max_len: 8 }),
    ("noise", Fault::GarbageInside { max_len: 8 }),
    ("split", Fault::Split { pieces: 2, pause: Duration::from_millis(20) }),
    ("short", Fault::Truncated { by: 1 }),
    ("long", Fault::Extended { by: 2 }),
    ("wrong-station", Fault::WrongStation),
    ("wrong-command", Fault::WrongCommand),
    ("error", Fault::Error(ErrorCode::IllegalFormat)),
    ("echo", Fault::Echo),
    ("disconnect", Fault::Disconnect(DisconnectAt::BeforeReply)),
    ("refuse", Fault::Refuse),
];

/// Longest time of a detail: that of all [delays](super#time).
const DAY: Duration = Duration::from_secs(24 * 3600);

impl FaultRate {
    /// Parses a list of faults, separated by commas.
    ///
    /// # Errors
    /// [`ParseFaultError`], with the first item that is no fault.
    pub fn parse_list(text: &str) -> Result<Vec<Self>, ParseFaultError> {
        text.split(',').map(str::parse).collect()
    }

    /// The fault.
    #[must_use]
    pub fn fault(&self) -> &Fault {
        &self.fault
    }

    /// Its name in the text, such as `drop`.
    #[must_use]
    pub fn name(&self) -> &'static str {
        self.name
    }

    /// The chance in millionths, as for [`Rule::per_million`].
    #[must_use]
    pub fn per_million(&self) -> u32 {
        self.per_million
    }

    /// A rule that applies the fault with its chance to all requests.
    #[must_use]
    pub fn rule(&self) -> Rule {
        Rule::new(self.fault.clone()).per_million(self.per_million)
    }
}

impl PartialEq for FaultRate {
    fn eq(&self, other: &Self) -> bool {
        (&self.fault, self.per_million) == (&other.fault, other.per_million)
    }
}

impl Eq for FaultRate {}

impl FromStr for FaultRate {
    type Err = ParseFaultError;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let text = text.trim();
        match parse(text) {
            Ok((name, fault, per_million)) => Ok(Self { text: text.to_owned(), name, fault, per_million }),
            Err(rule) => Err(ParseFaultError { input: text.to_owned(), rule }),
        }
    }
}

impl fmt::Display for FaultRate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.text)
    }
}

fn parse(text: &str) -> Result<(&'static str, Fault, u32), String> {
    let (name, rest) = text.split_once('=').map_or((text, None), |(name, rest)| (name.trim(), Some(rest)));
    let Some((name, default)) = FAULTS.into_iter().find(|(known, _)| *known == name) else {
        return Err(format!("the names are {}", FAULTS.map(|(name, _)| name).join(", ")));
    };
    let (chance, detail) = match rest.map(|rest| rest.split_once(':').unwrap_or((rest, ""))) {
        Some((chance, detail)) => (per_million(chance.trim()), detail.trim()),
        None => (None, ""),
    };
    let per_million = chance.ok_or_else(|| format!("a chance is 0% to 100%, as in `{name}=1%`"))?;
    let is_given = rest.is_some_and(|rest| rest.contains(':'));
    let fault = if is_given { detailed(&default, name, detail)? } else { default };
    Ok((name, fault, per_million))
}

/// A percentage of up to four decimals, as millionths.
fn per_million(text: &str) -> Option<u32> {
    let digits = text.strip_suffix('%')?;
    let (whole, decimals) = digits.split_once('.').unwrap_or((digits, "0"));
    let number = |digits: &str| digits.parse::<u32>().ok().filter(|_| digits.bytes().all(|b| b.is_ascii_digit()));
    let scale = 10_u32.checked_pow(4_u32.checked_sub(u32::try_from(decimals.len()).ok()?)?)?;
    let millionths = number(whole)?.checked_mul(10_000)?.checked_add(number(decimals)?.checked_mul(scale)?)?;
    (millionths <= 1_000_000).then_some(millionths)
}

/// The fault with this detail in place of its default.
fn detailed(default: &Fault, name: &str, detail: &str) -> Result<Fault, String> {
    let times = || {
        let (min, max) = detail.split_once("..").unwrap_or((detail, detail));
        let time = |text: &str| humantime::parse_duration(text.trim()).ok().filter(|time| *time <= DAY);
        let times = time(min).zip(time(max)).filter(|(min, max)| min <= max);
        times.ok_or_else(|| format!("`{}` must be a time or times up to 24h: 300ms, or 300ms..1s", excerpt(detail)))
    };
    let count = || match detail.parse::<usize>() {
        Ok(count @ 1..=1024) => Ok(count),
        Ok(_) | Err(_) => Err(format!("`{}` must be a number from 1 to 1024", excerpt(detail))),
    };
    match default {
        Fault::Delay { .. } => times().map(|(min, max)| Fault::Delay { min, max }),
        Fault::Duplicate(_) => times().map(|(min, max)| Fault::Duplicate(Timing::After { min, max })),
        Fault::Split { pieces, .. } => match times()? {
            (min, max) if min == max => Ok(Fault::Split { pieces: *pieces, pause: min }),
            (_, _) => Err(format!("`{}` must be one time", excerpt(detail))),
        },
        Fault::GarbageBefore { .. } => count().map(|max_len| Fault::GarbageBefore { max_len }),
        Fault::GarbageInside { .. } => count().map(|max_len| Fault::GarbageInside { max_len }),
        Fault::Truncated { .. } => count().map(|by| Fault::Truncated { by }),
        Fault::Extended { .. } => count().map(|by| Fault::Extended { by }),
        Fault::Error(_) => {
            let code =
                Some(detail).filter(|digit| digit.len() == 1).and_then(|digit| u8::from_str_radix(digit, 16).ok());
            let code = code.and_then(ErrorCode::from_u8).map(Fault::Error);
            code.ok_or_else(|| format!("`{}` must be an error code, a hexadecimal digit from 1 to F", excerpt(detail)))
        }
        Fault::Ignore
        | Fault::DropReply
        | Fault::WrongStation
        | Fault::WrongCommand
        | Fault::BadChecksum
        | Fault::RoamingDuplicate(_)
        | Fault::SecondAnswer { .. }
        | Fault::LeftOver { .. }
        | Fault::AnswerBroadcast { .. }
        | Fault::Echo
        | Fault::Disconnect(_)
        | Fault::Refuse => Err(format!("`{name}` has no detail behind the chance")),
    }
}

#[cfg(test)]
mod tests;
