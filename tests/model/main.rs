//! The link against a small model of what a link may do: `spec` has the rules, `state` the terms, `ear` recognises frames,
//! `fit` replies; `world` is a link with its callers and the other end of the line, `plc` makes that end's frames, `wanted`
//! the callers' requests; `op` has the steps of a run, `rest` waits until all is done at a time.
//!
//! `witness` checks the promise without the rules: each frame bears a mark of the request that it answers, so a value, an
//! acknowledgement or a refusal must be that of the call's own request, as long as the line keeps the order of replies.
//!
//! `FATEK_MODEL_CASES=20000` has about 20 000 runs of each framing. Every run that has failed is in `regressions.txt` and is
//! repeated first; a failure adds its seed there.
//!
//! Planted bugs, and after how many runs of random steps they were found, without the assertion of rule 2 in the link:
//!
//! | planted | runs | found by |
//! |---|---|---|
//! | a new connection is trusted | 1 | suspect station is asked |
//! | a timeout is forgotten | 1 | suspect station is asked |
//! | strays are ignored | 1 | suspect station is asked |
//! | the nonce is constant | 2 | nonce was used before |
//! | a refusal is owed to its size only | 31 | witness: refusal of another request |
//! | only the received frame is owed | 53 | owed reply could answer |
//! | no check where no spelling is distinct | 128 | owed reply could answer |
//! | a broadcast is forgotten | 393 | owed reply could answer |
//! | frames behind the match are ignored | 4 | result that must be unknown |
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

#[path = "../common/book.rs"]
mod book;
mod ear;
mod fit;
mod op;
mod plc;
mod rest;
mod spec;
mod state;
mod wanted;
mod witness;
mod world;

use fatek::wire::Framing;
use op::{Connecting, Kind, Op, Spoilt, Together};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::{FileFailurePersistence, TestRunner};

/// How many runs there are of each framing.
const CASES: u32 = 250;
/// How long the longest is.
const STEPS: usize = 80;

#[test]
fn the_link_does_what_the_model_allows_and_nothing_else() {
    let cases = std::env::var("FATEK_MODEL_CASES").map_or(CASES, |cases| cases.parse().expect("a number of cases"));
    let kept = FileFailurePersistence::Direct(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/model/regressions.txt"));
    let config = ProptestConfig {
        cases: 2 * cases,
        failure_persistence: Some(Box::new(kept)),
        max_shrink_iters: 20_000,
        source_file: Some(file!()),
        ..ProptestConfig::default()
    };
    let runs = (prop::sample::select(vec![Framing::Ascii, Framing::Binary]), any::<u64>(), vec(op(), 1..STEPS));
    let result = TestRunner::new(config)
        .run(&runs, |(framing, seed, ops)| world::run(framing, seed, &ops).map_err(TestCaseError::fail));
    if let Err(failure) = result {
        panic!("{failure}");
    }
}

fn op() -> impl Strategy<Value = Op> {
    let kind = prop_oneof![
        6 => (0..8_u8).prop_map(Kind::Read),
        3 => Just(Kind::Write),
        1 => Just(Kind::Run),
        1 => Just(Kind::Stop),
        1 => Just(Kind::Broadcast),
        1 => Just(Kind::BroadcastRun),
        2 => (0..4_u8).prop_map(Kind::Mixed),
        1 => (0..8_u8).prop_map(Kind::Page),
    ];
    let together = prop::sample::select(vec![Together::CopyFirst, Together::SecondBehind, Together::CopyBehind]);
    let spoilt = prop_oneof![
        (1..4_u8).prop_map(Spoilt::Station),
        any::<u8>().prop_map(Spoilt::Command),
        Just(Spoilt::Shorter),
        Just(Spoilt::Longer),
        Just(Spoilt::Checksum),
        any::<u8>().prop_map(Spoilt::Begun),
        Just(Spoilt::Doubled),
    ];
    // What frames begin and end with, more often than chance has it.
    let byte = prop_oneof![any::<u8>(), prop::sample::select(&b"\x02\x03\x52\x10\x55\xAA\x00"[..])];
    prop_oneof![
        8 => (1..4_u8, kind, 0..32_u8).prop_map(|(station, kind, patience)| Op::Call { station, kind, patience }),
        1 => any::<u8>().prop_map(Op::Cancel),
        12 => Just(Op::Answer { late: 0, refusal: 0 }),
        2 => (0..4_u8, 0..16_u8).prop_map(|(late, refusal)| Op::Answer { late, refusal }),
        2 => spoilt.prop_map(Op::Spoilt),
        4 => (0..2_u8).prop_map(Op::Copy),
        2 => (0..16_u8).prop_map(Op::Second),
        1 => (1..4_u8, 0..3_u8).prop_map(|(station, refusal)| Op::LeftOver { station, refusal }),
        1 => (0..4_u8, 0..3_u8).prop_map(|(station, refusal)| Op::Broadcasted { station, refusal }),
        1 => (0..16_u8).prop_map(Op::Lacks),
        2 => together.prop_map(Op::Together),
        1 => Just(Op::AnswerAndLose),
        1 => vec(byte, 1..24).prop_map(Op::Noise),
        1 => Just(Op::Rest),
        1 => Just(Op::Echo),
        4 => (0..200_u16).prop_map(Op::Wait),
        1 => Just(Op::Wait(1000)),
        1 => Just(Op::Lose),
        1 => Just(Op::LoseOnWrite),
        1 => prop::sample::select(vec![Connecting::Accepted, Connecting::Accepted, Connecting::Refused, Connecting::Unanswered])
            .prop_map(Op::Connecting),
    ]
}
