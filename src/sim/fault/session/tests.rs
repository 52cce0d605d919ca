use tokio_util::codec::Decoder;

use super::*;
use crate::command::{Code, Value};
use crate::sim::{Faults, LeftOver, Line, Plc, Rule, Timing};
use crate::wire::{Codec, Side};
use crate::{ErrorCode, element, register};

mod broadcasts;
mod duplicates;
mod faults;
mod left_overs;
mod log;
mod time;

/// Write of 5 to R0 of station 1, and its reply.
const SET: &[u8] = b"\x02014701R00000000536\x03";
const IS_SET: &[u8] = b"\x0201470FE\x03";
/// Read of R0 of station 1, and its replies.
const READ: &[u8] = b"\x02014601R0000070\x03";
const IS_0: &[u8] = b"\x02014600000BD\x03";
const IS_5: &[u8] = b"\x02014600005C2\x03";
/// Read of R0 of station 2, and its reply.
const READ_2: &[u8] = b"\x02024601R0000071\x03";
const IS_0_OF_2: &[u8] = b"\x02024600000BE\x03";
/// Write of 7 to R0 of all stations.
const BROADCAST_7: &[u8] = b"\x02004701R00000000737\x03";
/// Read of R0 of station 3, which is absent.
const READ_ABSENT: &[u8] = b"\x02034601R0000072\x03";

/// A bus with stations 1 and 2, one connection to it, and its outputs.
struct Bench {
    session: Session,
    faults: Faults,
    plcs: [Plc; 2],
    began: Instant,
    /// Outputs with their times, in microseconds from the beginning.
    sent: Vec<(u128, String)>,
}

impl Bench {
    fn new(faults: Faults) -> Self {
        let plcs = [Plc::new(), Plc::new()];
        let bus = Bus::new().with_station(1, plcs[0].clone()).unwrap().with_station(2, plcs[1].clone()).unwrap();
        let bus = bus.with_faults(faults.clone());
        let session = Session::new(bus.clone(), bus.conditions().unwrap().clone(), Framing::Ascii);
        Self { session, faults, plcs, began: Instant::now(), sent: Vec::new() }
    }

    fn of(rules: impl IntoIterator<Item = Rule>) -> Self {
        let faults = Faults::new(1);
        faults.set_rules(rules);
        Self::new(faults)
    }

    fn over(line: Line) -> Self {
        Self::new(Faults::new(1).line(line))
    }

    /// Opens another connection to the same bus.
    fn connect(&self) -> Self {
        let Session { bus, conditions, framing, .. } = &self.session;
        let session = Session::new(bus.clone(), conditions.clone(), *framing);
        Self { session, faults: self.faults.clone(), plcs: self.plcs.clone(), began: self.began, sent: Vec::new() }
    }

    /// Handles the opening of the connection, or a change of the left-over replies.
    fn open(&mut self, at_ms: u64) {
        self.wait(at_ms);
        self.session.take_left_over(self.after(at_ms));
        self.wait(at_ms);
    }

    /// Receives bytes at a time in milliseconds, after all events that are due before.
    fn receive(&mut self, at_ms: u64, bytes: &[u8]) {
        self.wait(at_ms);
        let mut codec = Codec::new(Framing::Ascii, Side::Plc);
        let mut src = BytesMut::from(bytes);
        let mut rest = Bytes::copy_from_slice(bytes);
        while let Some(item) = codec.decode_eof(&mut src).unwrap() {
            let of_item = rest.split_to(rest.len() - src.len());
            self.session.receive(item, of_item, self.after(at_ms));
        }
        self.wait(at_ms);
    }

    fn wait(&mut self, until_ms: u64) {
        let until = self.after(until_ms);
        while let Some(due) = self.session.due().filter(|&due| due <= until) {
            while let Some(output) = self.session.next_output(due) {
                let output = match output {
                    Output::Bytes(bytes) => text(&bytes),
                    Output::Close => "closed".to_owned(),
                };
                self.sent.push(((due - self.began).as_micros(), output));
            }
        }
    }

    /// All outputs until no more events are due.
    fn all(mut self) -> Vec<(u128, String)> {
        self.wait(10 * 86_400_000);
        self.sent
    }

    fn after(&self, ms: u64) -> Instant {
        self.began + Duration::from_millis(ms)
    }

    fn r0(&self) -> u16 {
        match self.plcs[0].read(register!("R0")) {
            Value::Word(word) => word,
            value => panic!("{value:?}"),
        }
    }
}

/// The outputs for one request with one fault.
fn under(fault: Fault, request: &[u8]) -> Vec<(u128, String)> {
    let mut bench = Bench::of([Rule::new(fault)]);
    bench.receive(0, request);
    bench.all()
}

fn delay_ms(min: u64, max: u64) -> Fault {
    Fault::Delay { min: Duration::from_millis(min), max: Duration::from_millis(max) }
}

/// A bus with a response time of 5 ms.
fn after_5_ms(rules: impl IntoIterator<Item = Rule>) -> Bench {
    let bench = Bench::of(rules);
    bench.faults.set_line(Line::new(0).response_time(Duration::from_millis(5), Duration::from_millis(5)));
    bench
}

fn text(bytes: &[u8]) -> String {
    bytes.escape_ascii().to_string()
}

fn at(us: u128, bytes: &[u8]) -> (u128, String) {
    (us, text(bytes))
}

fn closed(us: u128) -> (u128, String) {
    (us, "closed".to_owned())
}
