//! Fuzz targets and their invariants.
//!
//! Each public module with a `run` is a target: `run` takes any bytes and panics if an invariant is
//! broken. libFuzzer calls it from `targets/`, the tests replay the corpus through it. The first
//! bytes of an input are flags, read by `Input`, so that the fuzzer can change the whole case by
//! one bit.
//!
//! Checksums and lengths reject nearly all random bytes. One of the flags corrects them first, by
//! [`repair`].

pub mod ascii;
pub mod backup_file;
pub mod binary;
mod codec;
pub mod dictionary;
pub mod element;
pub mod endpoint;
mod input;
pub mod link;
pub mod program_file;
#[path = "../../tests/common/reference.rs"]
mod reference;
pub mod repair;
pub mod reply;
pub mod request;
mod saved;
pub mod seeds;
pub mod tag;
mod text;

/// Target: its name, its function, and its first inputs.
pub struct Target {
    pub name: &'static str,
    pub run: fn(&[u8]),
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All targets.
pub const TARGETS: &[Target] = &[
    Target { name: "ascii", run: ascii::run, seeds: seeds::ascii },
    Target { name: "backup_file", run: backup_file::run, seeds: seeds::backup_file },
    Target { name: "binary", run: binary::run, seeds: seeds::binary },
    Target { name: "element", run: element::run, seeds: seeds::element },
    Target { name: "endpoint", run: endpoint::run, seeds: seeds::endpoint },
    Target { name: "link", run: link::run, seeds: seeds::link },
    Target { name: "program_file", run: program_file::run, seeds: seeds::program_file },
    Target { name: "reply", run: reply::run, seeds: seeds::reply },
    Target { name: "request", run: request::run, seeds: seeds::request },
    Target { name: "tag", run: tag::run, seeds: seeds::tag },
];
