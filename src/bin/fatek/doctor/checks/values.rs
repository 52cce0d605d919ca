//! Checks of values: words of discretes, mixed lists, and counters of 32 bits.
//!
//! Values are read before and after: only those that did not change meanwhile are compared.

use fatek::command::Code;

use super::{all_answered, answer, replies};
use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::Requests;

/// Discretes whose words are compared, until some have states that show their order.
const WORDS: [char; 4] = ['Y', 'X', 'M', 'S'];

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let word = |area: char| {
        let read = move |n: u16| requests.read(Code::ReadRegisters, 1, &format!("W{area}{n}"));
        let asks = replies([read(0), read(8), read(16)]);
        let text = format!("words of {area} are read at multiples of 8");
        let name = format!("words-{}", area.to_ascii_lowercase());
        let id = (Group::Values, &name[..], "protocol 3");
        Check::fixed(id, text, asks, words_answered).kind(Kind::Basic).needs(&[0x46])
    };
    let mut checks: Vec<Check> = ['X', 'Y', 'M', 'S', 'T', 'C'].map(word).into();
    checks.push(bits_of_words(requests));
    checks.push(mixed_order(requests));
    checks.extend(counters(requests));
    checks
}

fn words_answered(facts: &Facts, done: &[Exchange]) -> Finding {
    let is_answered = |n| matches!(answer(facts, done, n), Answer::Data(_));
    match [0, 1, 2].map(is_answered) {
        [true, true, true] => Finding::holds("answered"),
        [true, false, true] => {
            Finding::contradicts(format!("at multiples of 16 only; at 8: {}", answer(facts, done, 1)))
        }
        [false, ..] => Finding::contradicts(answer(facts, done, 0).to_string()),
        [true, _, false] => Finding::contradicts(format!("at 16: {}", answer(facts, done, 2))),
    }
}

/// A word has 16 discretes, the first as its lowest bit, and the next word of a run follows at +16.
fn bits_of_words(requests: Requests) -> Check {
    // For each area: two words, their 32 discretes, the words again.
    let next = move |facts: &Facts, done: &[Exchange]| {
        let shows = |area: usize| judge_words(facts, &done[3 * area..]).is_some();
        let complete = done.len() / 3;
        if done.len().is_multiple_of(3) && complete > 0 && shows(complete - 1) {
            return None;
        }
        let area = WORDS.get(complete)?;
        Some(Ask::Reply(match done.len() % 3 {
            1 => requests.read(Code::ReadDiscretes, 32, &format!("{area}8")),
            _ => requests.read(Code::ReadRegisters, 2, &format!("W{area}8")),
        }))
    };
    let judge = move |facts: &Facts, done: &[Exchange]| match done.chunks(3).find_map(|area| judge_words(facts, area)) {
        Some(true) => Finding::holds("as the discretes"),
        Some(false) => Finding::contradicts("other states than the discretes"),
        None => Finding::open("the states did not show the order, such as all off"),
    };
    let text = "two words at 8 are the 32 discretes from 8 on, each with the first as its lowest bit";
    let id = (Group::Values, "bits-of-words", "protocol 3");
    Check::adaptive(id, text, 12, next, judge).needs(&[0x44, 0x46])
}

/// Returns whether two words are their discretes; `None` if the states do not show it.
fn judge_words(facts: &Facts, done: &[Exchange]) -> Option<bool> {
    let [Answer::Data(before), Answer::Data(discretes), Answer::Data(after)] =
        [0, 1, 2].map(|n| answer(facts, done, n))
    else {
        return None;
    };
    let words = facts.requests.words(before);
    let states = facts.requests.bits(discretes);
    let of_words: Vec<bool> = words.iter().flat_map(|word| (0..16).map(move |bit| word >> bit & 1 == 1)).collect();
    let is_symmetric = states.iter().all(|state| *state == states[0]);
    (before == after && !is_symmetric && states.len() == of_words.len()).then_some(of_words == states)
}

/// The values of a mixed list are in its order, with the widths of its elements.
fn mixed_order(requests: Requests) -> Check {
    let singles = [
        requests.read(Code::ReadDiscretes, 1, "M0"),
        requests.read(Code::ReadRegisters, 1, "R0"),
        requests.read(Code::ReadRegisters, 1, "DR2"),
        requests.read(Code::ReadRegisters, 1, "WM0"),
    ];
    let mixed = requests.mixed(&["M0", "R0", "DR2", "WM0"]);
    let asks = replies(singles.clone().into_iter().chain([mixed]).chain(singles));
    let judge = |facts: &Facts, done: &[Exchange]| {
        let data = |n: usize| if let Answer::Data(data) = answer(facts, done, n) { Some(data) } else { None };
        let before: Option<Vec<&[u8]>> = (0..4).map(data).collect();
        let after: Option<Vec<&[u8]>> = (5..9).map(data).collect();
        match (data(4), before, after) {
            (Some(mixed), Some(before), Some(after)) if before == after => match before.concat() == mixed {
                true => Finding::holds("as read one by one"),
                false => Finding::contradicts("other values than read one by one"),
            },
            (Some(_), Some(_), Some(_)) => Finding::open("the values changed meanwhile"),
            _ => Finding::open("not all of them are answered"),
        }
    };
    let text = "a mixed list of M0, R0, DR2 and WM0 has their values in this order";
    let id = (Group::Values, "mixed-order", "protocol 5");
    Check::fixed(id, text, asks, judge).kind(Kind::Basic).needs(&[0x44, 0x46, 0x48])
}

fn counters(requests: Requests) -> Vec<Check> {
    let read = move |n, first: &str| requests.read(Code::ReadRegisters, n, first);
    let one_by_one = ["DRC200", "DRC201", "DRC255"].map(|counter| read(1, counter));
    let run = [read(1, "DRC200"), read(1, "DRC201"), read(1, "DRC202"), read(2, "DRC200"), read(1, "DRC200")];
    let mixed = [read(1, "DRC200"), read(1, "DRC201"), requests.mixed(&["DRC200", "DRC201"]), read(1, "DRC200")];
    let id = |name| (Group::Counters, name, "protocol 3; facts 2, question 1");
    vec![
        Check::fixed(
            id("drc-single"),
            "DRC200 to DRC255 are read one by one, 32 bits each",
            replies(one_by_one),
            all_answered,
        )
        .kind(Kind::Basic)
        .needs(&[0x46]),
        Check::fixed(id("drc-run"), "a run from DRC200 on steps by one counter", replies(run), counter_run)
            .kind(Kind::Basic)
            .needs(&[0x46]),
        Check::fixed(
            id("drc-mixed"),
            "a mixed list has DRC200 and DRC201 as two counters",
            replies(mixed),
            mixed_counters,
        )
        .kind(Kind::Basic)
        .needs(&[0x46, 0x48]),
    ]
}

fn counter_run(facts: &Facts, done: &[Exchange]) -> Finding {
    let values = |n: usize| match answer(facts, done, n) {
        Answer::Data(data) => facts.requests.dwords(data),
        Answer::Refused(_) | Answer::None => Vec::new(),
    };
    let singles: Vec<u32> = (0..3).flat_map(values).collect();
    let [first, second, third] = singles[..] else { return Finding::open("not all of them are answered") };
    let run = answer(facts, done, 3);
    if !matches!(run, Answer::Data(_)) {
        return Finding::open(format!("a run is {run}"));
    }
    match values(3)[..] {
        _ if values(4) != [first] => Finding::open("the values changed meanwhile"),
        [a, b] if a == first && b == second && second != third => Finding::holds("a run steps by one counter"),
        [a, b] if a == first && b == third && second != third => Finding::contradicts("a run steps by two counters"),
        [a, b] if a == first && b != second && b != third => Finding::contradicts("a run has other values"),
        _ => Finding::open("a run is answered; equal values do not show its step"),
    }
}

fn mixed_counters(facts: &Facts, done: &[Exchange]) -> Finding {
    let data = |n: usize| if let Answer::Data(data) = answer(facts, done, n) { Some(data) } else { None };
    match (data(0), data(1), data(2), data(3)) {
        (Some(first), _, Some(_), Some(after)) if first != after => Finding::open("the values changed meanwhile"),
        (Some(first), Some(second), Some(mixed), Some(_)) => match [first, second].concat() == mixed {
            true => Finding::holds("as read one by one"),
            false => Finding::contradicts("other values than read one by one"),
        },
        (Some(_), Some(_), None, _) => Finding::contradicts(answer(facts, done, 2).to_string()),
        _ => Finding::open("not all of them are answered"),
    }
}
