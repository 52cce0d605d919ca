use tokio_util::codec::Decoder;

use super::*;
use crate::command::{Code, Value};
use crate::sim::{Faults, LeftOver, Line, Plc, Rule, Timing};
use crate::wire::{Codec, Side};
use crate::{ErrorCode, element, register};

mod broadcasts;
mod copies;
mod faults;
mod left_overs;
mod log;
mod time;

/// Sets R0 of station 1 to 5, and the reply.
const SET: &[u8] = b"\x02014701R00000000536\x03";
const IS_SET: &[u8] = b"\x0201470FE\x03";
/// Reads it, and the replies to that.
const READ: &[u8] = b"\x02014601R0000070\x03";
const READS_0: &[u8] = b"\x02014600000BD\x03";
const READS_5: &[u8] = b"\x02014600005C2\x03";
/// The same of station 2.
const READ_2: &[u8] = b"\x02024601R0000071\x03";
const READS_2: &[u8] = b"\x02024600000BE\x03";
/// Sets R0 of all stations to 7.
const BROADCAST_7: &[u8] = b"\x02004701R00000000737\x03";
/// Reads R0 of station 3, which is not there.
const NOBODY: &[u8] = b"\x02034601R0000072\x03";

/// A bus with the stations 1 and 2, and everything that is said over one connection to it.
struct Talk {
    conversation: Conversation,
    faults: Faults,
    plcs: [Plc; 2],
    began: Instant,
    /// Each with its time since the beginning, in microseconds.
    said: Vec<(u128, String)>,
}

impl Talk {
    fn new(faults: Faults) -> Self {
        let plcs = [Plc::new(), Plc::new()];
        let bus = Bus::new().with_station(1, plcs[0].clone()).unwrap().with_station(2, plcs[1].clone()).unwrap();
        let bus = bus.with_faults(faults.clone());
        let conversation = Conversation::new(bus.clone(), bus.conditions().unwrap().clone(), Framing::Ascii);
        Self { conversation, faults, plcs, began: Instant::now(), said: Vec::new() }
    }

    fn of(rules: impl IntoIterator<Item = Rule>) -> Self {
        let faults = Faults::new(1);
        faults.set_rules(rules);
        Self::new(faults)
    }

    fn over(line: Line) -> Self {
        Self::new(Faults::new(1).line(line))
    }

    /// Another connection to the same bus.
    fn join(&self) -> Self {
        let Conversation { bus, conditions, framing, .. } = &self.conversation;
        let conversation = Conversation::new(bus.clone(), conditions.clone(), *framing);
        Self { conversation, faults: self.faults.clone(), plcs: self.plcs.clone(), began: self.began, said: Vec::new() }
    }

    /// The connection opens, or is to look for what other connections have left over.
    fn open(&mut self, at_ms: u64) {
        self.wait(at_ms);
        self.conversation.adopt_left_overs(self.after(at_ms));
        self.wait(at_ms);
    }

    /// These bytes come this many milliseconds after the beginning; all that is due before them is done.
    fn hear(&mut self, at_ms: u64, bytes: &[u8]) {
        self.wait(at_ms);
        let mut codec = Codec::new(Framing::Ascii, Side::Plc);
        let mut src = BytesMut::from(bytes);
        let mut rest = Bytes::copy_from_slice(bytes);
        while let Some(item) = codec.decode_eof(&mut src).unwrap() {
            let of_item = rest.split_to(rest.len() - src.len());
            self.conversation.hear(item, of_item, self.after(at_ms));
        }
        self.wait(at_ms);
    }

    fn wait(&mut self, until_ms: u64) {
        let until = self.after(until_ms);
        while let Some(due) = self.conversation.due().filter(|&due| due <= until) {
            while let Some(output) = self.conversation.next(due) {
                let output = match output {
                    Output::Bytes(bytes) => text(&bytes),
                    Output::Close => "closed".to_owned(),
                };
                self.said.push(((due - self.began).as_micros(), output));
            }
        }
    }

    /// All that is said from the beginning to the end.
    fn all(mut self) -> Vec<(u128, String)> {
        self.wait(10 * 86_400_000);
        self.said
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

/// What one request gives under one fault.
fn under(fault: Fault, request: &[u8]) -> Vec<(u128, String)> {
    let mut talk = Talk::of([Rule::new(fault)]);
    talk.hear(0, request);
    talk.all()
}

fn delay_ms(min: u64, max: u64) -> Fault {
    Fault::Delay { min: Duration::from_millis(min), max: Duration::from_millis(max) }
}

/// Every PLC takes 5 ms.
fn after_5_ms(rules: impl IntoIterator<Item = Rule>) -> Talk {
    let talk = Talk::of(rules);
    talk.faults.set_line(Line::new(0).turnaround(Duration::from_millis(5), Duration::from_millis(5)));
    talk
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
