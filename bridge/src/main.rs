//! `fatek-bridge`, the program: see the library.

mod cli;
mod columns;
#[path = "../../src/printable.rs"]
#[allow(dead_code, reason = "the library shows excerpts, and the program whole texts")]
mod printable;

use std::process::ExitCode;

fn main() -> ExitCode {
    cli::main()
}
