//! Heap blocks per call, counted over a thousand calls on loopback TCP.
//!
//! The other end answers without allocating, so all counted blocks belong to the client: its own
//! code, Tokio and the buffers. Equal calls are counted on two kinds of lines: without duplicates,
//! where each request keeps its spelling; and with the default settings, where the link uses
//! another spelling or a loop-back between two.
#![allow(clippy::print_stdout, reason = "prints its figures")]

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

/// A single test, because all tests would share the heap.
#[tokio::test]
async fn calls_allocate_at_most_one_block_besides_the_value() {
    let _profiler = dhat::Profiler::builder().testing().build();
    let mut failures = Vec::new();
    let without_duplicates = InStepSettings::new().with_copies(0).unwrap();
    for (in_step, line) in [(without_duplicates, "no duplicates"), (InStepSettings::new(), "duplicates")] {
        for framing in [Framing::Ascii, Framing::Binary] {
            let mut check = |what: &str, blocks: u64, most: u64| {
                println!("{line}, {framing}: {blocks} blocks for {CALLS} times {what}");
                if blocks > most {
                    failures.push(format!("{line}, {framing}, {what}: {blocks} blocks"));
                }
            };
            for count in [64, 10] {
                let words: Vec<u16> = (0..count).map(|n| n * 1001).collect();
                let mut exchanges = ScriptedExchanges::new(framing);
                exchanges.add(&ReadRegisters::new(register!("R0"), words.len()).unwrap(), &words);
                let elements: Vec<Element> = (0..count).map(|n| Register::r(n).into()).collect();
                let values: Vec<Value> = words.iter().map(|&word| word.into()).collect();
                exchanges.add(&ReadMixed::new(elements).unwrap(), &values);
                let station = exchanges.serve(in_step);
                let plain = blocks(async || {
                    assert_eq!(station.read_registers(register!("R0"), words.len()).await.unwrap(), words);
                });
                let plain = plain.await;
                check(&format!("read_registers of {count}"), plain, 2 * CALLS);
                assert!(plain >= CALLS, "{framing}: {plain} blocks: each Vec is a block, so the count is wrong");

                let mut values = vec![0; words.len()];
                let into = blocks(async || {
                    values.fill(0);
                    station.read_registers_into(register!("R0"), &mut values).await.unwrap();
                    assert_eq!(values[..], words[..]);
                });
                check(&format!("read_registers_into of {count}"), into.await, 0);
            }

            let bits: Vec<bool> = (0..256).map(|n| n % 3 == 0).collect();
            let mut exchanges = ScriptedExchanges::new(framing);
            exchanges.add(&ReadDiscretes::new(discrete!("M0"), 256).unwrap(), &bits);
            let station = exchanges.serve(in_step);
            let mut states = [false; 256];
            let into = blocks(async || {
                station.read_discretes_into(discrete!("M0"), &mut states).await.unwrap();
                assert_eq!(states[..], bits[..]);
            });
            check("read_discretes_into of 256", into.await, 0);

            let words: Vec<u16> = (0..10).map(|n| n * 1001).collect();
            let mut exchanges = ScriptedExchanges::new(framing);
            exchanges.add(&WriteRegisters::new(register!("R0"), &words[..]).unwrap(), &());
            let items: Vec<_> =
                (0..).map(|n| Register::r(n).into()).zip(words.iter().map(|&word| word.into())).collect();
            exchanges.add(&WriteMixed::new(items).unwrap(), &());
            let station = exchanges.serve(in_step);
            let write = blocks(async || station.write_registers(register!("R0"), &words[..]).await.unwrap());
            check("write_registers of 10", write.await, CALLS);
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

/// Number of blocks that [`CALLS`] calls allocate, after a few warm-up calls.
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

/// Scripted requests and their replies.
struct ScriptedExchanges {
    framing: Framing,
    exchanges: Vec<(BytesMut, BytesMut)>,
}

impl ScriptedExchanges {
    fn new(framing: Framing) -> Self {
        let mut exchanges = Self { framing, exchanges: Vec::new() };
        exchanges.add(&LoopBack::new("").unwrap(), &());
        exchanges
    }

    fn add<C: Command>(&mut self, request: &C, reply: &C::Reply) {
        let (mut sent, mut answer) = (BytesMut::new(), BytesMut::new());
        encode_request(request, self.framing, 1, &mut sent).unwrap();
        encode_reply(request, Ok(reply), self.framing, 1, &mut answer);
        self.exchanges.push((sent, answer));
    }

    /// Starts a PLC that answers these requests, and the first check of the connection.
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
                if let Some((_, answer)) = self.exchanges.iter().find(|(sent, _)| sent == request) {
                    stream.write_all(answer).unwrap();
                    len = 0;
                } else if !self.exchanges.iter().any(|(sent, _)| sent.starts_with(request)) {
                    // The first check, before the calls that are counted.
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
