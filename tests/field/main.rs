//! Devices and networks as they are found in the field. Each test states what the code before gave.
#![cfg(feature = "sim")]

mod connections;
mod device;
mod load;
mod runtimes;
