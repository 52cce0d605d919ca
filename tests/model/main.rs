//! Tests the link against a model of what a link may do. A random sequence of steps drives the
//! link, its callers and the line in paused time; the model checks each event.
//!
//! | module | content |
//! |---|---|
//! | `spec` | the rules, and the state that they need |
//! | `state` | events and terms of the rules |
//! | `decoder`, `replies` | reference decoder of frames, reference matching of replies |
//! | `oracle` | check of each result without the rules |
//! | `harness` | the link, its callers and the line |
//! | `plc` | frames of the PLC, each with a mark of its request |
//! | `calls` | requests of the callers, with all their spellings |
//! | `op`, `idle` | steps of a run; waiting until all tasks are idle |
//!
//! The oracle checks the promise itself: a value, an acknowledgement or a refusal must answer the
//! call's own request, as long as the line keeps the order of replies.
//!
//! `FATEK_MODEL_CASES=20000` runs about 20 000 cases of each framing. Seeds of earlier failures are
//! in `regressions.txt` and run first; a failure adds its seed there.
//!
//! Planted bugs, and the number of random runs until each was found, without the link's own
//! assertion of rule 2:
//!
//! | planted | runs | found by |
//! |---|---|---|
//! | no check on a new connection | 1 | request to a suspect station |
//! | a timeout is forgotten | 1 | request to a suspect station |
//! | strays are ignored | 1 | request to a suspect station |
//! | the nonce is constant | 2 | repeated nonce |
//! | a refusal is owed to its size only | 31 | oracle: reply to another request |
//! | only the received frame is owed | 53 | owed reply could match |
//! | no check where no spelling is distinct | 128 | owed reply could match |
//! | a broadcast is forgotten | 393 | owed reply could match |
//! | frames after the match are ignored | 4 | result that must be unknown |
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]

mod calls;
mod decoder;
mod harness;
mod idle;
mod op;
mod oracle;
mod plc;
#[path = "../common/reference.rs"]
mod reference;
mod replies;
mod spec;
mod state;

use fatek::wire::Framing;
use op::{CallKind, Coalesced, ConnectOutcome, Corruption, Op};
use proptest::collection::vec;
use proptest::prelude::*;
use proptest::test_runner::{FileFailurePersistence, TestRunner};

/// Cases of each framing.
const CASES: u32 = 250;
/// Maximum number of steps of a case.
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
        .run(&runs, |(framing, seed, ops)| harness::run(framing, seed, &ops).map_err(TestCaseError::fail));
    if let Err(failure) = result {
        panic!("{failure}");
    }
}

fn op() -> impl Strategy<Value = Op> {
    let kind = prop_oneof![
        6 => (0..8_u8).prop_map(CallKind::Read),
        3 => Just(CallKind::Write),
        1 => Just(CallKind::Run),
        1 => Just(CallKind::Stop),
        1 => Just(CallKind::Broadcast),
        1 => Just(CallKind::BroadcastRun),
        2 => (0..4_u8).prop_map(CallKind::Mixed),
        1 => (0..8_u8).prop_map(CallKind::Page),
    ];
    let together = prop::sample::select(vec![Coalesced::CopyFirst, Coalesced::SecondBehind, Coalesced::CopyBehind]);
    let corrupted = prop_oneof![
        (1..4_u8).prop_map(Corruption::Station),
        any::<u8>().prop_map(Corruption::Command),
        Just(Corruption::Shorter),
        Just(Corruption::Longer),
        Just(Corruption::Checksum),
        any::<u8>().prop_map(Corruption::Begun),
        Just(Corruption::Doubled),
    ];
    let outcomes =
        vec![ConnectOutcome::Accepted, ConnectOutcome::Accepted, ConnectOutcome::Refused, ConnectOutcome::Unanswered];
    // Bytes of headers and trailers are more frequent.
    let byte = prop_oneof![any::<u8>(), prop::sample::select(&b"\x02\x03\x52\x10\x55\xAA\x00"[..])];
    prop_oneof![
        8 => (1..4_u8, kind, 0..32_u8).prop_map(|(station, kind, option_bits)| Op::Call { station, kind, option_bits }),
        1 => any::<u8>().prop_map(Op::Cancel),
        12 => Just(Op::Answer { late: 0, refusal: 0 }),
        2 => (0..4_u8, 0..16_u8).prop_map(|(late, refusal)| Op::Answer { late, refusal }),
        2 => corrupted.prop_map(Op::Corrupt),
        4 => (0..2_u8).prop_map(Op::Copy),
        2 => (0..16_u8).prop_map(Op::SecondAnswer),
        1 => (1..4_u8, 0..3_u8).prop_map(|(station, refusal)| Op::LeftOver { station, refusal }),
        1 => (0..4_u8, 0..3_u8).prop_map(|(station, refusal)| Op::AnswerBroadcast { station, refusal }),
        1 => (0..16_u8).prop_map(Op::Unsupported),
        2 => together.prop_map(Op::Coalesced),
        1 => Just(Op::AnswerAndLose),
        1 => vec(byte, 1..24).prop_map(Op::Noise),
        1 => Just(Op::Release),
        1 => Just(Op::Echo),
        4 => (0..200_u16).prop_map(Op::Wait),
        1 => Just(Op::Wait(1000)),
        1 => Just(Op::Lose),
        1 => Just(Op::LoseOnWrite),
        1 => prop::sample::select(outcomes).prop_map(Op::Connecting),
    ]
}
