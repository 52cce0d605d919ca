//! Subjects of replies to commands. No I/O.

use crate::topic::Topics;

/// The longest subject of a reply that is used.
const MAX_SUBJECT: usize = 1024;

/// The subject that a command names for its reply, or the one of its PLC.
///
/// A client that may send commands must not write to other subjects by them: those of the bridge itself, and those
/// that begin with `$`, which are the interface of JetStream, are not used.
pub(super) fn subject(topics: &Topics, plc: &str, reply: Option<&str>) -> String {
    let own = topics.replies(plc);
    let is_own = |subject: &str| {
        let rest = subject.strip_prefix(topics.base());
        rest.is_some_and(|rest| rest.is_empty() || rest.starts_with('.'))
    };
    let is_allowed = |subject: &&str| is_subject(subject) && !is_own(subject);
    reply.filter(is_allowed).map_or(own, str::to_owned)
}

/// Returns whether a text is a subject that a client may publish to.
fn is_subject(text: &str) -> bool {
    let is_token = |token: &str| !token.is_empty() && token != "*" && token != ">";
    let has_blank = text.contains(|c: char| c.is_whitespace() || c.is_control());
    text.len() <= MAX_SUBJECT && !text.starts_with('$') && !has_blank && text.split('.').all(is_token)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Name;

    #[test]
    fn a_reply_goes_to_the_subject_of_the_command_unless_that_is_not_the_clients_to_use() {
        let topics = Topics::nats(&Name::constant("fatek"), &Name::constant("hall-2"));
        let own = "fatek.hall-2.mixer.cmd.reply";
        let long = "a".repeat(MAX_SUBJECT + 1);
        for (reply, expected) in [
            (None, own),
            (Some("_INBOX.abc.1"), "_INBOX.abc.1"),
            (Some("fatek.hall-20.x"), "fatek.hall-20.x"),
            (Some(own), own),
            (Some("$JS.API.STREAM.DELETE.FATEK"), own),
            (Some("$SYS.x"), own),
            (Some("fatek.hall-2.mixer.data"), own),
            (Some("fatek.hall-2.boiler.cmd"), own),
            (Some("fatek.hall-2"), own),
            (Some(""), own),
            (Some("a..b"), own),
            (Some("a.*"), own),
            (Some(">"), own),
            (Some("a b"), own),
            (Some("a\r\nPUB"), own),
            (Some(long.as_str()), own),
        ] {
            assert_eq!(subject(&topics, "mixer", reply), expected, "{reply:?}");
        }
    }
}
