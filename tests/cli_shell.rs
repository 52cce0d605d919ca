//! Help, completion and man pages of the command line.
#![cfg(feature = "cli")]

mod process;

use std::process::Command;

use process::{FATEK, Folder, fatek};

#[test]
fn the_help_lists_each_command_in_a_section() {
    let ran = fatek(&["-h"]);
    let help = ran.ok();
    assert!(help.contains("\nUsage: fatek [OPTIONS] [@NAME]... <COMMAND>\n"), "{help}");
    assert!(help.contains("\nValues:\n  read         Read tags and print their values\n"), "{help}");
    // The help of a command has its own usage.
    assert!(fatek(&["help", "read"]).ok().contains("Usage: fatek read [OPTIONS] [TAG]..."));
}

/// The candidates for the last of these words.
fn candidates(words: &[&str], plant: &str) -> Vec<String> {
    let mut command = Command::new(FATEK);
    command.arg("--").arg("fatek").args(words);
    command.env("FATEK_COMPLETE", "bash").env("_CLAP_COMPLETE_INDEX", words.len().to_string());
    command.env("_CLAP_IFS", "\n").env("_CLAP_COMPLETE_COMP_TYPE", "9").env("FATEK_CONFIG", plant);
    let output = command.env_remove("FATEK_TAGS").output().unwrap();
    assert!(output.status.success() && output.stderr.is_empty(), "{output:?}");
    String::from_utf8(output.stdout).unwrap().lines().map(|line| line.trim_end().to_owned()).collect()
}

#[test]
fn commands_plcs_and_tags_are_completed() {
    let folder = Folder::new("complete");
    let plant = folder.file("plant.toml");
    let text = "[plc.mixer]\nlink = \"tcp://127.0.0.1:9\"\nstation = 1\ntag.level = \"R0\"\ntag.lamp = \"M1\"\n\n\
                [plc.boiler]\nlink = \"tcp://127.0.0.1:9\"\nstation = 2\ntag.level = \"R5\"\ntag.heat = \"R6\"\n";
    std::fs::write(&plant, text).unwrap();
    let tags = folder.file("tags.csv");
    std::fs::write(&tags, "name,at\nlid,M9\n").unwrap();
    let complete = |words: &[&str]| candidates(words, &plant);
    assert_eq!(complete(&["sc"]), ["scan"]);
    assert_eq!(complete(&["@"]), ["@all", "@boiler", "@mixer"]);
    assert_eq!(complete(&["@m"]), ["@mixer"]);
    // Bash takes @ for a word of its own.
    assert_eq!(complete(&["@", "b"]), ["boiler"]);
    assert_eq!(complete(&["--plc", "m"]), ["mixer"]);
    assert_eq!(complete(&["@mixer", "read", "l"]), ["level", "lamp"]);
    assert_eq!(complete(&["@", "boiler", "watch", "l"]), ["level"]);
    assert_eq!(complete(&["@boiler", "write", "he"]), ["heat"]);
    assert_eq!(complete(&["read", "--tags", &tags, "l"]), ["lid"]);
    assert_eq!(complete(&["read", "--format", "j"]), ["json"]);
    // Before: no file of the current folder was a candidate.
    assert_eq!(complete(&["--config", "Cargo.to"]), ["Cargo.toml"]);
    // Without a plant, and with one that is damaged, there are no names and no errors.
    assert_eq!(candidates(&["@mixer", "read", "l"], ""), [""; 0]);
    std::fs::write(&plant, "[plc").unwrap();
    assert_eq!(complete(&["@mixer", "read", "l"]), [""; 0]);
}

// Before: the variable disabled each command, with status 0.
#[test]
fn the_variable_alone_does_not_disable_a_command() {
    let output = Command::new(FATEK).args(["decode", "02"]).env("FATEK_COMPLETE", "bash").output().unwrap();
    assert_eq!(output.status.code(), Some(6), "{output:?}");
}

#[test]
fn each_shell_has_a_script() {
    for shell in ["bash", "elvish", "fish", "powershell", "zsh"] {
        let script = fatek(&["completions", shell]).ok();
        assert!(script.contains("FATEK_COMPLETE"), "{shell}: {script}");
    }
    let unknown = fatek(&["completions", "dos"]);
    assert_eq!(unknown.status, 2);
    assert!(unknown.stderr.contains("[possible values: bash, elvish, fish, powershell, zsh]"), "{unknown:?}");
}

/// The script, run by a shell as the shell runs it.
#[cfg(target_os = "linux")]
#[test]
fn bash_runs_the_script() {
    let folder = std::path::Path::new(FATEK).parent().unwrap();
    let path = format!("{}:{}", folder.display(), std::env::var("PATH").unwrap());
    let run = "source <(fatek completions bash) && COMP_WORDS=(fatek back) COMP_CWORD=1 COMP_TYPE=9 && \
               _clap_complete_fatek fatek back fatek && echo \"${COMPREPLY[*]}\"";
    let output = Command::new("bash").args(["-c", run]).env("PATH", path).output().unwrap();
    assert_eq!(String::from_utf8(output.stdout).unwrap().trim(), "backup");
}

#[test]
fn man_pages_have_the_options_and_examples_of_each_command() {
    let folder = Folder::new("man");
    let man = folder.file("man1");
    fatek(&["man", &man]).ok();
    let page = |name: &str| std::fs::read_to_string(format!("{man}/{name}")).unwrap();
    assert!(page("fatek.1").contains(r".TH fatek 1"));
    let watch = page("fatek-watch.1");
    assert!(watch.contains(r"\-\-interval") && watch.contains("Examples:"), "{watch}");
    let refused = fatek(&["man", "/dev/null/man"]);
    assert_eq!(refused.status, 1);
    assert!(refused.stderr.starts_with("error: man pages in /dev/null/man: "), "{refused:?}");
}

#[cfg(unix)]
#[test]
fn messages_have_colours_at_a_terminal_and_none_with_no_color() {
    use std::fs::{File, OpenOptions};
    use std::io::Read;
    use std::process::Stdio;

    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

    let shown = |no_color: &str| {
        let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
        grantpt(&terminal).unwrap();
        unlockpt(&terminal).unwrap();
        let path = ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
        let side = || Stdio::from(OpenOptions::new().read(true).write(true).open(&path).unwrap());
        let mut command = Command::new(FATEK);
        command.args(["read", "Q0", "--link", "tcp://127.0.0.1:9", "--station", "1"]);
        command.env("TERM", "xterm").env("NO_COLOR", no_color).env_remove("CLICOLOR_FORCE").env_remove("CLICOLOR");
        let mut child = command.stdin(Stdio::null()).stdout(side()).stderr(side()).spawn().unwrap();
        drop(command);
        let mut text = String::new();
        // Reading ends with an error when the other side is closed.
        let _ = File::from(terminal).read_to_string(&mut text);
        assert_eq!(child.wait().unwrap().code(), Some(2), "{text}");
        text
    };
    let coloured = shown("");
    assert!(coloured.starts_with('\u{1b}') && coloured.contains("error:\u{1b}[0m "), "{coloured:?}");
    let plain = shown("1");
    assert!(plain.starts_with("error: ") && !plain.contains('\u{1b}'), "{plain:?}");
}
