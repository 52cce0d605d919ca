//! Checks of writing to the one element that the user names. Its value is restored.

use fatek::command::Code;

use crate::doctor::check::{Check, Finding, Group, Kind, Undo};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Request, Requests, Unit, unit_of};

/// Differs from each value in half of its bits.
const PATTERN: u16 = 0x5AA5;

pub(super) fn checks(requests: Requests, element: Option<&str>) -> Vec<Check> {
    // Without an element, the checks are listed as not examined.
    let element = element.unwrap_or("R0").to_owned();
    let is_discrete = unit_of(&element) == Unit::Bit;
    let (plain, name) =
        if is_discrete { (Code::WriteDiscretes, "write-45") } else { (Code::WriteRegisters, "write-47") };
    let write = |code: Code| {
        let element = element.clone();
        move |value: u16| requests.write(code, &element, value)
    };
    let mut checks = vec![
        check(requests, name, "a value that is written is read back", &element, write(plain)),
        check(requests, "write-49", "a value of a mixed write (49) is read back", &element, write(Code::WriteMixed)),
    ];
    if is_discrete {
        let control = {
            let element = element.clone();
            move |value: u16| requests.control(if value == 0 { 4 } else { 3 }, &element)
        };
        checks.push(check(requests, "control-42", "42 sets and resets a discrete", &element, control));
    }
    checks
}

/// Reads, writes another value, reads it back, restores, reads again.
fn check(
    requests: Requests,
    name: &str,
    text: &str,
    element: &str,
    write: impl Fn(u16) -> Request + Clone + 'static,
) -> Check {
    let is_discrete = unit_of(element) == Unit::Bit;
    let code = if is_discrete { Code::ReadDiscretes } else { Code::ReadRegisters };
    let read = requests.read(code, 1, element);
    let other = move |value: u16| if is_discrete { 1 - value.min(1) } else { value ^ PATTERN };
    let (restore, undo, written) = (write.clone(), write.clone(), element.to_owned());
    let next = move |facts: &Facts, done: &[Exchange]| match done.len() {
        0 | 2 | 4 => Some(Ask::Reply(read.clone())).filter(|_| done.is_empty() || value(facts, done, 0).is_some()),
        1 => Some(Ask::Once(write(other(value(facts, done, 0)?)))),
        // A write without a reply may have been executed.
        3 => Some(Ask::Once(restore(value(facts, done, 0)?))),
        _ => None,
    };
    let undo = move |facts: &Facts, done: &[Exchange]| {
        let is_pending = (1..=3).contains(&done.len());
        let before = value(facts, done, 0).filter(|_| is_pending)?;
        Some(Undo { request: undo(before), assignment: format!("{written}={before}") })
    };
    let judge = move |facts: &Facts, done: &[Exchange]| {
        let values = [0, 2, 4].map(|n| value(facts, done, n));
        let [Some(before), Some(written), Some(after)] = values else {
            return Finding::open("the element is not readable");
        };
        let write = done[1].answer(facts.framing());
        match write {
            _ if before != after => Finding::contradicts("the value was not restored, or the program changes it"),
            Answer::Refused(_) | Answer::None => Finding::contradicts(format!("the write is {write}")),
            Answer::Data(_) if written == other(before) => Finding::holds("written, read back, restored"),
            Answer::Data(_) if written == before => Finding::contradicts("the write had no effect"),
            Answer::Data(_) => Finding::open("the program changes the element"),
        }
    };
    let id = (Group::Writing, name, "protocol 5");
    Check::adaptive(id, text, 5, next, judge).kind(Kind::Write).undo(undo)
}

/// The value that was read by the n-th request.
fn value(facts: &Facts, done: &[Exchange], n: usize) -> Option<u16> {
    let exchange = done.get(n)?;
    let Answer::Data(data) = exchange.answer(facts.framing()) else { return None };
    let is_discrete =
        exchange.ask.request().is_some_and(|request| request.frame.command == u8::from(Code::ReadDiscretes));
    if is_discrete {
        facts.requests.bits(data).first().map(|&state| state.into())
    } else {
        facts.requests.words(data).first().copied()
    }
}
