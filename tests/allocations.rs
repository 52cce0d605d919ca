//! How many blocks of memory a call takes from the heap, counted over a thousand calls on loopback TCP.
//!
//! The other end answers by itself, without any memory, so that what is counted is the client's: its own code, Tokio's, and
//! that of the buffers.
#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

use std::io::{Read, Write};
use std::net::TcpListener;

use bytes::BytesMut;
use fatek::command::{Command, ReadDiscretes, ReadRegisters, WriteRegisters, encode_reply, encode_request};
use fatek::wire::Framing;
use fatek::{Endpoint, Link, Station, discrete, register};

#[global_allocator]
static HEAP: dhat::Alloc = dhat::Alloc;

const CALLS: u64 = 1000;

/// One test, because the heap is one.
#[tokio::test]
async fn a_call_takes_one_block_besides_its_value_and_one_into_memory_of_the_caller_takes_none() {
    let _profiler = dhat::Profiler::builder().testing().build();
    for framing in [Framing::Ascii, Framing::Binary] {
        let words: Vec<u16> = (0..64).map(|n| n * 1001).collect();
        let read = ReadRegisters::new(register!("R0"), 64).unwrap();
        let station = plc(framing, &read, &words);
        let plain =
            blocks(async || assert_eq!(station.read_registers(register!("R0"), 64).await.unwrap(), words)).await;
        println!("{framing}: {plain} blocks for {CALLS} times read_registers");
        assert!(plain >= CALLS, "{framing}: {plain} blocks: a Vec is a block, so the counting is wrong");
        assert!(plain <= 2 * CALLS, "{framing}: {plain} blocks for {CALLS} calls");

        let mut values = [0; 64];
        let into = blocks(async || {
            values.fill(0);
            station.read_registers_into(register!("R0"), &mut values).await.unwrap();
            assert_eq!(values[..], words[..]);
        });
        let into = into.await;
        println!("{framing}: {into} blocks for {CALLS} times read_registers_into");
        assert_eq!(into, 0, "{framing}");

        let bits: Vec<bool> = (0..256).map(|n| n % 3 == 0).collect();
        let station = plc(framing, &ReadDiscretes::new(discrete!("M0"), 256).unwrap(), &bits);
        let mut states = [false; 256];
        let into = blocks(async || {
            station.read_discretes_into(discrete!("M0"), &mut states).await.unwrap();
            assert_eq!(states[..], bits[..]);
        });
        let into = into.await;
        println!("{framing}: {into} blocks for {CALLS} times read_discretes_into");
        assert_eq!(into, 0, "{framing}");

        let station = plc(framing, &WriteRegisters::new(register!("R0"), &words[..10]).unwrap(), &());
        let write = blocks(async || station.write_registers(register!("R0"), &words[..10]).await.unwrap()).await;
        println!("{framing}: {write} blocks for {CALLS} times write_registers");
        assert!(write <= CALLS, "{framing}: {write} blocks for {CALLS} writes");
    }
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

/// A PLC that is asked one thing and answers one thing.
fn plc<C: Command>(framing: Framing, request: &C, reply: &C::Reply) -> Station {
    let (mut asked, mut answer) = (BytesMut::new(), BytesMut::new());
    encode_request(request, framing, 1, &mut asked).unwrap();
    encode_reply(request, Ok(reply), framing, 1, &mut answer);
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let endpoint = format!("tcp://{}?framing={framing}", listener.local_addr().unwrap());
    std::thread::spawn(move || {
        let (mut stream, _) = listener.accept().unwrap();
        stream.set_nodelay(true).unwrap();
        let mut buffer = [0; 1024];
        let buffer = &mut buffer[..asked.len()];
        while stream.read_exact(buffer).is_ok() {
            assert_eq!(buffer, &asked[..]);
            stream.write_all(&answer).unwrap();
        }
    });
    Link::new(endpoint.parse::<Endpoint>().unwrap()).station(1).unwrap()
}
