//! Writes the dictionaries: `cargo run --example prepare`.
//!
//! With `seeds DIR` it writes the seeds of all targets, each to a directory of its own.

use std::error::Error;
use std::fs;
use std::path::Path;

use fatek_fuzz::{TARGETS, dictionary};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match &arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [] => {
            for target in TARGETS {
                let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("dict").join(format!("{}.dict", target.name));
                fs::write(file, dictionary::of(target.name))?;
            }
        }
        ["seeds", dir] => {
            for target in TARGETS {
                let dir = Path::new(dir).join(target.name);
                fs::create_dir_all(&dir)?;
                for (number, seed) in (target.seeds)().into_iter().enumerate() {
                    fs::write(dir.join(format!("seed-{number}")), seed)?;
                }
            }
        }
        _ => return Err("usage: prepare [seeds DIR]".into()),
    }
    Ok(())
}
