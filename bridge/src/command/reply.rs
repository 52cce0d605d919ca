//! Replies to commands: their JSON form, and the reasons of refusals.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use serde_json::Value;

/// The result of a command.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Outcome {
    /// The PLC has confirmed the write; of a pulse, its end.
    Ok,
    /// Nothing was written: certain.
    Refused,
    /// The PLC can have executed the write, or not.
    Unknown,
}

/// The reply to a command.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reply {
    id: Option<String>,
    result: Outcome,
    why: Option<String>,
    read_back: Option<Value>,
}

/// The longest text of a reason, in bytes: errors quote their input.
const MAX_WHY: usize = 400;

impl Reply {
    pub(super) fn new(id: Option<&str>, result: Outcome, why: Option<String>, read_back: Option<Value>) -> Self {
        Self { id: id.map(str::to_owned), result, why: why.map(bounded), read_back }
    }

    pub(super) fn refused(id: Option<&str>, refusal: &Refusal) -> Self {
        Self::new(id, Outcome::Refused, Some(refusal.to_string()), None)
    }

    pub(super) fn unknown(id: Option<&str>, why: impl Into<String>) -> Self {
        Self::new(id, Outcome::Unknown, Some(why.into()), None)
    }

    /// The id of the command; `None` if it has no usable one.
    #[must_use]
    pub fn id(&self) -> Option<&str> {
        self.id.as_deref()
    }

    /// The result.
    #[must_use]
    pub fn result(&self) -> Outcome {
        self.result
    }

    /// The reason of a result that is not `ok`, or a remark about one that is. It begins with a word and a
    /// colon, which programs can rely on.
    #[must_use]
    pub fn why(&self) -> Option<&str> {
        self.why.as_deref()
    }

    /// The value of the tag, read after the write: a list for a tag of several values.
    #[must_use]
    pub fn read_back(&self) -> Option<&Value> {
        self.read_back.as_ref()
    }

    /// The reply as JSON: `{"id":…,"result":"ok"|"refused"|"unknown","why":…,"read_back":…}`.
    #[must_use]
    pub fn to_json(&self) -> Bytes {
        // Serializing texts and values to memory cannot fail.
        serde_json::to_vec(self).unwrap_or_default().into()
    }

    /// The memory that it takes, in bytes: an estimate.
    pub(super) fn size(&self) -> usize {
        self.to_json().len()
    }
}

/// Cuts a text at the longest length of a reason.
fn bounded(mut text: String) -> String {
    if text.len() > MAX_WHY {
        let end = (0..=MAX_WHY).rev().find(|end| text.is_char_boundary(*end)).unwrap_or(0);
        text.truncate(end);
        text.push_str(" …");
    }
    text
}

/// A reason to write nothing. The text begins with a word that programs can rely on.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub(super) enum Refusal {
    #[error("payload: {0}")]
    Payload(String),
    #[error("retained: a retained command is not executed")]
    Retained,
    #[error("id: 1 to {max} of the characters A-Z a-z 0-9 . _ : - are allowed", max = super::request::MAX_ID)]
    Id,
    #[error("id: it was used for another command")]
    IdReused,
    #[error("old: its ts is {age} s before the clock of the bridge, and {max} s are allowed")]
    Old { age: u64, max: u64 },
    #[error("future: its ts is {ahead} s ahead of the clock of the bridge, and {max} s are allowed")]
    Future { ahead: u64, max: u64 },
    #[error("plc: there is no PLC of this name")]
    NoPlc,
    #[error("tag: the PLC has no tag `{0}`")]
    NoTag(String),
    #[error("write: the tag is not writable")]
    NotWritable,
    #[error("write: the output takes no commands now")]
    OutputNotWritable,
    #[error("value: {0}")]
    Value(String),
    #[error("range: {value} is {side} {limit}")]
    Range { value: String, side: &'static str, limit: f64 },
    #[error("pulse: the tag takes the value true alone")]
    PulseValue,
    #[error("pulse: an earlier pulse of the tag has not ended")]
    PulseOpen,
    #[error("pulse: members of a fleet take none: one that fails would leave the output on")]
    PulseInFleet,
    #[error("fleet: it was sent before this member had the PLC, or within 2 s after that")]
    FormerOwner,
    #[error("changed: the configuration of the tag has changed")]
    Changed,
    #[error("rate: more than {per_second} commands per second for this PLC")]
    Rate { per_second: u32 },
    #[error("busy: {waiting} commands are waiting")]
    Busy { waiting: usize },
    #[error("storage: the id cannot be stored: {0}")]
    Storage(String),
    #[error("closed: the bridge is stopping")]
    Closed,
    #[error("plc: {0}")]
    Call(String),
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reply_has_all_four_keys() {
        let reply = Reply::new(Some("7f3"), Outcome::Ok, None, Some(42.5.into()));
        assert_eq!(reply.to_json(), br#"{"id":"7f3","result":"ok","why":null,"read_back":42.5}"#.as_slice());
        let reply = Reply::refused(None, &Refusal::Retained);
        let text =
            r#"{"id":null,"result":"refused","why":"retained: a retained command is not executed","read_back":null}"#;
        assert_eq!(reply.to_json(), text.as_bytes());
        assert_eq!(serde_json::from_slice::<Reply>(&reply.to_json()).unwrap(), reply);
    }

    #[test]
    fn the_text_of_a_reason_is_bounded() {
        let reply = Reply::unknown(None, "ä".repeat(MAX_WHY));
        let why = reply.why().unwrap();
        assert!(why.len() <= MAX_WHY + 4 && why.ends_with('…'), "{}", why.len());
    }
}
