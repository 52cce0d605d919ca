//! Checks of the longest requests: the largest number of elements that is answered, and the answer to one more.

use fatek::command::Code;

use super::{answer, refusals, replies};
use crate::doctor::check::{Check, Finding, Group, Kind};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Request, Requests};

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let read = |code, first| move |n: u16| requests.read(code, n, first);
    let mixed = |elements: fn(u16) -> String| move |n: u16| requests.mixed(&(0..n).map(elements).collect::<Vec<_>>());
    let words = mixed(|n| format!("R{n}"));
    let pairs = mixed(|n| format!("DR{}", 2 * n));
    let discretes = mixed(|n| format!("M{n}"));
    vec![
        largest("longest-43", &[0x43], "43 reads 256 enable states (N=00)", 256, read(Code::ReadDisabled, "M0")),
        largest("longest-44", &[0x44], "44 reads 256 discretes (N=00)", 256, read(Code::ReadDiscretes, "M0")),
        largest("longest-46", &[0x46], "46 reads 64 registers", 64, read(Code::ReadRegisters, "R0")),
        largest("longest-46-dw", &[0x46], "46 reads 32 registers of 32 bits", 32, read(Code::ReadRegisters, "DR0")),
        largest("longest-48", &[0x48], "48 reads 64 registers", 64, words),
        largest("longest-48-dw", &[0x48], "48 reads 32 registers of 32 bits", 32, pairs),
        largest("longest-48-m", &[0x48], "48 reads 64 discretes", 64, discretes),
        beyond("beyond-46", &[0x46], "46 of 65 registers", read(Code::ReadRegisters, "R0")(65)),
        beyond("beyond-46-dw", &[0x46], "46 of 33 registers of 32 bits", read(Code::ReadRegisters, "DR0")(33)),
        beyond("beyond-48", &[0x48], "48 of 65 registers", words(65)),
        beyond("count-0", &[0x46], "46 of no register (N=00)", read(Code::ReadRegisters, "R0")(0)),
        loop_backs(requests),
    ]
}

/// A largest request is answered. If it is not, the largest one that is is found by halving.
fn largest(
    name: &str,
    needs: &'static [u8],
    text: &str,
    most: u16,
    request: impl Fn(u16) -> Request + 'static,
) -> Check {
    let next = move |facts: &Facts, done: &[Exchange]| {
        let (answered, refused) = bounds(facts, done, most);
        let n = if done.is_empty() { most } else { answered.midpoint(refused) };
        (n > answered).then(|| Ask::Reply(request(n)))
    };
    let judge = move |facts: &Facts, done: &[Exchange]| {
        let (answered, _) = bounds(facts, done, most);
        let refusals = (0..done.len()).rev().map(|n| answer(facts, done, n));
        let refusal = refusals.into_iter().find(|answer| !matches!(answer, Answer::Data(_)));
        match refusal {
            None => Finding::holds(format!("N = {answered} is answered")),
            Some(refusal) => Finding::contradicts(format!("N = {answered} is answered, {} {refusal}", answered + 1)),
        }
    };
    let halvings = most.ilog2() as usize + 1;
    let check = Check::adaptive((Group::Limits, name, "protocol 5"), text, 1 + halvings, next, judge).usually(1);
    check.kind(Kind::Basic).needs(needs)
}

/// The largest number that is known to be answered, and the smallest that is known not to be.
fn bounds(facts: &Facts, done: &[Exchange], most: u16) -> (u16, u16) {
    let (mut answered, mut refused) = (0, most + 1);
    for n in 0..done.len() {
        let tried = if n == 0 { most } else { u16::midpoint(answered, refused) };
        match answer(facts, done, n) {
            Answer::Data(_) => answered = tried,
            Answer::Refused(_) | Answer::None => refused = tried,
        }
    }
    (answered, refused)
}

/// A request over the limit is refused as such.
fn beyond(name: &str, needs: &'static [u8], what: &str, request: Request) -> Check {
    let text = format!("{what} is refused with error 2 or 4");
    let id = (Group::Limits, name, "protocol 4 and 5");
    Check::fixed(id, text, replies([request]), refusals(&[2, 4])).kind(Kind::Basic).needs(needs)
}

/// Loop-backs of several sizes, with all characters that can be sent.
fn loop_backs(requests: Requests) -> Check {
    let all: Vec<u8> = match requests.framing {
        fatek::Framing::Ascii => (b' '..=b'~').collect(),
        fatek::Framing::Binary | _ => (0..=255).collect(),
    };
    let of_len = |len: usize| requests.loop_back(all.iter().copied().cycle().take(len).collect::<Vec<u8>>());
    let asks = replies([0, 1, all.len(), 255, 256].map(of_len));
    let text = "loop-backs (4E) of 0 to 256 characters come back unchanged";
    let judge = |facts: &Facts, done: &[Exchange]| {
        let differing = (0..done.len()).find(|&n| !matches!(answer(facts, done, n), Answer::Data(_)));
        let size = |n: usize| done[n].ask.request().map_or(0, |request| request.frame.data.len());
        match differing {
            None => Finding::holds(format!("{} sizes", done.len())),
            Some(n) => {
                let other = done[n].frames().next().map(|_| "another reply".to_owned());
                let reply = other.unwrap_or_else(|| answer(facts, done, n).to_string());
                Finding::contradicts(format!("{} characters: {reply}", size(n)))
            }
        }
    };
    Check::fixed((Group::Limits, "loop-back-sizes", "protocol 5"), text, asks, judge).kind(Kind::Basic).needs(&[0x4E])
}
