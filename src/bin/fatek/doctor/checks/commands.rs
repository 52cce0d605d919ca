//! Checks of the commands that only read: that the PLC executes them.

use fatek::command::Code;
use fatek::wire::Framing;

use super::{all_answered, refusals, replies};
use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Requests, Shape};

/// Codes that no source has, far from those of the protocol.
const UNKNOWN: [u8; 2] = [0x00, 0xFF];

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let known = |name: &'static str, text: &str, request| {
        let id = (Group::Commands, name, "protocol 5");
        Check::fixed(id, text, replies([request]), all_answered).kind(Kind::Basic)
    };
    let mut checks = vec![
        known("status-40", "the brief status (40) is answered with 3 bytes", requests.status()),
        known("loop-back-4e", "the loop-back (4E) is echoed without an error code", requests.loop_back("FATEKPLC")),
        known("registers-46", "registers are read (46)", requests.read(Code::ReadRegisters, 1, "R0")),
        known("discretes-44", "discretes are read (44)", requests.read(Code::ReadDiscretes, 1, "M0")),
        known("disabled-43", "enable states are read (43)", requests.read(Code::ReadDisabled, 1, "M0")),
        known("mixed-48", "lists of elements are read (48)", requests.mixed(&["R0"])),
        known("detailed-53", "the detailed status (53) is answered with 28 bytes or more", requests.detailed()),
    ];
    if requests.framing == Framing::Ascii {
        let id = (Group::Commands, "page-4f", "protocol 5, rulings");
        let text = "a program page (4F) comes with an error digit or alone; else there is an error digit alone";
        checks.push(Check::fixed(id, text, replies([requests.page(0)]), page).kind(Kind::Full));
    }
    let unknown = UNKNOWN.map(|code| requests.plain(code, Shape::Any));
    let id = (Group::Errors, "unknown-command", "protocol 4");
    let text = "a command that does not exist is refused with error 4";
    let asks = unknown.into_iter().map(Ask::Once).collect();
    checks.push(Check::fixed(id, text, asks, refusals(&[4])).kind(Kind::UnknownCommands));
    checks
}

fn page(facts: &Facts, done: &[Exchange]) -> Finding {
    match done.first().map(|exchange| exchange.answer(facts.framing())) {
        Some(Answer::Data(_)) => {
            let len = done.iter().flat_map(Exchange::frames).map(|frame| frame.data.len()).last();
            Finding::holds(if len == Some(256) { "a page alone" } else { "an error digit and a page" })
        }
        Some(Answer::Refused(code)) => Finding::holds(format!("4F is refused with error {code:X}")),
        Some(Answer::None) | None => match done.iter().flat_map(Exchange::frames).next() {
            Some(frame) => Finding::contradicts(format!("a reply of {} characters", frame.data.len())),
            None => Finding::open("4F is not answered; the list of an FBs does not have it"),
        },
    }
}
