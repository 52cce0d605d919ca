//! Frames in noise: each is found once, and no byte is lost. The result depends neither on the noise
//! around a frame nor on how the bytes arrive.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

mod common;

use bytes::BytesMut;
use common::{Rng, Vector, decode, decode_within, drain, frame_ranges, frames, other_side, reference_ranges, vectors};
use fatek::wire::{AsciiCodec, Codec, Framing, MAX_FRAME_LEN, Received, Side};
use futures::StreamExt;
use proptest::collection::vec;
use proptest::prelude::*;
use tokio_util::codec::{Decoder, FramedRead};

/// Number of seeds for each vector; `FATEK_NOISE_SEEDS` sets another.
const SEEDS: u64 = 200;
/// Seeds that have failed on a real bug; none so far.
const FAILED_SEEDS: [u64; 0] = [];
/// Length of the noise around a vector, in bytes.
const NOISE_LEN: usize = 1024;

#[test]
fn every_vector_is_found_in_a_kibibyte_of_noise() {
    for_every_vector_and_seed(&|vector, rng| {
        let case = InNoise::new(vector, rng, white);
        let items = decode(&mut vector.codec(), case.pieces(rng));
        case.check(&items)
    });
}

#[test]
fn every_vector_is_found_in_noise_made_of_frame_fragments() {
    for_every_vector_and_seed(&|vector, rng| {
        let case = InNoise::new(vector, rng, hostile);
        let items = decode(&mut vector.codec(), case.pieces(rng));
        case.check(&items)
    });
}

/// A link cannot wait for the end of the input: after each silence it gives up a partial frame. The
/// vector itself has no pause.
#[test]
fn every_vector_is_found_in_noise_with_silences() {
    for_every_vector_and_seed(&|vector, rng| {
        let case = InNoise::new(vector, rng, hostile);
        let (mut codec, mut buffer, mut items) = (vector.codec(), BytesMut::new(), Vec::new());
        let (before, rest) = case.input.split_at(case.at);
        let (vector_bytes, behind) = rest.split_at(vector.bytes.len());
        for (part, pauses) in [(before, true), (vector_bytes, false), (behind, true)] {
            for piece in pieces(part, rng) {
                buffer.extend_from_slice(piece);
                drain(&mut codec, &mut buffer, &mut items);
                if pauses && rng.index(4) == 0 {
                    codec.skip_partial();
                    drain(&mut codec, &mut buffer, &mut items);
                }
            }
        }
        while !buffer.is_empty() && vector.framing == Framing::Binary {
            codec.skip_partial();
            drain(&mut codec, &mut buffer, &mut items);
        }
        items.extend(codec.decode_eof(&mut buffer).unwrap());
        let frame_ranges = frame_ranges(vector.framing, &case.input, &items)?;
        expect_once(&frame_ranges, case.at, vector.bytes.len())
    });
}

#[test]
fn all_vectors_of_a_side_are_found_in_order_between_noise() {
    for seed in 0..SEEDS {
        for (framing, sender) in
            [(Framing::Ascii, Side::Plc), (Framing::Binary, Side::Client), (Framing::Binary, Side::Plc)]
        {
            let mut rng = Rng(seed);
            let (mut input, mut expected) = (Vec::new(), Vec::new());
            for vector in vectors().into_iter().filter(|v| v.framing == framing && v.sender == sender) {
                let len = rng.index(40);
                input.extend(noise(&mut rng, framing, white, len));
                expected.push(input.len()..input.len() + vector.bytes.len());
                input.extend(vector.bytes);
            }
            let mut codec = Codec::new(framing, other_side(sender));
            let items = decode(&mut codec, pieces(&input, &mut rng));
            assert_eq!(frame_ranges(framing, &input, &items).as_ref(), Ok(&expected), "{framing} seed {seed}");
        }
    }
}

#[test]
fn a_false_header_delays_a_frame_only_until_a_silence() {
    for vector in vectors().into_iter().filter(|v| v.framing == Framing::Binary) {
        // The false header promises more bytes than come: the vector could be its payload.
        for header in
            [&b"\x52\x10\x03\xE8"[..], b"\x51\x10\x03\xE8", b"\x52\x10\x03\xE8\x52\x10\x03\xE0\x51\x10\x01\x00"]
        {
            let (mut codec, mut items) = (vector.codec(), Vec::new());
            let mut buffer = BytesMut::from(&[header, &vector.bytes].concat()[..]);
            drain(&mut codec, &mut buffer, &mut items);
            assert!(items.is_empty(), "{}", vector.row);
            for _ in 0..header.len() / 4 {
                codec.skip_partial();
                drain(&mut codec, &mut buffer, &mut items);
            }
            assert!(buffer.is_empty(), "{}", vector.row);
            assert_eq!(frames(items), [vector.frame()], "{}", vector.row);
        }
    }
}

#[test]
fn skipping_nothing_does_not_lose_the_next_frame() {
    for vector in vectors() {
        for piece_len in [1, 2, 5, vector.bytes.len()] {
            let (mut codec, mut buffer, mut items) = (vector.codec(), BytesMut::new(), Vec::new());
            drain(&mut codec, &mut buffer, &mut items);
            codec.skip_partial();
            for piece in vector.bytes.chunks(piece_len) {
                buffer.extend_from_slice(piece);
                drain(&mut codec, &mut buffer, &mut items);
            }
            assert_eq!(items, [Received::Frame(vector.frame())], "{} in pieces of {piece_len}", vector.row);
        }
    }
}

#[test]
fn skipping_a_partial_frame_keeps_a_complete_one() {
    for vector in vectors() {
        let (mut codec, mut items) = (vector.codec(), Vec::new());
        let mut buffer = BytesMut::from(&vector.bytes[..]);
        codec.skip_partial();
        drain(&mut codec, &mut buffer, &mut items);
        assert_eq!(items, [Received::Frame(vector.frame())], "{}", vector.row);
    }
}

/// `FramedRead` ends its stream after an error, so noise must not be one, even at the end of the
/// input.
#[tokio::test]
async fn a_framed_stream_survives_noise() {
    for framing in common::FRAMINGS {
        let mut rng = Rng(7);
        let sent: Vec<Vector> =
            vectors().into_iter().filter(|v| v.framing == framing && v.sender == Side::Plc).collect();
        let mut input = Vec::new();
        for vector in &sent {
            input.extend(noise(&mut rng, framing, hostile, 100));
            input.extend(&vector.bytes);
        }
        input.extend(noise(&mut rng, framing, hostile, 100));
        let stream = FramedRead::with_capacity(&input[..], Codec::new(framing, Side::Client), 16);
        let items: Vec<Received> = stream.map(|item| item.expect("noise is no error")).collect().await;
        assert_eq!(frame_ranges(framing, &input, &items).map(|ranges| ranges.len()), Ok(sent.len()));
        let expected: Vec<_> = sent.iter().map(Vector::frame).collect();
        assert_eq!(frames(items), expected);
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..ProptestConfig::default() })]

    /// The frames are those of the reference decoder, which sees the whole input at once.
    #[test]
    fn frames_do_not_depend_on_how_the_bytes_arrive(
        input in vec(fragment(), 0..120).prop_map(|fragments| fragments.concat()),
        seed: u64,
        max in prop_oneof![Just(MAX_FRAME_LEN), 8_usize..100],
    ) {
        for (framing, receiver) in
            [(Framing::Ascii, Side::Client), (Framing::Binary, Side::Client), (Framing::Binary, Side::Plc)]
        {
            let expected = Ok(reference_ranges(framing, receiver, &input, max));
            for all_pieces in [vec![&input[..]], input.chunks(1).collect(), pieces(&input, &mut Rng(seed))] {
                let items = decode_within(max, &mut limited(framing, receiver, max), all_pieces);
                prop_assert_eq!(&frame_ranges(framing, &input, &items), &expected);
            }
        }
    }

    #[test]
    fn pure_noise_of_any_length_is_bounded_and_counted(input in vec(any::<u8>(), 0..5000), seed: u64) {
        for framing in common::FRAMINGS {
            let items = decode(&mut Codec::new(framing, Side::Client), pieces(&input, &mut Rng(seed)));
            prop_assert!(frame_ranges(framing, &input, &items).is_ok());
        }
    }
}

/// Bytes, fragments of frames, and whole frames.
fn fragment() -> impl Strategy<Value = Vec<u8>> {
    let marks = prop::sample::select(vec![2, 3, 0x51, 0x52, 0x10, 0x55, 0xAA, 0x00, 0xFF, b'0', b'F', b'f']);
    let headers: Vec<&[u8]> =
        vec![b"\x51\x10", b"\x52\x10\x00", b"\x52\x10\x00\x04", b"\x52\x10\xFF\xFF", b"\x55\xAA", b"\x020146"];
    let whole = prop::sample::select(vectors().into_iter().map(|v| v.bytes).collect::<Vec<_>>());
    prop_oneof![
        6 => marks.prop_map(|mark| vec![mark]),
        3 => any::<u8>().prop_map(|byte| vec![byte]),
        3 => prop::sample::select(headers).prop_map(<[u8]>::to_vec),
        1 => whole.clone(),
        1 => (whole, any::<prop::sample::Index>()).prop_map(|(frame, cut)| frame[..cut.index(frame.len())].to_vec()),
    ]
}

fn limited(framing: Framing, receiver: Side, max: usize) -> Codec {
    match Codec::new(framing, receiver) {
        Codec::Binary(codec) => Codec::Binary(codec.max_frame_len(max)),
        _ => Codec::Ascii(AsciiCodec::new().max_frame_len(max)),
    }
}

/// Runs a case for every vector and seed, and reports all failures.
fn for_every_vector_and_seed(case: &dyn Fn(&Vector, &mut Rng) -> Result<(), String>) {
    let seeds = std::env::var("FATEK_NOISE_SEEDS").map_or(SEEDS, |n| n.parse().expect("a number of seeds"));
    let mut failures = Vec::new();
    for vector in vectors() {
        for seed in FAILED_SEEDS.into_iter().chain(0..seeds) {
            if let Err(reason) = case(&vector, &mut Rng(seed)) {
                failures.push(format!("seed {seed}: {reason}: {}", vector.row));
            }
        }
    }
    assert!(failures.is_empty(), "{} failed:\n{}", failures.len(), failures.join("\n"));
}

/// A vector within noise.
struct InNoise<'a> {
    vector: &'a Vector,
    input: Vec<u8>,
    /// Position of the vector.
    at: usize,
}

impl<'a> InNoise<'a> {
    fn new(vector: &'a Vector, rng: &mut Rng, kind: NoiseKind) -> Self {
        let mut input = noise(rng, vector.framing, kind, NOISE_LEN);
        let at = rng.index(NOISE_LEN + 1);
        input.splice(at..at, vector.bytes.iter().copied());
        Self { vector, input, at }
    }

    fn pieces(&self, rng: &mut Rng) -> Vec<&[u8]> {
        pieces(&self.input, rng)
    }

    /// Checks that the vector and every byte came out once and in place, and that all other frames
    /// are those that the noise contains by chance.
    fn check(&self, items: &[Received]) -> Result<(), String> {
        let Vector { framing, sender, bytes, .. } = self.vector;
        let frame_ranges = frame_ranges(*framing, &self.input, items)?;
        expect_once(&frame_ranges, self.at, bytes.len())?;
        let expected = reference_ranges(*framing, other_side(*sender), &self.input, MAX_FRAME_LEN);
        if frame_ranges == expected { Ok(()) } else { Err(format!("{frame_ranges:?} instead of {expected:?}")) }
    }
}

fn expect_once(frame_ranges: &[std::ops::Range<usize>], at: usize, len: usize) -> Result<(), String> {
    match frame_ranges.iter().filter(|place| place.start < at + len && at < place.end).collect::<Vec<_>>()[..] {
        [place] if *place == (at..at + len) => Ok(()),
        ref other => Err(format!("{other:?} instead of {:?}", at..at + len)),
    }
}

type NoiseKind = fn(&mut Rng, Framing) -> u8;

fn noise(rng: &mut Rng, framing: Framing, kind: NoiseKind, len: usize) -> Vec<u8> {
    (0..len).map(|_| kind(rng, framing)).collect()
}

/// Uniformly random bytes.
fn white(rng: &mut Rng, _framing: Framing) -> u8 {
    rng.next().to_le_bytes()[0]
}

/// Mostly bytes of headers and trailers.
fn hostile(rng: &mut Rng, framing: Framing) -> u8 {
    match (rng.index(8), framing) {
        (0, _) => white(rng, framing),
        (_, Framing::Ascii) => rng.pick(b"\x02\x03\x02\x030123456789ABCDEFabcdef"),
        _ => rng.pick(b"\x51\x52\x51\x52\x10\x10\x10\x00\x00\x01\x03\x55\xAA"),
    }
}

/// Cuts the input into pieces of random lengths, with a random mean.
fn pieces<'a>(mut input: &'a [u8], rng: &mut Rng) -> Vec<&'a [u8]> {
    let longest = rng.pick(&[1, 3, 16, 200, 2000]);
    let mut pieces = Vec::new();
    while !input.is_empty() {
        let (piece, rest) = input.split_at(input.len().min(1 + rng.index(longest)));
        pieces.push(piece);
        input = rest;
    }
    pieces
}
