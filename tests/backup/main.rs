//! Backing up and restoring a simulated PLC.
#![cfg(feature = "sim")]

mod bench;
mod crash;
mod duplicates;
mod options;
mod refused;
mod resume;
mod round_trip;
mod running;
#[path = "../roaming/mod.rs"]
mod roaming;
