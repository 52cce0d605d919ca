//! The documentation: its configurations are good, and its commands are those of the program.

use std::path::{Path, PathBuf};
use std::process::Command;

const ROOT: &str = env!("CARGO_MANIFEST_DIR");

fn read(name: &str) -> String {
    std::fs::read_to_string(Path::new(ROOT).join(name)).unwrap()
}

/// The blocks of a language in a text of Markdown.
fn blocks<'t>(text: &'t str, language: &str) -> Vec<&'t str> {
    let begin = format!("\n```{language}\n");
    text.split(&begin).skip(1).map(|rest| rest.split("\n```").next().unwrap()).collect()
}

/// Runs the program in the folder of the examples.
fn fatek_bridge(arguments: &[&str]) -> (Option<i32>, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
    let output = command.args(arguments).current_dir(Path::new(ROOT).join("examples")).output().unwrap();
    let text = [output.stdout, output.stderr].concat();
    (output.status.code(), String::from_utf8(text).unwrap())
}

#[test]
fn configurations_in_the_documentation_are_good() {
    let folder = tempfile::tempdir().unwrap();
    std::fs::copy(Path::new(ROOT).join("examples/boiler.csv"), folder.path().join("boiler.csv")).unwrap();
    let mut count = 0;
    for name in ["README.md", "docs/setup.md"] {
        for block in blocks(&read(name), "toml") {
            let path: PathBuf = folder.path().join(format!("{count}.toml"));
            std::fs::write(&path, block).unwrap();
            let (status, text) = fatek_bridge(&["print-config", path.to_str().unwrap()]);
            assert_eq!(status, Some(0), "{name}: {text}");
            count += 1;
        }
    }
    assert!(count >= 2, "{count}");
}

#[test]
fn the_readme_has_the_minimal_example() {
    let example = read("examples/minimal.toml");
    let (_, body) = example.split_once("\n\n").unwrap();
    assert!(read("README.md").contains(&format!("```toml\n{body}```")), "{body}");
}

#[test]
fn commands_and_options_in_the_documentation_exist() {
    let mut count = 0;
    for name in ["README.md", "docs/setup.md", "docs/fleet.md"] {
        for line in blocks(&read(name), "sh").into_iter().flat_map(str::lines) {
            let Some(arguments) = line.strip_prefix("fatek-bridge ") else { continue };
            let words = if arguments.starts_with("fleet ") { 2 } else { 1 };
            let command: Vec<&str> = arguments.split(' ').take(words).chain(["--help"]).collect();
            let (status, help) = fatek_bridge(&command);
            assert_eq!(status, Some(0), "{line}");
            for option in arguments.split(' ').filter(|word| word.starts_with("--")) {
                assert!(help.contains(option), "{line}: {help}");
            }
            count += 1;
        }
    }
    assert!(count >= 5, "{count}");
    let (_, help) = fatek_bridge(&["--help"]);
    let documentation = read("docs/setup.md");
    for command in ["run", "check", "print-config", "import", "demo", "schema", "fleet"] {
        assert!(help.contains(&format!("\n  {command} ")), "{command}");
        assert!(documentation.contains(&format!("**`{command}")), "{command}");
    }
}

#[test]
fn help_and_documentation_name_the_same_variables() {
    let (_, help) = fatek_bridge(&["--help"]);
    let documentation = read("docs/setup.md");
    let variables = |text: &str| {
        let is_part = |c: char| c.is_ascii_uppercase() || c == '_';
        let words = text.split(|c: char| !is_part(c)).filter(|word| word.starts_with("FATEK_BRIDGE_"));
        words.map(str::to_owned).collect::<std::collections::BTreeSet<_>>()
    };
    assert_eq!(variables(&help), variables(&documentation));
    assert_eq!(variables(&help), variables(&read("src/config/environment.rs")));
    assert!(variables(&help).len() >= 6);
}
