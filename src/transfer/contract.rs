//! The contract of every transfer, checked at each step of runs against a PLC in memory: lost
//! requests and replies, duplicates, shorter replies, and dropped futures.
//!
//! Rules:
//! - before STOP, RUN and [`Step::Done`] all replies are confirmed;
//! - the position is never beyond its end;
//! - a run ends within a bounded number of steps.

use std::time::Duration;

use super::step::{Reply, Request, Step, Transfer};
use crate::command::{
    Code, ControlPlc, ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadProgramPage, ReadRegisters, ReadStatus,
    Value, WriteDiscretes, WriteProgramPage, WriteRegisters,
};
use crate::element::Element;
use crate::error::{Error, ErrorCode};
use crate::random::Random;
use crate::sim::Plc;
use crate::tag::Tag;

/// More steps than any run takes.
const MANY: usize = 20_000;

/// The end of a run.
#[derive(Debug)]
pub(crate) enum End<F> {
    Done,
    Failed(F),
    /// The future was dropped.
    Dropped,
}

/// Runs a transfer, which has begun. One in `rarity` requests, checks and replies has a fault; 0: none.
pub(crate) fn run<T: Transfer>(transfer: &mut T, plc: &Plc, random: &mut Random, rarity: u64) -> End<T::Failure> {
    let mut fault = |factor: u64| rarity > 0 && random.next().is_multiple_of(rarity * factor);
    let mut held = None;
    for _ in 0..MANY {
        let step = match transfer.next() {
            Ok(step) => step,
            Err(failure) => return End::Failed(failure),
        };
        let mark = transfer.mark();
        let handled = match step {
            Step::Done => {
                assert!(held.is_none(), "replies are not confirmed at the end");
                return End::Done;
            }
            Step::Confirm => match held.take() {
                Some(mark) if fault(2) => {
                    transfer.rewind(mark);
                    continue;
                }
                Some(mark) if fault(2) => {
                    held = Some(mark);
                    transfer.confirmed(Err(timeout(Code::LoopBack, true)))
                }
                Some(_) | None => transfer.confirmed(Ok(())),
            },
            Step::Send(request) => {
                let is_command = matches!(request, Request::Stop | Request::Run);
                assert!(held.is_none() || !is_command, "{request:?} before a check");
                if fault(5) {
                    let _ = execute(plc, request, false);
                    return End::Dropped;
                }
                let in_job = !matches!(request, Request::WritePage { .. } | Request::Pause) && !is_command;
                let (is_pause, is_lost) = (request == Request::Pause, fault(3));
                let result = match is_lost && !is_pause {
                    true => Err(timeout(Code::LoopBack, fault(1))),
                    false => execute(plc, request, fault(1)),
                };
                let is_lost = !is_pause && fault(3);
                let result = if is_lost { Err(timeout(Code::LoopBack, true)) } else { result };
                if in_job && result.is_ok() && fault(2) {
                    transfer.rewind(held.take().unwrap_or(mark));
                    continue;
                }
                match &result {
                    Ok(_) if in_job => {
                        held.get_or_insert(mark);
                    }
                    // A check comes before a refusal is returned.
                    Err(Error::Plc { .. }) if in_job => held = None,
                    Ok(_) | Err(_) => {}
                }
                transfer.keep(held);
                transfer.handle(result)
            }
        };
        if let Err(failure) = handled {
            return End::Failed(failure);
        }
        let position = transfer.position();
        assert!(position.done <= position.total || position.total == 0, "{position:?}");
    }
    panic!("a run has no end");
}

fn timeout(code: Code, sent: bool) -> Error {
    Error::timeout(1, code, Duration::ZERO, sent)
}

fn refusal(code: Code) -> impl Fn(ErrorCode) -> Error {
    move |error| Error::Plc { station: 1, code, error, repeated: false }
}

/// Executes a request. `shorter`: leaves an element to the next request, if that is allowed.
fn execute(plc: &Plc, request: Request, shorter: bool) -> Result<Reply, Error> {
    match request {
        Request::Status => plc.execute(&ReadStatus).map(Reply::Status).map_err(refusal(Code::ReadStatus)),
        Request::DetailedStatus => {
            plc.execute(&ReadDetailedStatus).map(Reply::DetailedStatus).map_err(refusal(Code::ReadDetailedStatus))
        }
        Request::Stop => plc.execute(&ControlPlc::Stop).map(|()| Reply::Done).map_err(refusal(Code::ControlPlc)),
        Request::Run => plc.execute(&ControlPlc::Run).map(|()| Reply::Done).map_err(refusal(Code::ControlPlc)),
        Request::Pause => Ok(Reply::Done),
        Request::ReadPage(page) => {
            plc.execute(&ReadProgramPage::new(page)).map(Reply::Page).map_err(refusal(Code::ReadProgramPage))
        }
        Request::WritePage { page, content, .. } => {
            let write = WriteProgramPage::new(page, content);
            plc.execute(&write).map(|()| Reply::Done).map_err(refusal(Code::WriteProgramPage))
        }
        Request::Read { range, shorter: may_be_shorter } => {
            let count = range.element_count();
            read(plc, range, if shorter && may_be_shorter && count > 1 { count - 1 } else { count })
        }
        Request::ReadDisabled(first, count) => {
            let read = ReadDisabled::new(first, count).unwrap();
            plc.execute(&read).map(Reply::Disabled).map_err(refusal(Code::ReadDisabled))
        }
        Request::Write(range, values) => write(plc, range, &values),
    }
}

fn read(plc: &Plc, range: Tag, count: usize) -> Result<Reply, Error> {
    let values = match range.first() {
        Element::Discrete(first) => plc
            .execute(&ReadDiscretes::new(first, count).unwrap())
            .map(|bits| bits.into_iter().map(Value::from).collect()),
        Element::Register(first) => plc
            .execute(&ReadRegisters::new(first, count).unwrap())
            .map(|words| words.into_iter().map(Value::from).collect()),
        Element::Register32(first) => plc
            .execute(&ReadRegisters::new(first, count).unwrap())
            .map(|doubles| doubles.into_iter().map(Value::from).collect()),
    };
    values.map(Reply::Values).map_err(refusal(Code::ReadRegisters))
}

fn write(plc: &Plc, range: Tag, values: &[Value]) -> Result<Reply, Error> {
    assert_eq!(range.element_count(), values.len());
    let mut values = values.iter().copied();
    let result = match range.first() {
        Element::Discrete(first) => {
            let bits: Vec<bool> = values.map(|value| value == Value::Bit(true)).collect();
            plc.execute(&WriteDiscretes::new(first, bits).unwrap())
        }
        Element::Register(first) => {
            let words: Option<Vec<u16>> =
                values.map(|value| if let Value::Word(word) = value { Some(word) } else { None }).collect();
            plc.execute(&WriteRegisters::new(first, words.unwrap()).unwrap())
        }
        Element::Register32(_) => {
            assert!(values.all(|value| matches!(value, Value::Bit(_))), "not used here");
            Ok(())
        }
    };
    result.map(|()| Reply::Done).map_err(refusal(Code::WriteRegisters))
}
