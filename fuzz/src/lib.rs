//! What the fuzz targets do with their input, and what must hold.
//!
//! Each module is a target: its `run` takes any bytes and panics where a promise is broken. libFuzzer calls it from
//! `targets/`, the tests replay the corpus through it. The first bytes of an input choose how the others are used, so that
//! the fuzzer can turn a whole case over by one bit; `Input` takes them off.
//!
//! Checksums and lengths would keep nearly all random bytes out. Where a choice says so, [`repair`] sets them right first.

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

/// A target: its name, what it does with an input, and the inputs it begins with.
pub struct Target {
    pub name: &'static str,
    pub run: fn(&[u8]),
    pub seeds: fn() -> Vec<Vec<u8>>,
}

/// All of them.
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
