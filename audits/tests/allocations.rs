//! How many blocks of memory a call takes from the heap, counted over a thousand calls on loopback TCP.
//!
//! The other end answers by itself, without any memory, so that what is counted is the client's: its own code, Tokio's, and
//! that of the buffers. Equal calls in turn are counted twice: on a line that never doubles a reply, where each is sent as it
//! is, and with the default settings, where the link looks for another spelling or sends a loop-back between two.
#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

use std::io::{Read, Write};
use std::net::TcpListener;

use bytes::BytesMut;
use fatek::command::{
    Command, LoopBack, ReadDiscretes, ReadMixed, ReadRegisters, Value, WriteMixed, WriteRegisters, encode_reply,
    encode_request,
};
use fatek::endpoint::InStepSettings;
use fatek::wire::{Codec, Frame, Framing, Side};
use fatek::{Element, Endpoint, Link, Register, Station, discrete, register};
use tokio_util::codec::{Decoder, Encoder};

#[global_allocator]
static HEAP: dhat::Alloc = dhat::Alloc;

const CALLS: u64 = 1000;

/// One test, because the heap is one.
#[tokio::test]
async fn a_call_takes_one_block_besides_its_value_and_one_into_memory_of_the_caller_takes_none() {
    let _profiler = dhat::Profiler::builder().testing().build();
    let mut too_many = Vec::new();
    let undoubled = InStepSettings::new().with_copies(0).unwrap();
    for (in_step, line) in [(undoubled, "never doubled"), (InStepSettings::new(), "doubled")] {
        for framing in [Framing::Ascii, Framing::Binary] {
            let mut check = |what: &str, blocks: u64, most: u64| {
                println!("{line}, {framing}: {blocks} blocks for {CALLS} times {what}");
                if blocks > most {
                    too_many.push(format!("{line}, {framing}, {what}: {blocks} blocks"));
                }
            };
            for count in [64, 10] {
                let words: Vec<u16> = (0..count).map(|n| n * 1001).collect();
                let mut known = Known::new(framing);
                known.add(&ReadRegisters::new(register!("R0"), words.len()).unwrap(), &words);
                let elements: Vec<Element> = (0..count).map(|n| Register::r(n).into()).collect();
                let values: Vec<Value> = words.iter().map(|&word| word.into()).collect();
                known.add(&ReadMixed::new(elements).unwrap(), &values);
                let station = known.serve(in_step);
                let plain = blocks(async || {
                    assert_eq!(station.read_registers(register!("R0"), words.len()).await.unwrap(), words);
                });
                let plain = plain.await;
                check(&format!("read_registers of {count}"), plain, 2 * CALLS);
                assert!(plain >= CALLS, "{framing}: {plain} blocks: a Vec is a block, so the counting is wrong");

                let mut values = vec![0; words.len()];
                let into = blocks(async || {
                    values.fill(0);
                    station.read_registers_into(register!("R0"), &mut values).await.unwrap();
                    assert_eq!(values[..], words[..]);
                });
                check(&format!("read_registers_into of {count}"), into.await, 0);
            }

            let bits: Vec<bool> = (0..256).map(|n| n % 3 == 0).collect();
            let mut known = Known::new(framing);
            known.add(&ReadDiscretes::new(discrete!("M0"), 256).unwrap(), &bits);
            let station = known.serve(in_step);
            let mut states = [false; 256];
            let into = blocks(async || {
                station.read_discretes_into(discrete!("M0"), &mut states).await.unwrap();
                assert_eq!(states[..], bits[..]);
            });
            check("read_discretes_into of 256", into.await, 0);

            let words: Vec<u16> = (0..10).map(|n| n * 1001).collect();
            let mut known = Known::new(framing);
            known.add(&WriteRegisters::new(register!("R0"), &words[..]).unwrap(), &());
            let items: Vec<_> =
                (0..).map(|n| Register::r(n).into()).zip(words.iter().map(|&word| word.into())).collect();
            known.add(&WriteMixed::new(items).unwrap(), &());
            let station = known.serve(in_step);
            let write = blocks(async || station.write_registers(register!("R0"), &words[..]).await.unwrap());
            check("write_registers of 10", write.await, CALLS);
        }
    }
    assert!(too_many.is_empty(), "{too_many:#?}");
}

/// How many blocks so many calls take, when a few have been made before.
async fn blocks(mut call: impl AsyncFnMut()) -> u64 {
    for _ in 0..100 {
        call().await;
    }
    let before = dhat::HeapStats::get().total_blocks;
    for _ in 0..CALLS {
        call().await;
    }
    dhat::HeapStats::get().total_blocks - before
}

/// What a PLC is asked, and what it answers.
struct Known {
    framing: Framing,
    exchanges: Vec<(BytesMut, BytesMut)>,
}

impl Known {
    fn new(framing: Framing) -> Self {
        let mut known = Self { framing, exchanges: Vec::new() };
        known.add(&LoopBack::new("").unwrap(), &());
        known
    }

    fn add<C: Command>(&mut self, request: &C, reply: &C::Reply) {
        let (mut asked, mut answer) = (BytesMut::new(), BytesMut::new());
        encode_request(request, self.framing, 1, &mut asked).unwrap();
        encode_reply(request, Ok(reply), self.framing, 1, &mut answer);
        self.exchanges.push((asked, answer));
    }

    /// A PLC that is asked nothing else, but for the check with which the connection begins.
    fn serve(self, in_step: InStepSettings) -> Station {
        let framing = self.framing;
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let endpoint = format!("tcp://{}?framing={framing}", listener.local_addr().unwrap());
        std::thread::spawn(move || {
            let (mut stream, _) = listener.accept().unwrap();
            stream.set_nodelay(true).unwrap();
            let (mut buffer, mut len) = ([0; 1024], 0);
            while let Ok(more @ 1..) = stream.read(&mut buffer[len..]) {
                len += more;
                let request = &buffer[..len];
                if let Some((_, answer)) = self.exchanges.iter().find(|(asked, _)| asked == request) {
                    stream.write_all(answer).unwrap();
                    len = 0;
                } else if !self.exchanges.iter().any(|(asked, _)| asked.starts_with(request)) {
                    // Once, before the calls that are counted.
                    let mut received = BytesMut::from(request);
                    let Some(received) = Codec::new(framing, Side::Plc).decode(&mut received).unwrap() else {
                        continue;
                    };
                    let check: Frame = received.frame().unwrap();
                    assert_eq!((check.command, check.data.len()), (0x4E, 8), "{check:?}");
                    let mut echo = BytesMut::new();
                    Codec::new(framing, Side::Plc).encode(check, &mut echo).unwrap();
                    stream.write_all(&echo).unwrap();
                    len = 0;
                }
            }
        });
        Link::builder(endpoint.parse::<Endpoint>().unwrap()).in_step(in_step).build().station(1).unwrap()
    }
}
