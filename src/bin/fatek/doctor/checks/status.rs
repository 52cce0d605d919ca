//! Checks of the two statuses, and of the model that they tell.

use super::{answer, replies};
use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::{Facts, counts};
use crate::doctor::request::Requests;

/// STATUS2 of 40 that a source has.
const CAPACITIES: [u8; 7] = [0x00, 0x40, 0x53, 0x54, 0x55, 0x56, 0xFF];

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let brief = |name: &'static str, source, text: &str, judge: fn(&[u8]) -> Finding| {
        let judge = move |facts: &Facts, done: &[Exchange]| match answer(facts, done, 0) {
            Answer::Data(data) => judge(&facts.requests.bytes(data)),
            answer @ (Answer::Refused(_) | Answer::None) => Finding::open(answer.to_string()),
        };
        let asks = replies([requests.status()]);
        Check::fixed((Group::Status, name, source), text, asks, judge).kind(Kind::Basic).needs(&[0x40])
    };
    let detailed = |name: &'static str, source, text: &str, judge: fn(&Facts, &[u8]) -> Finding| {
        let judge = move |facts: &Facts, _: &[Exchange]| match facts.detailed() {
            Some(status) => judge(facts, status.raw()),
            None => Finding::open("not examined: the PLC does not execute 53"),
        };
        Check::fixed((Group::Status, name, source), text, Vec::new(), judge).kind(Kind::Basic)
    };
    vec![
        brief("reserved-bit", "protocol 5", "bit 7 of STATUS1 is reserved: 0", |status| match status {
            [flags, ..] if flags & 0x80 != 0 => Finding::contradicts("it is 1"),
            [..] => Finding::holds("it is 0"),
        }),
        brief("capacity-code", "protocol 5; facts 7", "STATUS2 of 40 is 00, 40, 53 to 56 or FF", |status| match status
            .get(1)
        {
            Some(code) if !CAPACITIES.contains(code) => Finding::contradicts(format!("it is {code:02X}")),
            Some(code) => Finding::holds(format!("it is {code:02X}")),
            None => Finding::open("no status"),
        }),
        statuses_agree(requests),
        detailed("main-unit", "protocol 5; facts, question 5", "STATUS2 of 53 is 00 (MA, MU) or 01 (MC)", |_, raw| {
            let code = raw.get(1).copied().unwrap_or_default();
            let text = format!("it is {code:02X}");
            if code <= 1 { Finding::holds(text) } else { Finding::contradicts(text) }
        }),
        detailed("os-version", "protocol 5", "STATUS4 of 53 is the version in two decimal digits", |_, raw| {
            let code = raw.get(3).copied().unwrap_or_default();
            let text = format!("it is {code:02X}");
            if code >> 4 <= 9 && code & 15 <= 9 { Finding::holds(text) } else { Finding::contradicts(text) }
        }),
        detailed("detailed-length", "protocol 5", "53 has 64 bytes by its table", |_, raw| {
            let text = format!("{} bytes", raw.len());
            if raw.len() == 64 { Finding::holds(text) } else { Finding::contradicts(text) }
        }),
        detailed("model-counts", "facts 1", "53 has the counts of an FBE-28MC or an FBS-20MC", |facts, _| {
            let own = facts.detailed().map(counts).unwrap_or_default();
            let text =
                format!("M {} S {} L {} R {} D {} T {} C {}", own[0], own[1], own[2], own[3], own[4], own[5], own[6]);
            let known = facts.model().filter(|model| counts(&model.detailed_status()) == own);
            match known {
                Some(model) => Finding::holds(format!("{model}: {text}")),
                None => Finding::contradicts(text),
            }
        }),
    ]
}

/// STATUS1 of both statuses is the same. A PLC may start between them, so both are read again if they differ.
fn statuses_agree(requests: Requests) -> Check {
    let agree = |facts: &Facts, done: &[Exchange]| {
        let flags = |n: usize| match answer(facts, done, n) {
            // The reserved bit is a matter of its own.
            Answer::Data(data) => facts.requests.bytes(data).first().map(|flags| flags & 0x7F),
            Answer::Refused(_) | Answer::None => None,
        };
        let last = done.len().checked_sub(2)?;
        Some(flags(last)? == flags(last + 1)?)
    };
    let next = move |facts: &Facts, done: &[Exchange]| {
        let ask = if done.len().is_multiple_of(2) { requests.status() } else { requests.detailed() };
        let is_enough =
            done.len() >= 6 || done.len().is_multiple_of(2) && !done.is_empty() && agree(facts, done) != Some(false);
        (!is_enough).then_some(Ask::Reply(ask))
    };
    let judge = move |facts: &Facts, done: &[Exchange]| match agree(facts, done) {
        Some(true) => Finding::holds("they are equal"),
        Some(false) => Finding::contradicts("they differ"),
        None => Finding::open("not examined: a status is missing"),
    };
    let text = "STATUS1 of 53 is that of 40";
    let id = (Group::Status, "statuses-agree", "protocol 5");
    Check::adaptive(id, text, 6, next, judge).usually(2).kind(Kind::Basic).needs(&[0x40, 0x53])
}
