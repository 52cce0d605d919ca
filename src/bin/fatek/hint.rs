//! Hints behind an error: things to try next.

use fatek::element::Width;
use fatek::tag::{Tag, TagType};
use fatek::{Endpoint, Error, Seen};

use crate::failure::Failure;

/// Things to try after a failure.
pub(crate) fn of(failure: &Failure) -> Vec<String> {
    if let Failure::NoStation { .. } = failure {
        return vec![
            "nothing came: try a longer --timeout, or the other framing (?framing=binary or ascii)".to_owned(),
            "on a serial line, try another speed and frame (?baud=19200&frame=8N1)".to_owned(),
            "docs/CONNECT.md has more causes".to_owned(),
        ];
    }
    let Some(error) = failure.call_error() else { return Vec::new() };
    if !has_answered(failure) {
        return unanswered(error);
    }
    let is_lost = matches!(error, Error::Timeout { .. });
    let hint = "the PLC has answered before: try a longer --timeout, and check the line".to_owned();
    is_lost.then_some(hint).into_iter().collect()
}

/// Returns whether the PLC has answered before it failed: then the settings are good.
fn has_answered(failure: &Failure) -> bool {
    if let Failure::WriteProgram(error) = failure {
        return !error.state.written.is_empty();
    }
    if let Failure::Restore(error) = failure {
        return !error.report.written.is_empty() || error.report.compared > 0;
    }
    if let Failure::Lost { lost: failed, sent, .. } | Failure::BadReplies { bad: failed, sent, .. } = failure {
        return failed < sent;
    }
    matches!(failure, Failure::ProgramPart { .. })
}

/// Things to try after a call without a usable reply, by the traffic in place of the reply.
fn unanswered(error: &Error) -> Vec<String> {
    let seen = if let Error::Timeout { seen, .. } | Error::BadReply { seen, .. } = error {
        *seen
    } else if let Error::Offline { .. } = error {
        Seen::default()
    } else if let Error::Connect { endpoint, .. } = error {
        return vec![unconnected(endpoint).to_owned()];
    } else {
        return Vec::new();
    };
    let mut hints = Vec::new();
    if let Some(station) = seen.other_station {
        hints.push(format!("station {station} has sent frames: try --station {station}"));
    }
    if seen.late_by.is_some() {
        hints.push("replies come too late: try a longer --timeout".to_owned());
    }
    if seen.echo {
        hints.push("the line echoes requests, and no PLC answers: check the wires A and B, and --station".to_owned());
    }
    if seen.garbage > 0 || seen.half_frame {
        hints.push("bytes came that are no frame: try the other framing (?framing=binary or ascii)".to_owned());
        hints.push("on a serial line, `fatek detect PORT` tries speeds and frames".to_owned());
    }
    if seen.is_nothing() {
        hints.push("nothing came: `fatek scan` finds the stations of a link".to_owned());
        hints
            .push("try the other framing (?framing=binary or ascii); on a serial line, `fatek detect PORT`".to_owned());
    }
    hints.push("docs/CONNECT.md has more causes".to_owned());
    hints
}

/// The next thing to try for an endpoint without a connection.
fn unconnected(endpoint: &str) -> &'static str {
    if endpoint.starts_with("serial:") {
        "`fatek ports` lists the serial ports"
    } else {
        "`fatek scan --network 192.168.2.0/24` finds the PLCs of a network"
    }
}

/// A command for a station of a link, to be pasted into a shell.
pub(crate) fn command(endpoint: &Endpoint, station: u8, command: &str) -> String {
    let link = endpoint.to_string();
    // Of the characters that the URL of an endpoint can have, a shell takes some for its own.
    let is_plain = |c: char| c.is_ascii_alphanumeric() || "/:._-".contains(c);
    let link = if link.chars().all(is_plain) { link } else { format!("'{}'", link.replace('\'', r"'\''")) };
    format!("fatek --link {link} --station {station} {command}")
}

/// The assignment with a type that takes these values, if the default type of the elements does not.
pub(crate) fn with_other_type(tag: &Tag, elements: &str, values: &str) -> Option<String> {
    const MAX: usize = 60;
    let width = tag.first().width();
    if tag.tag_type() != TagType::default_for(width) || tag.scale().is_some() || values.len() > MAX {
        return None;
    }
    // A number with a point is no mistyped integer.
    let signed = if width == Width::DWord { TagType::I32 } else { TagType::I16 };
    let tag_type = if values.contains('.') { TagType::F32 } else { signed };
    let other: Tag = format!("{elements}:{tag_type}").parse().ok()?;
    // Missing values are another mistake.
    if other.value_count() != tag.value_count() {
        return None;
    }
    other.parse_values(values).ok()?;
    let more = if other.element_count() > tag.element_count() { " (it takes two registers)" } else { "" };
    Some(format!("{other}={values}{more}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_can_be_pasted_into_a_shell() {
        for (link, shown) in [
            ("tcp://10.0.0.1", "tcp://10.0.0.1:500"),
            ("tcp://[::1]:500", "'tcp://[::1]:500'"),
            ("tcp://10.0.0.1:5000?framing=binary", "'tcp://10.0.0.1:5000?framing=binary'"),
            ("serial:/dev/a b;$x", "'serial:/dev/a b;$x'"),
            ("serial:/dev/it's", r"'serial:/dev/it'\''s'"),
        ] {
            let endpoint: Endpoint = link.parse().unwrap();
            assert_eq!(command(&endpoint, 7, "status"), format!("fatek --link {shown} --station 7 status"));
        }
    }

    #[test]
    fn an_endpoint_without_a_connection_has_a_hint_of_its_own() {
        assert!(unconnected("serial:/dev/ttyUSB0").contains("fatek ports"));
        assert!(unconnected("tcp://10.0.0.1:500").contains("fatek scan --network"));
    }

    #[test]
    fn another_type_is_suggested_if_it_takes_the_values() {
        let hint = |elements: &str, values| with_other_type(&elements.parse().unwrap(), elements, values);
        assert_eq!(hint("R0", "-5").as_deref(), Some("R0:i16=-5"));
        assert_eq!(hint("R0-R1", "-5,6").as_deref(), Some("R0-R1:i16=-5,6"));
        assert_eq!(hint("DR0", "-70000").as_deref(), Some("DR0:i32=-70000"));
        assert_eq!(hint("R0", "21.5").as_deref(), Some("R0:f32=21.5 (it takes two registers)"));
        assert_eq!(hint("DR0", "-1.5").as_deref(), Some("DR0:f32=-1.5"));
        for (elements, values) in [
            ("R0", "abc"),
            ("M0", "7"),
            ("R0", "-70000"),
            ("R0-R1", "5"),
            ("R0-R3", "1,2"),
            ("R0", "3000000000"),
            ("R0:i16", "-40000"),
            ("R0:u16*0.1", "x"),
        ] {
            assert_eq!(hint(elements, values), None, "{elements}={values}");
        }
    }
}
