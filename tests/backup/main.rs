//! Backing up and restoring a simulated PLC.
#![cfg(feature = "sim")]

mod bench;
mod crash;
mod options;
mod refused;
mod resume;
mod round_trip;
mod running;
