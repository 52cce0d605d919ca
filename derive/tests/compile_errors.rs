//! Faults that `cargo check` finds: each file of `tests/ui` is checked as a program of its own, without its
//! comments. A comment `//~ TEXT` is the text of an error that the compiler must print for that line; a
//! file without one must be accepted.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::{env, fs};

/// A package with the cases as programs, in the directory for temporary files of tests.
fn package(cases: &[PathBuf]) -> PathBuf {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
    let package = Path::new(env!("CARGO_TARGET_TMPDIR")).join("compile_errors");
    let _ = fs::remove_dir_all(&package);
    let programs = package.join("src/bin");
    fs::create_dir_all(&programs).unwrap();
    let fatek = root.canonicalize().unwrap();
    let manifest = format!(
        "[package]\nname = \"cases\"\nversion = \"0.0.0\"\nedition = \"2024\"\n[dependencies]\n\
         fatek = {{ path = {fatek:?}, default-features = false, features = [\"derive\"] }}\n[workspace]\n"
    );
    fs::write(package.join("Cargo.toml"), manifest).unwrap();
    // The versions that are built here anyway, so that nothing is downloaded.
    fs::copy(root.join("Cargo.lock"), package.join("Cargo.lock")).unwrap();
    for case in cases {
        // The compiler quotes lines: their comments must not be taken for its errors.
        let source = fs::read_to_string(case).unwrap();
        let lines: Vec<&str> = source.lines().map(|line| line.split("//~").next().unwrap_or_default()).collect();
        fs::write(programs.join(case.file_name().unwrap()), lines.join("\n")).unwrap();
    }
    package
}

#[test]
fn faults_of_tags_are_found_by_cargo_check() {
    let ui = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ui");
    let mut cases: Vec<PathBuf> = fs::read_dir(ui).unwrap().map(|entry| entry.unwrap().path()).collect();
    cases.sort();
    assert!(cases.len() > 10, "{cases:?}");
    let package = package(&cases);
    let mut wrong = Vec::new();
    for case in &cases {
        let name = case.file_stem().unwrap().to_str().unwrap();
        let checked = Command::new(env!("CARGO"))
            .args(["check", "--offline", "--quiet", "--message-format", "short", "--bin", name])
            .current_dir(&package)
            .env("CARGO_TARGET_DIR", package.join("target"))
            .output()
            .unwrap();
        let printed = String::from_utf8_lossy(&checked.stderr).into_owned();
        let source = fs::read_to_string(case).unwrap();
        let comments = source.lines().zip(1..).filter_map(|(line, n)| Some((n, line.split_once("//~ ")?.1.trim())));
        let is_printed = |(n, text): &(usize, &str)| {
            let place = format!("{name}.rs:{n}:");
            printed.lines().any(|line| line.contains(&place) && line.contains("error") && line.contains(text))
        };
        let (expected, missing): (Vec<_>, Vec<_>) = comments.partition(is_printed);
        let errors =
            printed.lines().filter(|line| line.contains(&format!("{name}.rs:")) && line.contains(": error")).count();
        let is_accepted = expected.is_empty() && missing.is_empty();
        if checked.status.success() != is_accepted || !missing.is_empty() || errors < expected.len() {
            wrong.push(format!("{name}: {}, missing: {missing:?}\n{printed}", checked.status));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}
