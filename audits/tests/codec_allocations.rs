//! A warm codec does not allocate: encoding and decoding frames takes no heap, however the bytes
//! arrive. A whole exchange allocates only the values.
#![allow(clippy::print_stdout, reason = "it is a program")]

use bytes::{Bytes, BytesMut};
use fatek::command::{
    Command, MAX_POINTS, MAX_UNITS, ReadDiscretes, ReadRegisters, decode_reply, encode_reply, encode_request,
};
use fatek::wire::{Codec, Discard, Frame, Framing, Received, Side};
use fatek::{discrete, register};
use futures::{FutureExt, StreamExt};
use tokio_util::codec::{Decoder, Encoder, FramedRead};

#[global_allocator]
static HEAP: dhat::Alloc = dhat::Alloc;

const FRAMES: u64 = 1000;

/// Runs without the test harness, whose thread allocates, too.
fn main() {
    let _profiler = dhat::Profiler::builder().testing().build();
    for framing in [Framing::Ascii, Framing::Binary] {
        let words: Vec<u16> = (0..MAX_UNITS as u16).map(|n| n.wrapping_mul(0x9E37)).collect();
        let states: Vec<bool> = (0..MAX_POINTS).map(|n| n % 3 == 0).collect();
        check_read(framing, ReadRegisters::new(register!("R1000"), MAX_UNITS).unwrap(), words);
        check_read(framing, ReadDiscretes::new(discrete!("M100"), MAX_POINTS).unwrap(), states);
        println!("{framing}: a warm codec allocates nothing but the values");
    }
}

fn check_read<C: Command>(framing: Framing, request: C, values: C::Reply) {
    let request_bytes = encoded(|dst| encode_request(&request, framing, 1, dst).unwrap());
    let reply_bytes = encoded(|dst| encode_reply(&request, Ok(&values), framing, 1, dst));
    for (bytes, receiver, sender) in
        [(&request_bytes, Side::Plc, Side::Client), (&reply_bytes, Side::Client, Side::Plc)]
    {
        check_frames(framing, bytes, receiver, sender);
        check_pieces(framing, bytes, receiver);
        check_stream(framing, bytes, receiver);
        check_noise(framing, bytes, receiver);
    }

    // Client: sends from one buffer and receives into another.
    let (mut sent, mut received, mut codec) = (BytesMut::new(), BytesMut::new(), Codec::new(framing, Side::Client));
    let mut exchange = || {
        sent.clear();
        encode_request(&request, framing, 1, &mut sent).unwrap();
        received.extend_from_slice(&reply_bytes);
        decode_reply(&request, framing, &next(&mut codec, &mut received).data).unwrap()
    };
    assert_eq!(exchange(), values);
    assert_eq!(allocations(|| assert!(exchange() == values)), FRAMES, "{framing}: the values of each exchange");

    // PLC: the same in the other direction. It has the values, so it allocates nothing.
    let (mut sent, mut received, mut codec) = (BytesMut::new(), BytesMut::new(), Codec::new(framing, Side::Plc));
    let mut exchange = || {
        received.extend_from_slice(&request_bytes);
        let frame = next(&mut codec, &mut received);
        sent.clear();
        encode_reply(&request, Ok(&values), framing, frame.station, &mut sent);
        assert!(sent == reply_bytes);
    };
    exchange();
    assert_eq!(allocations(exchange), 0, "{framing}: replies of a PLC");
}

/// Encodes and decodes single frames.
fn check_frames(framing: Framing, bytes: &Bytes, receiver: Side, sender: Side) {
    let (mut buffer, mut codec) = (BytesMut::new(), Codec::new(framing, receiver));
    let mut decode = || {
        buffer.extend_from_slice(bytes);
        next(&mut codec, &mut buffer)
    };
    let frame = decode();
    decode();
    assert!(frame == decode(), "the first frame is still held, so the buffer is another one");
    assert_eq!(allocations(|| assert!(decode() == frame)), 0, "{framing}: decoding {} bytes", bytes.len());

    let (mut buffer, mut codec) = (BytesMut::new(), Codec::new(framing, sender));
    let mut encode = || {
        buffer.clear();
        codec.encode(&frame, &mut buffer).unwrap();
        assert!(buffer == bytes);
    };
    encode();
    assert_eq!(allocations(encode), 0, "{framing}: encoding {} bytes", bytes.len());
}

/// Decodes a frame in pieces of seven bytes.
fn check_pieces(framing: Framing, bytes: &Bytes, receiver: Side) {
    let (mut buffer, mut codec) = (BytesMut::new(), Codec::new(framing, receiver));
    let mut decode = || {
        let mut pieces = bytes.chunks(7).peekable();
        while let Some(piece) = pieces.next() {
            buffer.extend_from_slice(piece);
            if pieces.peek().is_some() {
                assert!(codec.decode(&mut buffer).unwrap().is_none());
            }
        }
        next(&mut codec, &mut buffer)
    };
    (0..10).for_each(|_| drop(decode()));
    assert_eq!(allocations(|| drop(decode())), 0, "{framing}: decoding {} bytes in pieces", bytes.len());
}

/// Decodes consecutive frames with `FramedRead`, whose buffer ends within a frame.
fn check_stream(framing: Framing, bytes: &Bytes, receiver: Side) {
    let all = bytes.repeat(2 * FRAMES as usize);
    let mut stream = FramedRead::new(&all[..], Codec::new(framing, receiver));
    let mut decode = || match stream.next().now_or_never() {
        Some(Some(Ok(Received::Frame(_)))) => {}
        other => panic!("{other:?}"),
    };
    (0..FRAMES).for_each(|_| decode());
    assert_eq!(allocations(decode), 0, "{framing}: a stream of {} bytes each", bytes.len());
}

/// Decodes noise, which is returned as discarded bytes.
fn check_noise(framing: Framing, bytes: &Bytes, receiver: Side) {
    let mut bad = BytesMut::from(&bytes[..]);
    *bad.iter_mut().rev().nth(4).unwrap() ^= 1;
    let (mut buffer, mut codec) = (BytesMut::new(), Codec::new(framing, receiver));
    let mut decode = || {
        buffer.extend_from_slice(b"noise");
        buffer.extend_from_slice(&bad);
        let mut reasons = [None; 8];
        for place in &mut reasons {
            *place = codec.decode(&mut buffer).unwrap().map(|item| match item {
                Received::Discarded { reason, .. } => reason,
                other => panic!("{other:?}"),
            });
        }
        assert!(reasons[0] == Some(Discard::Garbage) && reasons[1] == Some(Discard::BadChecksum), "{reasons:?}");
        assert!(buffer.is_empty());
    };
    decode();
    assert_eq!(allocations(decode), 0, "{framing}: noise around {} bytes", bytes.len());
}

/// Number of allocations in [`FRAMES`] repetitions.
fn allocations(mut work: impl FnMut()) -> u64 {
    let before = dhat::HeapStats::get().total_blocks;
    (0..FRAMES).for_each(|_| work());
    dhat::HeapStats::get().total_blocks - before
}

fn encoded(encode: impl FnOnce(&mut BytesMut)) -> Bytes {
    let mut dst = BytesMut::new();
    encode(&mut dst);
    dst.freeze()
}

fn next(codec: &mut Codec, buffer: &mut BytesMut) -> Frame {
    codec.decode(buffer).unwrap().and_then(Received::frame).unwrap()
}
