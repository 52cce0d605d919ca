//! Cases of the benchmark: the frames of two reads in both framings, and the jobs done with them.

use std::hint::black_box;

use bytes::BytesMut;
use fatek::command::{
    Command, MAX_POINTS, MAX_UNITS, ReadDiscretes, ReadRegisters, decode_reply, encode_reply, encode_request,
};
use fatek::wire::{Codec, Frame, Framing, Side};
use fatek::{Register, discrete, register};
use tokio_util::codec::{Decoder, Encoder};

use crate::limit;

/// One job with one frame.
pub(crate) struct Case {
    framing: Framing,
    read: Read,
    /// Sender of the frame: the client of a request, the PLC of a reply.
    sender: Side,
    pub(crate) job: Job,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Read {
    /// 64 registers, the limit of a request.
    Registers,
    /// 256 discretes, the limit of a request.
    Discretes,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Job {
    /// From a [`Frame`] to bytes.
    Encode,
    /// From bytes, copied into the receive buffer, to a [`Frame`].
    Decode,
    /// Work of a client: from a command to bytes, or from the bytes of a reply to values.
    Client,
    /// Copy and checksum of the bytes.
    Limit,
    /// Copy and checksum of the bytes, and decoding of the values.
    LimitOfValues,
}

impl Job {
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Encode => "encode",
            Self::Decode => "decode",
            Self::Client => "client",
            Self::Limit => "limit",
            Self::LimitOfValues => "limit-of-values",
        }
    }
}

/// Size of the buffers, as in a link.
const BUFFER: usize = 1024;
const STATION: u8 = 1;
const FIRST: Register = register!("R1000");

impl Case {
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        let frames = [Framing::Ascii, Framing::Binary].into_iter().flat_map(|framing| {
            [Read::Registers, Read::Discretes]
                .into_iter()
                .flat_map(move |read| [Side::Client, Side::Plc].map(|sender| (framing, read, sender)))
        });
        let jobs = [Job::Encode, Job::Limit, Job::Decode, Job::Client, Job::LimitOfValues];
        frames
            .flat_map(move |(framing, read, sender)| jobs.map(|job| Self { framing, read, sender, job }))
            .filter(|case| case.job != Job::LimitOfValues || case.sender == Side::Plc)
    }

    /// Name of the frame.
    pub(crate) fn group(&self) -> String {
        let read = match self.read {
            Read::Registers => "64-registers",
            Read::Discretes => "256-discretes",
        };
        let frame = if self.sender == Side::Client { "request" } else { "reply" };
        format!("{}/{read}-{frame}", self.framing)
    }

    /// Length of the frame.
    pub(crate) fn bytes(&self) -> u64 {
        self.frame_bytes().len() as u64
    }

    /// Work to measure, with warm buffers and a checked result.
    pub(crate) fn work(&self) -> Box<dyn FnMut()> {
        let framing = self.framing;
        let bytes = self.frame_bytes();
        let receiver = if self.sender == Side::Client { Side::Plc } else { Side::Client };
        let mut codec = Codec::new(framing, receiver);
        let mut buffer = BytesMut::with_capacity(BUFFER);
        let mut copy = vec![0; bytes.len()];
        match (self.job, self.sender, self.read) {
            (Job::Encode, sender, _) => {
                let mut codec_of_sender = Codec::new(framing, sender);
                let frame = decode(&mut codec, &mut BytesMut::new(), &bytes);
                assert_eq!(encode(&mut codec_of_sender, &mut buffer, &frame), bytes);
                Box::new(move || {
                    black_box(encode(&mut codec_of_sender, &mut buffer, black_box(&frame)));
                })
            }
            (Job::Decode, ..) => Box::new(move || {
                black_box(decode(&mut codec, &mut buffer, black_box(&bytes)));
            }),
            (Job::Client, Side::Client, Read::Registers) => {
                let command = registers();
                Box::new(move || {
                    black_box(request(black_box(&command), framing, &mut buffer));
                })
            }
            (Job::Client, Side::Client, Read::Discretes) => {
                let command = discretes();
                Box::new(move || {
                    black_box(request(black_box(&command), framing, &mut buffer));
                })
            }
            (Job::Client, Side::Plc, Read::Registers) => {
                let mut reply = reply(registers(), codec, buffer, bytes);
                assert_eq!(reply(), words());
                Box::new(move || drop(black_box(reply())))
            }
            (Job::Client, Side::Plc, Read::Discretes) => {
                let mut reply = reply(discretes(), codec, buffer, bytes);
                assert_eq!(reply(), states());
                Box::new(move || drop(black_box(reply())))
            }
            (Job::Limit, ..) => Box::new(move || {
                assert!(limit::copy_and_check(framing, black_box(&bytes), &mut copy));
                black_box(&copy);
            }),
            (Job::LimitOfValues, _, Read::Registers) => {
                let mut values = [0; MAX_UNITS];
                assert!(limit::registers(framing, &bytes, &mut values) && values == words());
                Box::new(move || {
                    assert!(limit::copy_and_check(framing, black_box(&bytes), &mut copy));
                    assert!(limit::registers(framing, black_box(&copy), &mut values));
                    black_box(&values);
                })
            }
            (Job::LimitOfValues, _, Read::Discretes) => {
                let mut values = [false; MAX_POINTS];
                assert!(limit::discretes(framing, &bytes, &mut values) && values == states());
                Box::new(move || {
                    assert!(limit::copy_and_check(framing, black_box(&bytes), &mut copy));
                    assert!(limit::discretes(framing, black_box(&copy), &mut values));
                    black_box(&values);
                })
            }
        }
    }

    fn frame_bytes(&self) -> Vec<u8> {
        let (framing, mut bytes) = (self.framing, BytesMut::new());
        match (self.read, self.sender) {
            (Read::Registers, Side::Client) => return request(&registers(), framing, &mut bytes).into(),
            (Read::Discretes, Side::Client) => return request(&discretes(), framing, &mut bytes).into(),
            (Read::Registers, Side::Plc) => {
                encode_reply(&registers(), Ok(&words().into()), framing, STATION, &mut bytes);
            }
            (Read::Discretes, Side::Plc) => {
                encode_reply(&discretes(), Ok(&states().into()), framing, STATION, &mut bytes);
            }
        }
        bytes.into()
    }
}

fn encode<'a>(codec: &mut Codec, buffer: &'a mut BytesMut, frame: &Frame) -> &'a [u8] {
    buffer.clear();
    codec.encode(frame, buffer).expect("a good frame");
    buffer
}

fn decode(codec: &mut Codec, buffer: &mut BytesMut, bytes: &[u8]) -> Frame {
    buffer.extend_from_slice(bytes);
    let item = codec.decode(buffer).expect("no error");
    item.and_then(|item| item.frame()).expect("a good frame")
}

fn request<'a>(command: &impl Command, framing: Framing, buffer: &'a mut BytesMut) -> &'a [u8] {
    buffer.clear();
    encode_request(command, framing, STATION, buffer).expect("a good request");
    buffer
}

fn reply<C: Command>(command: C, mut codec: Codec, mut buffer: BytesMut, bytes: Vec<u8>) -> impl FnMut() -> C::Reply {
    move || {
        let frame = decode(&mut codec, &mut buffer, black_box(&bytes));
        decode_reply(black_box(&command), codec.framing(), &frame.data).expect("a good reply")
    }
}

fn registers() -> ReadRegisters<Register> {
    ReadRegisters::new(FIRST, MAX_UNITS).expect("a good request")
}

fn discretes() -> ReadDiscretes {
    ReadDiscretes::new(discrete!("M100"), MAX_POINTS).expect("a good request")
}

/// Register values with all hexadecimal digits.
fn words() -> [u16; MAX_UNITS] {
    std::array::from_fn(|n| (n as u16).wrapping_mul(0x9E37))
}

/// States of the discretes.
fn states() -> [bool; MAX_POINTS] {
    std::array::from_fn(|n| n.wrapping_mul(0x9E37) & 0x40 != 0)
}
