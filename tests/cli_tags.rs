//! Tables of tags (`--tags`) and bits of registers on the command line.
#![cfg(feature = "cli")]

mod process;

use std::fs;
use std::process::Command;

use process::{FATEK, Folder, Sim, fatek, run};

/// A table as a spreadsheet saves it.
const TABLE: &str = "\u{feff}name;at;class;unit\r\n\
                     level;R100:f32;fast;m\r\n\
                     alarm;M7;fast;\r\n\
                     speeds;R0-R2:i16;slow;rpm\r\n\
                     pump;R7.3;slow;\r\n";

fn table(folder: &Folder) -> String {
    let path = folder.file("mixer.csv");
    fs::write(&path, TABLE).unwrap();
    path
}

#[test]
fn names_of_a_table_stand_for_tags() {
    let folder = Folder::new("cli-tags");
    let path = table(&folder);
    let sim = Sim::start(&["--listen", "tcp://127.0.0.1:0"]);
    sim.fatek(&["write", "level=2.5", "alarm=on", "speeds=1,-2,3", "R7=8", "--tags", &path]).ok();
    let all = sim.fatek(&["read", "--tags", &path, "--format", "csv"]).ok();
    assert_eq!(
        all,
        "tag,type,value\nlevel,f32,2.5\nalarm,bool,1\nspeeds[0],i16,1\nspeeds[1],i16,-2\nspeeds[2],i16,3\npump,bool,1\n"
    );
    let some = sim.fatek(&["read", "alarm", "R100:f32", "--tags", &path, "--format", "csv"]).ok();
    assert_eq!(some, "tag,type,value\nalarm,bool,1\nR100,f32,2.5\n");
    let watched = sim.fatek(&["watch", "level", "--tags", &path, "--count", "1", "--format", "json"]).ok();
    assert!(watched.contains("\"tag\":\"level\",\"value\":2.5,\"quality\":\"good\""), "{watched}");
    // The table of the environment.
    let read = ["--link", &sim.url, "--station", "1", "read", "level", "--format", "csv"];
    assert_eq!(run(Command::new(FATEK).args(read).env("FATEK_TAGS", &path)).ok(), "tag,type,value\nlevel,f32,2.5\n");
}

#[test]
fn an_empty_variable_is_no_table() {
    let plan = |args: &[&str]| run(Command::new(FATEK).arg("plan").args(args).env("FATEK_TAGS", ""));
    assert!(plan(&["R0"]).ok().contains("R0"));
    assert!(plan(&[]).usage().contains("no tag is given, and no table of tags"));
}

#[test]
fn faults_of_a_table_are_usage_errors_and_send_nothing() {
    let folder = Folder::new("cli-tags-faults");
    let path = table(&folder);
    let link = ["--link", "tcp://192.0.2.1", "--station", "1"];
    let usage = |args: &[&str]| fatek(&[&link[..], args].concat()).usage();
    assert!(
        usage(&["read", "levle", "--tags", &path]).contains("nor is it a name of the table (similar names: level)")
    );
    assert!(usage(&["write", "level=x", "--tags", &path]).contains("`x` is not a value for R100:f32"));
    assert!(usage(&["read"]).contains("no tag is given"));
    let bad = folder.file("bad.csv");
    fs::write(&bad, "name,at\na,R5:f33\nb,Q5\n").unwrap();
    let error = usage(&["read", "--tags", &bad]);
    assert!(
        error.contains("bad.csv: line 2, at: `R5:f33` is not a tag") && error.contains("\nline 3, at: `Q5`"),
        "{error}"
    );
    assert!(usage(&["read", "--tags", &folder.file("none.csv")]).contains("none.csv"));
}

#[test]
fn a_plan_names_tags_with_common_elements() {
    let folder = Folder::new("cli-tags-plan");
    let path = folder.file("mixer.toml");
    fs::write(&path, "far = \"R0-R9\"\nnear = { at = \"R5:i16\" }\n").unwrap();
    let output = fatek(&["plan", "--tags", &path]);
    assert!(output.stderr.contains("line 2, near (R5:i16) has elements of far (R0-R9) in line 1"), "{output:?}");
    assert!(output.ok().contains("R0"));
    fs::write(&path, "far = \"R0-R9\"\nnear = { at = \"R5:i16\" }\nother = \"R20\"\n").unwrap();
    let of = |name: &str| fatek(&["plan", "--tags", &path, name]).stderr;
    assert!(of("near").contains("line 2, near") && of("far").contains("line 2, near"));
    // Before: the same line, of tags that were not asked for.
    assert_eq!(of("other"), "");
}

/// Before: `wrote R5:i16*0.1-40=21.55`, which is not what the PLC has, and the element in place of the name.
#[test]
fn a_write_prints_the_name_and_the_value_that_is_stored() {
    let folder = Folder::new("cli-tags-write");
    let path = folder.file("mixer.toml");
    fs::write(&path, "temperature = { at = \"R5:i16*0.1-40\" }\n").unwrap();
    let sim = Sim::start(&["--listen", "tcp://127.0.0.1:0"]);
    let wrote = |arguments: &[&str]| {
        let output = sim.fatek(arguments);
        assert_eq!(output.status, 0, "{output:?}");
        output.stderr
    };
    let line = wrote(&["write", "--tags", &path, "temperature=21.54", "--verify"]);
    assert_eq!(line, "wrote temperature=21.5 (21.54 was given)\n");
    assert!(sim.fatek(&["read", "--tags", &path, "temperature"]).ok().ends_with("  21.5\n"));
    assert_eq!(
        wrote(&["write", "R5:i16*0.1-40=21.5", "R6:u16*3=4"]),
        "wrote R5:i16*0.1-40=21.5\nwrote R6:u16*3=3.0 (4.0 was given)\n"
    );
}

#[test]
fn bits_of_registers_are_written_only_if_that_is_asked_for() {
    let sim = Sim::start(&["--listen", "tcp://127.0.0.1:0", "--set", "R5=0xF0F0"]);
    let error = sim.fatek(&["write", "R6=1", "R5.3=1"]).usage();
    let rule =
        "R5.3 is a part of R5, and a write replaces all bits of R5; --modify-bits reads, changes and writes them";
    assert!(error.contains(rule), "{error}");
    let output = sim.fatek(&["write", "--modify-bits", "R5.3=1", "R5.4-R5.5=off,on", "R7=1"]);
    assert!(output.stderr.contains("wrote R5.4-R5.5=0,1"), "{output:?}");
    output.ok();
    // R6 was not written by the first command.
    assert_eq!(
        sim.fatek(&["read", "R5-R7:hex", "R5.3-R5.5", "--format", "csv"]).ok(),
        "tag,type,value\nR5,hex,0xF0E8\nR6,hex,0x0000\nR7,hex,0x0001\nR5.3,bool,1\nR5.4,bool,0\nR5.5,bool,1\n"
    );
}
