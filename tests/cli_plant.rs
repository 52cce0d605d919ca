//! `fatek` with a plant configuration and with lists of stations, against `fatek sim` as another process.
#![cfg(feature = "cli")]

mod process;

use process::{Folder, Sim, fatek};

fn plant(mixer: &Sim, boiler: &Sim) -> String {
    format!(
        "[bridge]\nid = 'other programs use it'\n\
         [class]\nfast = {{ every = '500ms' }}\n\
         [template.tank]\nlevel = {{ at = 'R5:i16*0.1-40', class = 'fast', unit = '%', \
         write = {{ min = 0, max = 80 }} }}\nalarm = 'M7'\n\
         [plc.mixer]\nlink = '{}'\nstation = 1\nuse = ['tank']\ntag.total = 'DR100'\n\
         [plc.boiler]\nlink = '{}'\nstation = 1\nuse = ['tank']\n",
        mixer.url, boiler.url
    )
}

#[test]
fn plcs_of_a_plant_are_used_by_name() {
    let (mixer, boiler) = (Sim::start(&["--set", "R5=500", "DR100=7"]), Sim::start(&["--set", "R5=600", "M7=1"]));
    let folder = Folder::new("plant");
    let path = folder.file("plant.toml");
    std::fs::write(&path, plant(&mixer, &boiler)).unwrap();
    let run = |args: &[&str]| fatek(&[args, &["--config", &path, "--format", "csv"]].concat());

    assert_eq!(run(&["@mixer", "read", "level", "R5"]).ok(), "tag,type,value\nlevel,i16*0.1-40,10.0\nR5,u16,500\n");
    let all = "tag,type,value\nlevel,i16*0.1-40,10.0\nalarm,bool,0\ntotal,u32,7\n";
    assert_eq!(run(&["@mixer", "read"]).ok(), all);
    assert_eq!(run(&["--plc", "mixer", "read"]).ok(), all);
    let both = "plc,tag,type,value\nmixer,level,i16*0.1-40,10.0\nmixer,alarm,bool,0\nboiler,level,i16*0.1-40,20.0\n\
                boiler,alarm,bool,1\n";
    assert_eq!(run(&["@mixer", "@boiler", "read", "level", "alarm"]).ok(), both);
    assert_eq!(run(&["@all", "read", "level", "alarm"]).ok(), both);
    let json = fatek(&["@all", "read", "alarm", "--config", &path, "--format", "json"]).ok();
    let json: serde_json::Value = json.parse().unwrap();
    let expected = serde_json::json!([
        { "plc": "mixer", "tag": "alarm", "type": "bool", "value": false },
        { "plc": "boiler", "tag": "alarm", "type": "bool", "value": true },
    ]);
    assert_eq!(json, expected);

    run(&["@boiler", "write", "level=12.5", "M7=off", "--verify"]).ok();
    for (write, reason) in [
        ("level=80.5", "level is at most 80"),
        ("level=-1", "level is at least 0"),
        ("alarm=on", "alarm is not writable"),
    ] {
        let refused = run(&["@boiler", "write", write]).usage();
        assert!(refused.contains(reason) && refused.contains("; to write it nevertheless, name "), "{refused}");
    }
    // Before, 80.5 was written.
    let halves = folder.file("halves.toml");
    let valve = format!(
        "[plc.mixer]\nlink = '{link}'\nstation = 1\ntag.valve = {{ at = 'R9:i16*0.5', write = {{ max = 80.3 }} }}\n",
        link = "tcp://127.0.0.1:9"
    );
    std::fs::write(&halves, valve).unwrap();
    let refused = fatek(&["--config", &halves, "@mixer", "write", "valve=80.3"]).usage();
    assert!(refused.contains("valve is at most 80.3, and 80.5 would be stored in the plant"), "{refused}");
    let options_first =
        fatek(&["--config", &path, "-q", "--timeout", "1s", "@mixer", "--format", "csv", "read", "alarm"]);
    assert_eq!(options_first.ok(), "tag,type,value\nalarm,bool,0\n");
    // Another table of the environment does not replace the tags of the PLC.
    let other = folder.file("other.csv");
    std::fs::write(&other, "name,at\nalarm,M99\n").unwrap();
    let tags = run(&["@boiler", "read", "alarm", "M7", "--tags", &other]).ok();
    assert_eq!(tags, "tag,type,value\nalarm,bool,0\nM7,bool,0\n");
    assert_eq!(run(&["@mixer", "@all", "@mixer", "read", "alarm"]).ok().lines().count(), 3, "each PLC once");
    assert_eq!(boiler.fatek(&["read", "R5", "M7", "--format", "csv"]).ok(), "tag,type,value\nR5,u16,525\nM7,bool,0\n");
    assert!(run(&["@mixer", "status"]).ok().contains("\nbrief,running,"));
    assert!(run(&["@mixer", "plan"]).ok().contains(",R5:i16*0.1-40"), "its tags");
    let watch = run(&["@all", "watch", "level", "--count", "2", "--interval", "50ms"]).ok();
    assert!(watch.contains(",mixer/level,10.0,good\n") && watch.contains(",boiler/level,12.5,good\n"), "{watch}");
}

#[test]
fn faults_of_the_choice_are_named() {
    let (mixer, boiler) = (Sim::start(&[]), Sim::start(&[]));
    let folder = Folder::new("plant-faults");
    let path = folder.file("plant.toml");
    std::fs::write(&path, plant(&mixer, &boiler)).unwrap();
    let run = |args: &[&str]| fatek(&[args, &["--config", &path]].concat()).usage();
    let unknown = run(&["@mixr", "read", "R0"]);
    assert!(unknown.starts_with("error: the plant has no PLC `mixr` (it has: mixer boiler)\n"), "{unknown}");
    let several = run(&["@all", "write", "R0=1"]);
    assert!(several.starts_with("error: this command takes one PLC, not 2\n"), "{several}");
    let tag = run(&["@mixer", "read", "lvel"]);
    assert!(tag.contains("; nor is it a name of the tags of mixer\n"), "{tag}");
    // Before: the other PLC was ignored without a word.
    for other in [&["--station", "2", "@mixer", "read", "R0"][..], &["@mixer", "read", "R0", "--link", "tcp://h"]] {
        let other = run(other);
        assert!(other.contains("a PLC of the plant has its own link and station: leave out --link"), "{other}");
    }
    let none = fatek(&["@mixer", "read", "R0"]).usage();
    assert!(none.starts_with("error: no plant configuration: give --config FILE, or set FATEK_CONFIG\n"), "{none}");
    std::fs::write(&path, "[plc.mixer]\nlink = 'tcp://h'\nstation = 0\ntag.x = 'R'\n").unwrap();
    let faults = run(&["@mixer", "read", "R0"]);
    assert!(faults.contains("plant.toml: line 3, plc.mixer.station: 0 is not a station: 1 to 254 are\n"), "{faults}");
    assert!(
        faults.contains("\nerror: line 4, plc.mixer.tag.x: ") || faults.contains("\nline 4, plc.mixer.tag.x: "),
        "{faults}"
    );
}

#[test]
fn several_stations_of_a_link_are_read() {
    let sim = Sim::start(&["--set", "R0=5"]);
    let read = |stations: &str| {
        fatek(&["--link", &sim.url, "--station", stations, "--timeout", "100ms", "read", "R0", "R9999"])
    };
    // Station 2 does not exist: the values of station 1 are printed all the same.
    let two = read("1-2");
    assert_eq!((two.status, two.stdout.as_str()), (4, "PLC  TAG  TYPE  VALUE\n1    R0   u16   5\n"), "{two:?}");
    assert!(
        two.stderr.contains("1: R9999: station 1 refused") && two.stderr.contains("2: R0: station 2 did not"),
        "{two:?}"
    );
    // Dead stations before a live one cost no more than their checks.
    let many = fatek(&["--link", &sim.url, "--station", "10-40,1", "--timeout", "50ms", "read", "R0-R300"]);
    assert_eq!((many.status, many.stdout.lines().count()), (4, 302), "{}", many.stderr);
    assert_eq!(many.stderr.lines().filter(|line| line.starts_with("10: ")).count(), 1, "{}", many.stderr);
    let one = read("1");
    assert_eq!((one.status, one.stdout.as_str()), (3, "TAG  TYPE  VALUE\nR0   u16   5\n"), "{one:?}");
    let bad = read("1-300").stderr;
    assert!(bad.starts_with("error: `1-300` is not a list of stations: "), "{bad}");
}
