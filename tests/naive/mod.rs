//! A naive client for comparison: it takes the next good frame for the reply.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

use std::io;
use std::time::Duration;

use bytes::BytesMut;
use fatek::Register;
use fatek::command::{ReadRegisters, encode_request};
use fatek::sim::{self, Bus};
use fatek::wire::{AsciiReader, BinaryReader, Codec, FieldReader, Framing, Side};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream};
use tokio::time::timeout;
use tokio_util::codec::Decoder;

use super::{READ_ONLY, Rng, STATIONS, word};

/// Reads registers one after the other; returns the number of wrong values.
pub(crate) async fn run(bus: Bus, framing: Framing, reads: u32) -> u32 {
    let mut rng = Rng(1);
    let mut open = sim::connector(bus, framing);
    let mut stream = None;
    let mut received = BytesMut::new();
    let mut wrong = 0;
    for _ in 0..reads {
        if stream.is_none() {
            received.clear();
            stream = open().await.ok();
        }
        let Some(line) = &mut stream else { continue };
        let station = 1 + rng.below(u64::from(STATIONS)) as u8;
        let address = rng.below(u64::from(READ_ONLY)) as u16;
        match timeout(Duration::from_millis(60), read(line, &mut received, framing, station, address)).await {
            Ok(Ok(value)) => wrong += u32::from(value != word(station, address)),
            Ok(Err(_)) => stream = None,
            Err(_) => {}
        }
    }
    wrong
}

async fn read(
    stream: &mut DuplexStream,
    received: &mut BytesMut,
    framing: Framing,
    station: u8,
    address: u16,
) -> io::Result<u16> {
    let mut request = BytesMut::new();
    encode_request(&ReadRegisters::new(Register::r(address), 1).unwrap(), framing, station, &mut request).unwrap();
    stream.write_all(&request).await?;
    let mut codec = Codec::new(framing, Side::Client);
    loop {
        if let Some(frame) = codec.decode(received)?.and_then(|item| item.frame()) {
            let value = match framing {
                Framing::Ascii => first_word(AsciiReader::new(&frame.data)),
                _ => first_word(BinaryReader::new(&frame.data)),
            };
            return Ok(value.unwrap_or_default());
        }
        if stream.read_buf(received).await? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
    }
}

fn first_word(mut fields: impl FieldReader) -> Option<u16> {
    fields.code().ok()?;
    fields.word().ok()
}
