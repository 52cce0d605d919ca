//! Checks of the memory: ends and gaps of the areas, and the clock.

use fatek::clock::Clock;
use fatek::command::Code;
use fatek::{MemoryMap, Symbol};

use super::{answer, replies};
use crate::doctor::check::{Check, Finding, Group};
use crate::doctor::exchange::{Answer, Ask, Exchange};
use crate::doctor::facts::Facts;
use crate::doctor::request::{Request, Requests, Unit, unit_of};

/// The areas whose ends are examined. RC ends with counters of 32 bits.
const AREAS: [Symbol; 9] =
    [Symbol::X, Symbol::Y, Symbol::M, Symbol::S, Symbol::T, Symbol::C, Symbol::RT, Symbol::R, Symbol::D];

pub(super) fn checks(requests: Requests) -> Vec<Check> {
    let mut checks: Vec<Check> = AREAS.into_iter().map(|area| end(requests, area)).collect();
    let gap = ["R4167", "R4168", "R4999", "R5000"].map(|register| read(requests, register));
    let text = "R4168 to R4999 do not exist: error A";
    let judge = |facts: &Facts, done: &[Exchange]| edges(facts, done, &[true, false, false, true]);
    let id = (Group::Memory, "gap-r", "facts 1");
    checks.push(Check::fixed(id, text, replies(gap), judge).needs(&[0x46]));
    let judge = |facts: &Facts, done: &[Exchange]| edges(facts, done, &[true, false]);
    let ends = ["WM1984", "WM1992"].map(|word| read(requests, word));
    let text = "a word of discretes that ends behind the last one is refused with error A";
    let id = (Group::Memory, "end-words", "facts, question 4");
    let check = Check::fixed(id, text, replies(ends), judge);
    checks.push(check.needs(&[0x46]));
    checks.extend(clock(requests));
    checks
}

/// A read of one element.
fn read(requests: Requests, element: &str) -> Request {
    let code = if unit_of(element) == Unit::Bit { Code::ReadDiscretes } else { Code::ReadRegisters };
    requests.read(code, 1, element)
}

/// The last element of an area by the model is there, and the next one is not.
fn end(requests: Requests, area: Symbol) -> Check {
    let next = move |facts: &Facts, done: &[Exchange]| {
        let last = last(&facts.map()?, area)?;
        let element = [last, last.checked_add(1)?].get(done.len()).map(|n| format!("{area}{n}"))?;
        Some(Ask::Reply(read(requests, &element)))
    };
    let judge = move |facts: &Facts, done: &[Exchange]| match facts.map().and_then(|map| last(&map, area)) {
        Some(last) => {
            let finding = edges(facts, done, &[true, false]);
            Finding { text: format!("{area}{last}: {}", finding.text), ..finding }
        }
        None => Finding::open("not examined: the model is not known"),
    };
    let needs: &[u8] = if unit_of(area.as_str()) == Unit::Bit { &[0x44] } else { &[0x46] };
    let text = format!("the last element of {area} is that of the model, and the next one has error A");
    let name = format!("end-{}", area.as_str().to_lowercase());
    Check::adaptive((Group::Memory, &name, "facts 1"), text, 2, next, judge).needs(needs)
}

/// The last address of an area.
fn last(map: &MemoryMap, area: Symbol) -> Option<u16> {
    map.ranges().iter().map(|range| range.last).filter(|last| last.symbol() == area).map(|last| last.address()).max()
}

/// Elements that exist are answered, and others are refused with error A.
fn edges(facts: &Facts, done: &[Exchange], exist: &[bool]) -> Finding {
    for (n, exists) in exist.iter().enumerate() {
        let element =
            if exist.len() == 2 { ["the last one", "the next one"][n].to_owned() } else { format!("edge {}", n + 1) };
        match (exists, answer(facts, done, n)) {
            (true, Answer::Data(_)) | (false, Answer::Refused(10)) => {}
            (_, answer) => return Finding::contradicts(format!("{element} is {answer}")),
        }
    }
    Finding::holds("as assumed")
}

fn clock(requests: Requests) -> Vec<Check> {
    let present = || requests.read(Code::ReadDiscretes, 1, "M1954");
    let registers = || requests.read(Code::ReadRegisters, 8, "R4128");
    let judge = |judge: fn(&[u16]) -> Finding| {
        move |facts: &Facts, done: &[Exchange]| match (answer(facts, done, 0), answer(facts, done, 1)) {
            (Answer::Data(present), Answer::Data(registers)) => match facts.requests.bits(present).first() {
                Some(true) => judge(&facts.requests.words(registers)),
                Some(false) | None => Finding::open("no clock: M1954 is 0"),
            },
            (Answer::Data(_), other) | (other, _) => Finding::open(format!("not readable: {other}")),
        }
    };
    let check =
        |name: &'static str, text: &str, judge: fn(&[u16]) -> Finding| (Group::Clock, name, text.to_owned(), judge);
    let checks = [
        check(
            "clock",
            "with M1954 on, R4128 to R4134 are second, minute, hour, day, month, year, weekday",
            |registers| {
                let seven = registers.first_chunk::<7>().copied().unwrap_or_default();
                match Clock::from_registers(seven) {
                    Ok(_) => Finding::holds("a date and a time"),
                    Err(error) => Finding::contradicts(format!("the {} is out of its range", error.part)),
                }
            },
        ),
        check("clock-r4135", "R4135 has the hour in its high byte and the minute in its low one", |registers| {
            match *registers {
                [_, minute, hour, _, _, _, _, both] if both == hour << 8 | minute => Finding::holds("hour and minute"),
                [..] => Finding::contradicts("not the hour and the minute of R4130 and R4129"),
            }
        }),
    ];
    let to_check = |(group, name, text, rule)| {
        Check::fixed((group, name, "facts 1"), text, replies([present(), registers()]), judge(rule))
            .needs(&[0x44, 0x46])
    };
    checks.map(to_check).into()
}
