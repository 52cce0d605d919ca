//! Replay without libFuzzer: the corpus, inputs that once failed, the seeds, and the dictionaries.

use std::fs;
use std::path::{Path, PathBuf};

use fatek_fuzz::{TARGETS, Target, dictionary};

#[test]
fn every_input_of_the_corpus_passes() {
    for target in TARGETS {
        let inputs = packed("corpus", target.name);
        assert!(!inputs.is_empty(), "{} has no corpus", target.name);
        assert!(inputs.is_sorted_by(|a, b| a < b), "{}: inputs are sorted, each stands once", target.name);
        inputs.iter().for_each(|line| replay(target, line));
    }
}

#[test]
fn every_input_that_once_failed_passes() {
    let mut replayed = 0;
    for target in TARGETS {
        let inputs = packed("findings", target.name);
        inputs.iter().for_each(|line| replay(target, line));
        replayed += usize::from(!inputs.is_empty());
    }
    let files = fs::read_dir(root().join("findings")).unwrap().count();
    assert_eq!(replayed, files, "each file of findings/ is that of a target");
}

#[test]
fn every_seed_passes() {
    for target in TARGETS {
        let seeds = (target.seeds)();
        assert!(!seeds.is_empty(), "{} has no seeds", target.name);
        seeds.iter().for_each(|seed| (target.run)(seed));
    }
}

#[test]
fn dictionaries_are_up_to_date() {
    for target in TARGETS {
        let file = root().join("dict").join(format!("{}.dict", target.name));
        let kept = fs::read_to_string(&file).unwrap_or_default();
        let current = dictionary::of(target.name);
        assert_eq!(kept, current, "{}: update it with `cargo run --example prepare`", file.display());
    }
}

#[test]
fn every_target_is_built() {
    let mut built: Vec<String> =
        fs::read_dir(root().join("targets")).unwrap().map(|file| name(&file.unwrap().path())).collect();
    built.sort();
    assert_eq!(built, TARGETS.iter().map(|target| format!("{}.rs", target.name)).collect::<Vec<_>>());
}

/// Lines of a packed file, without its comments; none if there is no such file.
fn packed(directory: &str, target: &str) -> Vec<String> {
    let text = fs::read_to_string(root().join(directory).join(format!("{target}.hex"))).unwrap_or_default();
    text.lines().filter(|line| !line.starts_with('#')).map(str::to_owned).collect()
}

fn replay(target: &Target, line: &str) {
    // Printed first, because a panic does not name the input.
    println!("{}: {line}", target.name);
    let byte = |pair: &[u8]| u8::from_str_radix(std::str::from_utf8(pair).unwrap(), 16).unwrap();
    assert!(line.len().is_multiple_of(2), "whole bytes");
    (target.run)(&line.as_bytes().chunks(2).map(byte).collect::<Vec<_>>());
}

fn name(path: &Path) -> String {
    path.file_name().unwrap().to_string_lossy().into_owned()
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}
