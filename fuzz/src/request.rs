//! Simulated PLCs.
//!
//! Invariants: each good frame to a present station has one reply, which the client accepts;
//! nothing else has a reply.

use bytes::BytesMut;
use fatek::command::Request;
use fatek::sim::{Bus, Model, Plc};
use fatek::wire::{Codec, Frame, Framing, MAX_FRAME_LEN, Received, Side};
use tokio_util::codec::Decoder;

use crate::input::{Flags, Input};
use crate::repair::repair;

/// Bits of the first byte.
const REPAIR: u8 = 0;
const BINARY: u8 = 1;

/// Stations of the PLCs on the line.
const STATIONS: [u8; 2] = [1, 2];

pub fn run(input: &[u8]) {
    let mut input = Input::new(input);
    let flags = Flags(input.byte());
    let framing = if flags.has(BINARY) { Framing::Binary } else { Framing::Ascii };
    let mut bytes = input.rest().to_vec();
    if flags.has(REPAIR) {
        repair(framing, &mut bytes);
    }
    let plc = || Plc::with_model(Model::largest());
    let bus = STATIONS.iter().fold(Bus::new(), |bus, &station| bus.with_station(station, plc()).unwrap());
    let mut codec = Codec::new(framing, Side::Plc);
    let mut received = BytesMut::from(&bytes[..]);
    while let Some(item) = codec.decode_eof(&mut received).unwrap() {
        let mut reply = BytesMut::new();
        bus.answer(&item, framing, &mut reply);
        assert!(reply.len() <= MAX_FRAME_LEN);
        match item {
            Received::Frame(frame) if STATIONS.contains(&frame.station) => is_a_reply(&frame, framing, reply),
            item => assert!(reply.is_empty(), "{item:?} has a reply"),
        }
    }
}

fn is_a_reply(request: &Frame, framing: Framing, mut reply: BytesMut) {
    let mut client = Codec::new(framing, Side::Client);
    let Some(Received::Frame(frame)) = client.decode(&mut reply).unwrap() else {
        panic!("the reply to {request:?} is not a frame");
    };
    assert!(reply.is_empty(), "more than one reply frame");
    assert_eq!((frame.station, frame.command), (request.station, request.command));
    match Request::decode(request, framing) {
        Ok(request) => crate::reply::is_a_reply(&request, &frame.data, framing),
        Err(fault) => {
            // Refused, with the error code of the fault.
            let code = u8::from(fault.error_code());
            let found = match (&frame.data[..], framing) {
                (&[code], Framing::Binary) => code,
                (&[digit], _) => char::from(digit).to_digit(16).and_then(|code| u8::try_from(code).ok()).unwrap(),
                (data, _) => panic!("bad request {request:?} ({fault}) has the reply {data:?}"),
            };
            assert_eq!(found, code);
        }
    }
}
