//! Backups and restores of a simulated PLC.
#![allow(clippy::wildcard_enum_match_arm, reason = "tests name the variants they expect")]
#![cfg(feature = "sim")]

mod bench;
mod crash;
mod duplicates;
mod lengths;
mod options;
mod refused;
mod resume;
#[path = "../common/rng.rs"]
mod rng;
#[path = "../roaming/mod.rs"]
mod roaming;
mod round_trip;
mod running;
