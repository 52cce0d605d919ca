//! Checks of writing to the one element that the user names. Its value is restored.

use fatek::command::Code;

use crate::doctor::check::{Check, Finding, Group, Kind, Undo};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Request, Requests, Unit, unit_of};

/// Differs from each value in half of its bits.
const PATTERN: u16 = 0x5AA5;
/// Writes that restore the element, at most: each may be lost.
const RESTORES: usize = 3;
/// Requests of a check that is restored at the first attempt.
const USUAL: usize = 5;

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
///
/// The value counts as restored when it is read back, not when the write is answered. Until then it is written
/// again, and behind [`RESTORES`] attempts it is left to the undo.
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
    let (undo, written, read_back) = (write.clone(), element.to_owned(), read.clone());
    let next = move |facts: &Facts, done: &[Exchange]| {
        if done.is_empty() {
            return Some(Ask::Reply(read.clone()));
        }
        let before = value(facts, done, 0).filter(|_| done.len() < MOST)?;
        match done.len() {
            1 => Some(Ask::Once(write(other(before)))),
            n if n.is_multiple_of(2) => Some(Ask::Reply(read.clone())),
            // A write without a reply may have been executed.
            _ if !is_restored(facts, done) => Some(Ask::Once(write(before))),
            _ => None,
        }
    };
    let undo = move |facts: &Facts, done: &[Exchange]| {
        // The value that a check has read before it writes; the write may be in progress.
        let value = value(facts, done, 0).filter(|_| !is_restored(facts, done))?;
        let assignment = format!("{written}={value}");
        Some(Undo { request: undo(value), read: read_back.clone(), value, assignment })
    };
    let judge = move |facts: &Facts, done: &[Exchange]| {
        let values = [0, 2, done.len().saturating_sub(1)].map(|n| value(facts, done, n));
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
    Check::adaptive(id, text, MOST, next, judge).usually(USUAL).kind(Kind::Write).undo(undo)
}

/// Requests of a check, at most.
const MOST: usize = USUAL + 2 * (RESTORES - 1);

/// Returns whether the element had its first value when it was read after a restore.
fn is_restored(facts: &Facts, done: &[Exchange]) -> bool {
    let last = done.len().saturating_sub(1);
    let is_read_back = done.len() >= USUAL && last.is_multiple_of(2);
    is_read_back && value(facts, done, last).is_some_and(|last| Some(last) == value(facts, done, 0))
}

/// The value that was read by the n-th request.
fn value(facts: &Facts, done: &[Exchange], n: usize) -> Option<u16> {
    let exchange = done.get(n)?;
    facts.requests.value(exchange.ask.request()?, exchange.answer(facts.framing()))
}
