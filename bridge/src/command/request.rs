//! Commands as JSON: `{"id":"7f3","tag":"setpoint","value":42.0,"ts":1764457200000}`.
//!
//! No I/O, no clock. No payload causes a panic, and the memory for one is bounded by its size.

use std::sync::Arc;

use serde::Deserialize;
use serde_json::Value;

use super::reply::Refusal;

/// The longest payload, in bytes.
pub(super) const MAX_PAYLOAD: usize = 64 << 10;
/// The longest id, in characters.
pub(super) const MAX_ID: usize = 64;

/// A command that is well-formed.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Request {
    pub(super) id: Arc<str>,
    pub(super) tag: String,
    pub(super) value: Value,
    /// Milliseconds since 1970.
    pub(super) ts: u64,
}

/// All keys of a command. Each is required, others are refused.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Message {
    id: String,
    tag: String,
    value: Value,
    ts: u64,
}

/// The id alone, for the reply to a command that is not well-formed.
#[derive(Deserialize)]
struct Id {
    id: String,
}

/// Parses a payload. An error has the id if there is a usable one.
pub(super) fn parse(payload: &[u8]) -> Result<Request, (Option<Arc<str>>, Refusal)> {
    if payload.len() > MAX_PAYLOAD {
        return Err((None, Refusal::Payload(format!("it is longer than {MAX_PAYLOAD} bytes"))));
    }
    // serde would read a list as the fields in their order.
    if payload.trim_ascii_start().first() != Some(&b'{') {
        return Err((None, Refusal::Payload("it is not a JSON object".to_owned())));
    }
    let Message { id, tag, value, ts } = serde_json::from_slice(payload).map_err(|error| {
        let id = serde_json::from_slice(payload).ok().map(|Id { id }| id).filter(|id| is_id(id));
        (id.map(Into::into), Refusal::Payload(error.to_string()))
    })?;
    if !is_id(&id) {
        return Err((None, Refusal::Id));
    }
    Ok(Request { id: id.into(), tag, value, ts })
}

fn is_id(id: &str) -> bool {
    let is_part = |byte: u8| byte.is_ascii_alphanumeric() || b"._:-".contains(&byte);
    (1..=MAX_ID).contains(&id.len()) && id.bytes().all(is_part)
}

impl Request {
    /// A number that differs for commands with other content. Chance alone makes two equal.
    ///
    /// It is FNV-1a of 64 bits, which is the same in each version of the program.
    pub(super) fn digest(&self) -> u64 {
        let Self { id: _, tag, value, ts } = self;
        let text = serde_json::json!([tag, ts, value]).to_string();
        let step = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x100_0000_01B3);
        text.bytes().fold(0xCBF2_9CE4_8422_2325, step)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn refused(payload: &str) -> (Option<String>, String) {
        let (id, refusal) = parse(payload.as_bytes()).unwrap_err();
        (id.map(|id| id.to_string()), refusal.to_string())
    }

    #[test]
    fn a_command_has_exactly_its_four_keys() {
        let request = parse(br#" {"id":"7f3","tag":"setpoint","value":42.0,"ts":1}"#).unwrap();
        assert_eq!((&*request.id, request.tag.as_str(), request.ts), ("7f3", "setpoint", 1));
        for (payload, id, why) in [
            (r#"{"id":"7f3","tag":"a","value":1}"#, Some("7f3"), "payload: missing field `ts`"),
            (r#"{"id":"7f3","tag":"a","ts":1}"#, Some("7f3"), "payload: missing field `value`"),
            (r#"{"tag":"a","value":1,"ts":1}"#, None, "payload: missing field `id`"),
            (r#"{"id":"7f3","tag":"a","value":1,"ts":1,"force":true}"#, Some("7f3"), "payload: unknown field `force`"),
            (r#"{"id":"7f3","tag":"a","value":1,"ts":1,"ts":2}"#, Some("7f3"), "payload: duplicate field `ts`"),
            (r#"{"id":"7f3","id":"7f4","tag":"a","value":1,"ts":1}"#, None, "payload: duplicate field `id`"),
            (r#"{"id":"7f3","tag":"a","value":1,"ts":-1}"#, Some("7f3"), "payload: invalid value: integer `-1`"),
            (r#"{"id":"7f3","tag":"a","value":1,"ts":1.5}"#, Some("7f3"), "payload: invalid type: floating point"),
            (r#"{"id":"7f3","tag":"a","value":1e999,"ts":1}"#, Some("7f3"), "payload: number out of range"),
            (r#"{"id":7,"tag":"a","value":1,"ts":1}"#, None, "payload: invalid type: integer `7`"),
            (r#"{"id":"","tag":"a","value":1,"ts":1}"#, None, "id: 1 to 64"),
            (r#"{"id":"a b","tag":"a","value":1,"ts":1}"#, None, "id: 1 to 64"),
            (r#"["7f3","setpoint",42.0,1]"#, None, "payload: it is not a JSON object"),
            (r#"{"id":"7f3","tag":"a","value":1,"ts":1}{}"#, None, "payload: trailing characters"),
            ("", None, "payload: it is not a JSON object"),
        ] {
            let (found, text) = refused(payload);
            assert!(text.starts_with(why), "{payload}: {text}");
            assert_eq!(found.as_deref(), id, "{payload}");
        }
        assert!(parse(b"{\xFF").is_err() && parse(&[b'['; 60_000]).is_err());
        let deep = format!(r#"{{"id":"a","tag":"b","ts":1,"value":{}"#, "[".repeat(60_000));
        assert!(parse(deep.as_bytes()).is_err());
        assert!(refused(&" ".repeat(MAX_PAYLOAD + 1)).1.contains("longer than 65536 bytes"));
        assert!(refused(&format!(r#"{{"id":"{}","tag":"a","value":1,"ts":1}}"#, "x".repeat(65))).1.starts_with("id:"));
    }

    #[test]
    fn commands_of_other_content_have_another_digest() {
        let digest = |text: &str| parse(text.as_bytes()).unwrap().digest();
        let first = digest(r#"{"id":"1","tag":"a","value":1,"ts":1}"#);
        assert_eq!(first, digest(r#"{"ts":1,"value":1, "tag":"a","id":"1"}"#));
        // The digest is on disk: it must not change.
        assert_eq!(first, 3_072_347_845_206_621_674);
        for other in [
            r#"{"id":"1","tag":"b","value":1,"ts":1}"#,
            r#"{"id":"1","tag":"a","value":2,"ts":1}"#,
            r#"{"id":"1","tag":"a","value":1,"ts":2}"#,
        ] {
            assert_ne!(first, digest(other));
        }
    }
}
