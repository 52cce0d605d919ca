//! Whole programs through the link and the simulated PLC, in paused time: under faults, with a crash at every page, with others
//! at work on the same PLC. `FATEK_SEEDS=n` runs so many seeds, `FATEK_SEED=n` one.
#![cfg(feature = "sim")]

mod bench;
mod crash;
mod duplicates;
mod others;
mod regressions;
#[path = "../roaming/mod.rs"]
mod roaming;
mod round_trip;
