//! Replay without libFuzzer: the corpus, the seeds, and the dictionaries.

use std::fs;
use std::path::{Path, PathBuf};

use fatek_fuzz::{TARGETS, Target, dictionary};

#[test]
fn every_input_of_the_corpus_passes() {
    for target in TARGETS {
        let kept = inputs(target);
        assert!(!kept.is_empty(), "{} has no corpus", target.name);
        for file in kept {
            // Printed first, because a panic does not name the file.
            println!("{}", file.display());
            (target.run)(&fs::read(file).unwrap());
        }
    }
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

fn inputs(target: &Target) -> Vec<PathBuf> {
    let directory = root().join("corpus").join(target.name);
    let mut files: Vec<PathBuf> = fs::read_dir(directory).unwrap().map(|file| file.unwrap().path()).collect();
    files.sort();
    files
}

fn name(path: &Path) -> String {
    path.file_name().unwrap().to_string_lossy().into_owned()
}

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}
