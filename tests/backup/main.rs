//! Backing up and restoring a simulated PLC.
#![cfg(feature = "sim")]

mod bench;
mod crash;
mod duplicates;
mod options;
mod refused;
mod resume;
#[path = "../roaming/mod.rs"]
mod roaming;
mod round_trip;
mod running;
