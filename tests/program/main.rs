//! Whole programs over the link to a simulated PLC, in paused time: faults, crashes at every page,
//! other users of the PLC.
//!
//! `FATEK_SEEDS=n` sets the number of seeds, `FATEK_SEED=n` runs one.
#![cfg(feature = "sim")]

mod bench;
mod crash;
mod duplicates;
mod interference;
mod real_end;
mod regressions;
#[path = "../roaming/mod.rs"]
mod roaming;
mod round_trip;
