//! The list of assumptions that are examined, each with its source.
//!
//! Sources: `protocol N` is a section of the protocol reference (docs/PROTOCOL.md), `facts N` one of the facts about
//! the hardware (docs/HARDWARE.md).

mod commands;
mod connections;
mod errors;
mod limits;
mod memory;
mod order;
mod status;
mod traffic;
mod values;
mod writes;

use std::time::Duration;

use super::check::{Check, Finding};
use super::exchange::{Answer, Ask, Exchange};
use super::facts::Facts;
use super::request::{Request, Requests};

/// Numbers that the user chooses.
#[derive(Clone, Debug)]
pub(crate) struct Numbers {
    /// Connections that are open together.
    pub(crate) connections: usize,
    /// Time without a request.
    pub(crate) idle: Duration,
    /// Requests of the load check.
    pub(crate) load: usize,
    /// The element that is written.
    pub(crate) element: Option<String>,
}

/// All checks, in the order in which they are made: commands first, because others rest on them.
pub(crate) fn all(requests: Requests, numbers: &Numbers) -> Vec<Check> {
    let mut all = commands::checks(requests);
    all.extend(status::checks(requests));
    all.extend(traffic::checks(requests));
    all.extend(limits::checks(requests));
    all.extend(errors::checks(requests));
    all.extend(values::checks(requests));
    all.extend(memory::checks(requests));
    all.extend(order::checks(requests, numbers.load));
    all.extend(connections::checks(requests, numbers));
    all.extend(writes::checks(requests, numbers.element.as_deref()));
    all
}

/// The answer to the n-th request of a check.
fn answer<'e>(facts: &Facts, done: &'e [Exchange], n: usize) -> Answer<'e> {
    done.get(n).map_or(Answer::None, |exchange| exchange.answer(facts.framing()))
}

fn replies(requests: impl IntoIterator<Item = Request>) -> Vec<Ask> {
    requests.into_iter().map(Ask::Reply).collect()
}

/// Holds if each request is refused with one of these codes.
fn refusals(codes: &'static [u8]) -> impl Fn(&Facts, &[Exchange]) -> Finding {
    move |facts, done| {
        let answers: Vec<Answer<'_>> = (0..done.len()).map(|n| answer(facts, done, n)).collect();
        let is_as_assumed = |answer: &Answer<'_>| matches!(answer, Answer::Refused(code) if codes.contains(code));
        match answers.iter().find(|answer| !is_as_assumed(answer)).or(answers.first()) {
            Some(answer) if is_as_assumed(answer) => Finding::holds(answer.to_string()),
            Some(answer) => Finding::contradicts(answer.to_string()),
            None => Finding::open("nothing was asked"),
        }
    }
}

/// Holds if each request is answered.
fn all_answered(facts: &Facts, done: &[Exchange]) -> Finding {
    let answers: Vec<Answer<'_>> = (0..done.len()).map(|n| answer(facts, done, n)).collect();
    match answers.iter().position(|answer| !matches!(answer, Answer::Data(_))) {
        None => Finding::holds("answered"),
        Some(n) if answers.len() == 1 => Finding::contradicts(answers[n].to_string()),
        Some(n) => Finding::contradicts(format!("request {} of {}: {}", n + 1, answers.len(), answers[n])),
    }
}
