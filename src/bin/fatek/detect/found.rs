//! Results of a detection, and their output.

use std::time::Duration;

use fatek::command::{BriefStatus, Code, DetailedStatus};
use fatek::wire::Frame;
use fatek::{Endpoint, ErrorCode};

use crate::enquiry::Traffic;
use crate::failure::Failure;
use crate::output::{Format, Output, Rows, version};

/// A station that answers.
pub(super) struct Found {
    pub(super) endpoint: Endpoint,
    pub(super) station: u8,
    /// Status requests, and replies to them.
    pub(super) requests: u32,
    pub(super) replies: u32,
    pub(super) brief: Option<BriefStatus>,
    pub(super) detailed: Option<DetailedStatus>,
    /// The request of the detailed status had no good reply.
    pub(super) is_detail_missing: bool,
    pub(super) refused: Option<ErrorCode>,
    /// First round trip.
    pub(super) time: Duration,
    /// Traffic besides the replies.
    pub(super) traffic: Traffic,
}

impl Found {
    /// Column `answer`. Echoes do not lower it: they are no sign of other settings.
    fn answer(&self) -> &'static str {
        let is_answered = self.replies == self.requests && !self.is_detail_missing;
        if is_answered && self.traffic.garbage == 0 && self.traffic.frames.is_empty() { "sure" } else { "likely" }
    }

    fn note(&self) -> Option<String> {
        let mut notes = Vec::new();
        if self.replies < self.requests {
            notes.push(format!("{} of {} requests answered", self.replies, self.requests));
        }
        if self.is_detail_missing {
            notes.push("no answer to the detailed status (53)".to_owned());
        }
        if let Some(code) = self.refused {
            notes.push(format!("refused: {code}"));
        }
        if self.traffic.echoes > 0 {
            notes.push("requests are echoed".to_owned());
        }
        if self.traffic.garbage > 0 {
            notes.push(format!("{} bytes that are no frame", self.traffic.garbage));
        }
        if let Some(frame) = self.traffic.frames.first() {
            notes.push(other_frame(frame));
        }
        (!notes.is_empty()).then(|| notes.join("; "))
    }
}

/// Text for a frame that was not asked for.
fn other_frame(frame: &Frame) -> String {
    let command =
        Code::from_u8(frame.command).map_or_else(|| format!("command {:02X}h", frame.command), |code| code.to_string());
    format!("a frame of station {}: {command}", frame.station)
}

/// Prints the stations; without any, the settings at which good frames of others came.
pub(super) fn print<'f>(
    all: &[Found],
    frames: impl Iterator<Item = (Endpoint, &'f Frame)>,
    output: &Output,
) -> Result<(), Failure> {
    let mut table = Rows::new(["link", "station", "answer", "running", "model", "note"]);
    let mut rows = Rows::new([
        "link",
        "baud",
        "frame",
        "framing",
        "station",
        "answer",
        "requests",
        "replies",
        "running",
        "main_unit",
        "os_version",
        "time_ms",
        "note",
    ]);
    let mut push = |endpoint: &Endpoint, station: u8, answer: &str, found: Option<&Found>, note: Option<String>| {
        let running = found.and_then(|found| found.brief).map(|status| status.flags().running());
        let detailed = found.and_then(|found| found.detailed.as_ref());
        let main_unit = detailed.map(|status| status.main_unit().to_string());
        let os_version = detailed.map(|status| version(status.os_version()));
        let link = endpoint.to_string();
        if output.format == Format::Table {
            let model = main_unit.zip(os_version).map(|(unit, version)| format!("{unit} {version}"));
            table.push([link.into(), station.into(), answer.into(), running.into(), model.into(), note.into()]);
            return;
        }
        let serial = endpoint.transport().serial_settings();
        rows.push([
            link.into(),
            serial.map(|serial| serial.baud()).into(),
            serial.map(|serial| format!("{}{}{}", serial.data_bits(), serial.parity(), serial.stop_bits())).into(),
            endpoint.framing().to_string().into(),
            station.into(),
            answer.into(),
            found.map(|found| found.requests).into(),
            found.map(|found| found.replies).into(),
            running.into(),
            main_unit.into(),
            os_version.into(),
            found.map(|found| found.time).into(),
            note.into(),
        ]);
    };
    for found in all {
        push(&found.endpoint, found.station, found.answer(), Some(found), found.note());
    }
    if all.is_empty() {
        for (endpoint, frame) in frames {
            push(&endpoint, frame.station, "heard", None, Some(other_frame(frame)));
        }
    }
    output.rows(&if output.format == Format::Table { table.without_empty("note") } else { rows })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(requests: u32, replies: u32, traffic: Traffic) -> Found {
        Found {
            endpoint: Endpoint::serial("/dev/x"),
            station: 1,
            requests,
            replies,
            brief: None,
            detailed: None,
            is_detail_missing: false,
            refused: None,
            time: Duration::ZERO,
            traffic,
        }
    }

    #[test]
    fn missing_replies_garbage_and_other_frames_lower_the_confidence() {
        let frame = Frame { station: 9, command: 0x99, data: Default::default() };
        let other = Traffic { frames: vec![frame], ..Traffic::default() };
        for (found, answer, note) in [
            (found(4, 4, Traffic::default()), "sure", None),
            (found(4, 4, Traffic { echoes: 4, ..Traffic::default() }), "sure", Some("requests are echoed")),
            (
                Found { is_detail_missing: true, ..found(4, 4, Traffic::default()) },
                "likely",
                Some("no answer to the detailed status (53)"),
            ),
            (found(4, 3, Traffic::default()), "likely", Some("3 of 4 requests answered")),
            (found(4, 4, Traffic { garbage: 2, ..Traffic::default() }), "likely", Some("2 bytes that are no frame")),
            (found(4, 4, other), "likely", Some("a frame of station 9: command 99h")),
        ] {
            assert_eq!((found.answer(), found.note().as_deref()), (answer, note));
        }
    }
}
