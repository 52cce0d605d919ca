//! Checks of values: words of discretes, mixed lists, and counters of 32 bits.
//!
//! Values are read before and after: only those that did not change meanwhile are compared. One can also change and
//! change back, so a contradiction must show in several rounds. Equal values show no order: the check stays open.

use fatek::command::Code;

use super::{all_answered, answer, replies};
use crate::doctor::check::{Check, Finding, Group, Kind, ROUNDS};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Requests, Unit, unit_of};

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
    checks.push(dword_order(requests));
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
        let area = match areas(facts, done) {
            Areas::Next(area) | Areas::Differs { area, .. } => WORDS.get(area)?,
            Areas::Shown(_) => return None,
        };
        Some(Ask::Reply(match done.len() % 3 {
            1 => requests.read(Code::ReadDiscretes, 32, &format!("{area}8")),
            _ => requests.read(Code::ReadRegisters, 2, &format!("W{area}8")),
        }))
    };
    let judge = move |facts: &Facts, done: &[Exchange]| match areas(facts, done) {
        Areas::Shown(finding) => finding,
        Areas::Next(_) | Areas::Differs { .. } => Finding::open("the states did not show the order, such as all off"),
    };
    let text = "two words at 8 are the 32 discretes from 8 on, each with the first as its lowest bit";
    let id = (Group::Values, "bits-of-words", "protocol 3");
    Check::adaptive(id, text, 3 * (WORDS.len() + ROUNDS - 1), next, judge).usually(3).needs(&[0x44, 0x46])
}

/// The progress of comparing words with discretes, area by area.
enum Areas {
    /// The area to be read next: those before it did not show the order.
    Next(usize),
    /// The area differed in this number of rounds in succession.
    Differs {
        area: usize,
        rounds: usize,
    },
    Shown(Finding),
}

fn areas(facts: &Facts, done: &[Exchange]) -> Areas {
    done.chunks_exact(3).fold(Areas::Next(0), |areas, round| match (areas, judge_words(facts, round)) {
        (shown @ Areas::Shown(_), _) => shown,
        (Areas::Next(area), None) => Areas::Next(area + 1),
        (Areas::Next(_), Some(true)) => Areas::Shown(Finding::holds("as the discretes")),
        (Areas::Next(area), Some(false)) => Areas::Differs { area, rounds: 1 },
        (Areas::Differs { area, rounds }, Some(false)) if rounds + 1 < ROUNDS => {
            Areas::Differs { area, rounds: rounds + 1 }
        }
        (Areas::Differs { .. }, Some(false)) => Areas::Shown(Finding::contradicts("other states than the discretes")),
        (Areas::Differs { .. }, None | Some(true)) => {
            Areas::Shown(Finding::open("a difference was not repeated: the states change"))
        }
    })
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
    let elements = ["M0", "R0", "DR2", "WM0"];
    let single = |element: &str| {
        let code = if unit_of(element) == Unit::Bit { Code::ReadDiscretes } else { Code::ReadRegisters };
        requests.read(code, 1, element)
    };
    let ([a, b, c, d], [e, f, g, h]) = (elements.map(single), elements.map(single));
    let round = [a, b, c, d, requests.mixed(&elements), e, f, g, h];
    let text = "a mixed list of M0, R0, DR2 and WM0 has their values in this order";
    let id = (Group::Values, "mixed-order", "protocol 5");
    Check::rounds(id, text, round, mixed_list::<4>).kind(Kind::Basic).needs(&[0x44, 0x46, 0x48])
}

/// Compares a mixed list with its elements one by one, which were read before and after it.
fn mixed_list<const N: usize>(facts: &Facts, done: &[Exchange]) -> Finding {
    let data = |n: usize| if let Answer::Data(data) = answer(facts, done, n) { Some(data) } else { None };
    let before: Option<Vec<&[u8]>> = (0..N).map(data).collect();
    let after: Option<Vec<&[u8]>> = (N + 1..=2 * N).map(data).collect();
    let (Some(before), Some(after)) = (before, after) else { return Finding::open("not all of them are answered") };
    match data(N) {
        None => Finding::contradicts(answer(facts, done, N).to_string()),
        Some(_) if before != after => Finding::open("the values changed meanwhile"),
        Some(mixed) if before.concat() != mixed => Finding::contradicts("other values than read one by one"),
        Some(_) if !shows_order(&before) => Finding::open("as read one by one; equal values do not show the order"),
        Some(_) => Finding::holds("as read one by one"),
    }
}

/// Returns whether the exchange of any two parts shows in the whole.
fn shows_order(parts: &[&[u8]]) -> bool {
    let whole = parts.concat();
    let pairs = (0..parts.len()).flat_map(|a| (a + 1..parts.len()).map(move |b| (a, b)));
    pairs.into_iter().all(|(a, b)| {
        let mut exchanged = parts.to_vec();
        exchanged.swap(a, b);
        exchanged.concat() != whole
    })
}

/// A register of 32 bits has the register of its own number as its low word.
fn dword_order(requests: Requests) -> Check {
    let words = requests.read(Code::ReadRegisters, 2, "R0");
    let round = [words.clone(), requests.read(Code::ReadRegisters, 1, "DR0"), words];
    let judge = |facts: &Facts, done: &[Exchange]| {
        let [Answer::Data(before), Answer::Data(dword), Answer::Data(after)] =
            [0, 1, 2].map(|n| answer(facts, done, n))
        else {
            return Finding::open("not all of them are answered");
        };
        match (&facts.requests.words(before)[..], &facts.requests.dwords(dword)[..]) {
            _ if before != after => Finding::open("the values changed meanwhile"),
            (&[low, high], &[dword]) if dword == u32::from(high) << 16 | u32::from(low) => match low == high {
                true => Finding::open("R0 and R1; equal values do not show the order"),
                false => Finding::holds("R0 is the low word"),
            },
            (&[low, high], &[dword]) if dword == u32::from(low) << 16 | u32::from(high) => {
                Finding::contradicts("R0 is the high word")
            }
            _ => Finding::contradicts("other values than R0 and R1"),
        }
    };
    let text = "DR0 has R0 as its low word and R1 as its high one";
    Check::rounds((Group::Values, "dword-order", "protocol 3"), text, round, judge).kind(Kind::Basic).needs(&[0x46])
}

fn counters(requests: Requests) -> Vec<Check> {
    let read = move |n, first: &str| requests.read(Code::ReadRegisters, n, first);
    let one = move |counter: &str| read(1, counter);
    let singles = || ["DRC200", "DRC201", "DRC202"].map(one);
    let ([a, b, c], [d, e, f]) = (singles(), singles());
    let run = [a, b, c, read(2, "DRC200"), d, e, f];
    let ([a, b, _], [c, d, _]) = (singles(), singles());
    let mixed = [a, b, requests.mixed(&["DRC200", "DRC201"]), c, d];
    let id = |name| (Group::Counters, name, "protocol 3; facts 2, question 1");
    let check = |name, text: &str, counters: &[&str]| {
        let asks = replies(counters.iter().map(|counter| one(counter)));
        Check::fixed(id(name), text, asks, all_answered).kind(Kind::Basic).needs(&[0x46])
    };
    vec![
        check("rc-single", "RC0 to RC199 are read as 16 bits each", &["RC0", "RC199"]),
        check("drc-single", "DRC200 to DRC255 are read one by one, 32 bits each", &["DRC200", "DRC201", "DRC255"]),
        Check::rounds(id("drc-run"), "a run from DRC200 on steps by one counter", run, counter_run)
            .kind(Kind::Basic)
            .needs(&[0x46]),
        Check::rounds(id("drc-mixed"), "a mixed list has DRC200 and DRC201 as two counters", mixed, mixed_list::<2>)
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
    let again: Vec<u32> = (4..7).flat_map(values).collect();
    let [first, second, third] = singles[..] else { return Finding::open("not all of them are answered") };
    let run = answer(facts, done, 3);
    if !matches!(run, Answer::Data(_)) {
        return Finding::open(format!("a run is {run}"));
    }
    match values(3)[..] {
        _ if again != singles => Finding::open("the values changed meanwhile"),
        [a, b] if a == first && b == second && second != third => Finding::holds("a run steps by one counter"),
        [a, b] if a == first && b == third && second != third => Finding::contradicts("a run steps by two counters"),
        [a, b] if a == first && b != second && b != third => Finding::contradicts("a run has other values"),
        _ => Finding::open("a run is answered; equal values do not show its step"),
    }
}
