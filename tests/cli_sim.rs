//! `fatek sim` with movements, faults, line speed, saved memory and plants, and `--link` for several PLCs.
#![cfg(feature = "cli")]

mod process;

use std::collections::HashSet;
use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use process::{FATEK, Folder, Output, Sim, fatek, run};

/// A running simulator, with its lines on stdout.
struct Running {
    child: Child,
    lines: Vec<String>,
}

impl Running {
    /// Starts `fatek` with these arguments, and reads this number of lines.
    fn start(args: &[&str], lines: usize) -> Self {
        let mut command = Command::new(FATEK);
        let command = command.args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).env_remove("FATEK_CONFIG");
        let mut child = command.spawn().unwrap();
        let stdout = BufReader::new(child.stdout.take().unwrap());
        let lines: Vec<String> = stdout.lines().take(lines).map(Result::unwrap).collect();
        Self { child, lines }
    }

    /// Ends it with SIGTERM, and returns its stderr.
    #[cfg(unix)]
    fn end(mut self) -> String {
        Command::new("kill").arg(self.child.id().to_string()).status().unwrap();
        let mut stderr = String::new();
        self.child.stderr.take().unwrap().read_to_string(&mut stderr).unwrap();
        assert_eq!(self.child.wait().unwrap().code(), Some(0), "{stderr}");
        stderr
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The value of a tag.
fn value(sim: &Sim, tag: &str) -> f64 {
    let csv = sim.fatek(&["read", tag, "--format", "csv"]).ok();
    csv.trim_end().rsplit(',').next().unwrap().parse().unwrap_or_else(|_| panic!("{csv}"))
}

/// Reads until a condition holds of a tag.
fn wait_for(sim: &Sim, tag: &str, holds: impl Fn(f64) -> bool) -> f64 {
    let began = Instant::now();
    loop {
        let value = value(sim, tag);
        if holds(value) {
            return value;
        }
        assert!(began.elapsed() < Duration::from_secs(60), "{tag} is still {value}");
    }
}

#[test]
fn values_of_all_kinds_move() {
    let sim = Sim::start(&[
        "--set",
        "R0=step(7..9,1ms)",
        "R5:i16*0.1-40=step(0..-12.5,1ms)",
        "R100:f32=step(0..1e6,1ms)",
        "DR10:i32=step(0..-70000,1ms)",
        "R20:bcd16=step(0..1234,1ms)",
        "M0-M1=step(1ms)",
        "R30=counter(1ms)",
        "R40=3",
    ]);
    let tags = ["R0", "R5:i16*0.1-40", "R100:f32", "DR10:i32", "R20:bcd16", "M0-M1", "R40"];
    wait_for(&sim, "R30", |count| count > 1.0);
    let read = sim.fatek(&[&["read", "--format", "csv"], &tags[..]].concat()).ok();
    assert_eq!(
        read,
        "tag,type,value\nR0,u16,9\nR5,i16*0.1-40,-12.5\nR100,f32,1000000.0\nDR10,i32,-70000\nR20,bcd16,1234\n\
         M0,bool,1\nM1,bool,1\nR40,u16,3\n"
    );
    let count = value(&sim, "R30");
    wait_for(&sim, "R30", |later| later > count);
}

#[test]
fn the_process_overwrites_what_a_client_writes_to_a_movement() {
    let sim = Sim::start(&["--set", "R0=step(5..5,1s)", "X3=step(1..1,1s)"]);
    let verified = sim.fatek(&["write", "R0=7", "R1=8", "--verify"]);
    assert_eq!(verified.status, 7, "{verified:?}");
    assert_eq!((value(&sim, "R0"), value(&sim, "R1")), (5.0, 8.0));
    // A disabled discrete keeps its state.
    sim.fatek(&["disable", "X3"]).ok();
    sim.fatek(&["reset", "X3"]).ok();
    assert_eq!(value(&sim, "X3"), 0.0);
    sim.fatek(&["enable", "X3"]).ok();
    assert_eq!(value(&sim, "X3"), 1.0);
}

#[test]
fn random_values_follow_from_the_seed() {
    let read = |seed: &str| {
        let sim = Sim::start(&["--seed", seed, "--set", "R0-R9=random(0..65535,24h)"]);
        sim.fatek(&["read", "R0-R9", "--format", "csv"]).ok()
    };
    let first = read("7");
    assert_eq!(first, read("7"));
    assert_ne!(first, read("8"));
    let values: HashSet<&str> = first.lines().skip(1).map(|line| line.rsplit(',').next().unwrap()).collect();
    assert!(values.len() > 5, "{first}");
}

#[test]
fn faults_of_settings_name_the_text_and_the_rule() {
    let refused = |args: &[&str]| fatek(&[&["sim"], args].concat()).usage();
    for (option, text, fault) in [
        ("--set", "R0=rampp(0..1,1s)", "`rampp(0..1,1s)` is not a movement: it must be ramp(0..100,10s), triangle("),
        ("--set", "R0=ramp(0..100)", "`ramp(0..100)` is not a movement: it needs a period, as in `ramp(0..100,10s)`"),
        ("--set", "R0=ramp(-1..1,1s)", "R0 cannot hold -1.0"),
        ("--set", "R5.3=square(1s)", "R5.3 cannot move: numbers and discretes can"),
        ("--set", "R0=-5", "perhaps R0:i16=-5"),
        ("--set", "9/R0=1", "there is no simulated PLC `9` (there are: 1)"),
        ("--set", "R4168=counter", "R4168 is beyond the memory of this model"),
        ("--fault", "drop", "`drop` is not a fault: a chance is 0% to 100%, as in `drop=1%`"),
        ("--fault", "drop=1%,lose=1%", "`lose=1%` is not a fault: the names are drop, "),
        ("--fault", "late=1%:5", "`late=1%:5` is not a fault: `5` must be a time or times"),
        ("--fault", "2/drop=1%", "there is no simulated PLC `2` (there are: 1)"),
        ("--fault", "1/refuse=1%", "`refuse` is of connections: it takes no PLC"),
    ] {
        let refused = refused(&[option, text]);
        assert!(refused.starts_with(&format!("error: {option} {text}: ")) && refused.contains(fault), "{refused}");
    }
    assert!(refused(&["--baud", "0"]).contains("--baud"));
    assert!(refused(&["--model", "fbx"]).contains("`fbx` is not a known model (known: fbe-28mc fbs-20mc largest)"));
    assert!(refused(&["--clock", "noon"]).contains("`noon` is not a time such as 2026-11-29T06:30:00"));
    let range = refused(&["--set", "R2:f32=step(0..1e39,1ms)"]);
    assert!(range.contains("R2:f32 cannot hold 1e39"), "{range}");
    assert!(refused(&["--response-time", "2s..1s"]).contains("the first time must not be the longer one"));
    assert!(refused(&["--client-config", "x.toml"]).contains("give --config FILE"));
}

#[test]
#[cfg(unix)]
fn faults_are_counted_and_printed_at_the_end() {
    let args = ["sim", "--station", "1", "--station", "2", "--seed", "5", "--fault", "2/ignore=100%,late=0%:1s"];
    let args = [&args[..], &["--fault", "corrupt=0%", "--listen", "tcp://127.0.0.1:0"]].concat();
    let sim = Running::start(&args, 1);
    let url = sim.lines[0].strip_prefix("listening ").unwrap();
    let ping = |station: &str| {
        fatek(&["--link", url, "--station", station, "--timeout", "100ms", "ping", "-c", "3", "--interval", "1ms"])
    };
    assert_eq!(ping("1").status, 0);
    assert_eq!(ping("2").status, 4);
    let stderr = sim.end();
    let expected = "requests; faults drawn: 2/ignore=100% ";
    let counts = stderr.trim_end().split_once(expected).unwrap_or_else(|| panic!("{stderr}")).1;
    let (ignored, others) = counts.split_once(", ").unwrap();
    assert!(ignored.parse::<u32>().unwrap() >= 3, "{stderr}");
    assert_eq!(others, "2/late=0%:1s 0, corrupt=0% 0");
    // Without faults stderr is empty.
    let silent = Running::start(&["sim"], 1);
    assert_eq!(silent.end(), "");
    let quiet = Running::start(&["sim", "-q", "--fault", "drop=1%"], 1);
    assert_eq!(quiet.end(), "");
}

#[test]
fn equal_seeds_have_equal_faults() {
    let replies = |seed: &str| -> Vec<[u8; 13]> {
        let sim = Sim::start(&["--seed", seed, "--fault", "corrupt=50%"]);
        let mut stream = TcpStream::connect(sim.url.strip_prefix("tcp://").unwrap()).unwrap();
        let mut read = || {
            stream.write_all(b"\x02014601R0000070\x03").unwrap();
            let mut reply = [0; 13];
            stream.read_exact(&mut reply).unwrap();
            reply
        };
        (0..32).map(|_| read()).collect()
    };
    let first = replies("1");
    assert_eq!(first, replies("1"));
    let good = first.iter().filter(|reply| **reply == *b"\x02014600000BD\x03").count();
    assert!((6..26).contains(&good), "{good} of 32");
    assert_ne!(first, replies("2"));
}

#[test]
fn a_line_takes_the_time_of_its_bytes() {
    // A read of 64 registers: a request of 16 and a reply of 265 bytes, 281 * 10 bits at 2400 baud.
    let sim = Sim::start(&["--baud", "2400"]);
    let began = Instant::now();
    sim.fatek(&["read", "R0-R63", "--timeout", "60s"]).ok();
    assert!(began.elapsed() > Duration::from_millis(1170), "{:?}", began.elapsed());
    let slow = Sim::start(&["--response-time", "300ms"]);
    let began = Instant::now();
    slow.fatek(&["read", "R0", "--timeout", "60s"]).ok();
    assert!(began.elapsed() > Duration::from_millis(300), "{:?}", began.elapsed());
}

#[test]
fn listeners_of_each_transport_and_framing_serve_the_same_plcs() {
    let args = ["sim", "--set", "R0=7", "--listen", "tcp://127.0.0.1:0", "--listen", "udp://127.0.0.1:0"];
    let sim = Running::start(&[&args[..], &["--listen", "tcp://127.0.0.1:0?framing=binary"]].concat(), 3);
    let urls: Vec<&str> = sim.lines.iter().map(|line| line.strip_prefix("listening ").unwrap()).collect();
    assert!(urls[1].starts_with("udp://127.0.0.1:") && urls[2].ends_with("?framing=binary"), "{urls:?}");
    fatek(&["--link", urls[2], "--station", "1", "write", "R1=8"]).ok();
    for url in urls {
        let read = fatek(&["--link", url, "--station", "1", "read", "R0-R1", "--format", "csv"]).ok();
        assert_eq!(read, "tag,type,value\nR0,u16,7\nR1,u16,8\n", "{url}");
    }
}

#[test]
fn a_saved_plc_is_simulated() {
    let folder = Folder::new("sim-saved");
    let (backup, program) = (folder.file("plc.backup"), folder.file("plc.program"));
    let original = Sim::start(&["--model", "fbs-20mc", "--ladder-words", "640", "--set", "R5=7", "R8000=3", "M3=1"]);
    original.fatek(&["run"]).ok();
    original.fatek(&["backup", &backup, "R0-R9", "R7990-R8009", "M0-M9"]).ok();
    original.fatek(&["program", "read", &program]).ok();

    let copy = Sim::start(&["--memory", &backup, "--program", &program, "--set", "R6=1"]);
    let read = copy.fatek(&["read", "R5", "R6", "R8000", "M3", "--format", "csv"]).ok();
    assert_eq!(read, "tag,type,value\nR5,u16,7\nR6,u16,1\nR8000,u16,3\nM3,bool,1\n");
    assert!(copy.fatek(&["status", "--format", "csv"]).ok().contains("brief,running,true\n"), "as it was");
    copy.fatek(&["program", "verify", &program]).ok();
    let restored = copy.fatek(&["restore", &backup, "--yes"]);
    assert_eq!(restored.status, 0, "it is the same PLC: {restored:?}");

    // The memory of one station, and a model without its elements.
    let two = Sim::start(&["--station", "1", "--station", "2", "--memory", &format!("2={backup}")]);
    assert_eq!(value(&two, "R5"), 0.0);
    let of_2 = fatek(&["--link", &two.url, "--station", "2", "read", "R5", "--format", "csv"]).ok();
    assert_eq!(of_2, "tag,type,value\nR5,u16,7\n");
    let small = fatek(&["sim", "--memory", &backup, "--last", "R100"]).usage();
    assert!(small.contains("plc.backup: R7990 is beyond the memory of this model"), "{small}");
    assert_eq!(fatek(&["sim", "--memory", &program]).status, 7);
    assert_eq!(fatek(&["sim", "--program", &folder.file("missing")]).status, 1);
}

#[test]
fn the_station_of_a_backup_is_the_default() {
    let folder = Folder::new("sim-station");
    let backup = folder.file("plc.backup");
    let original = Sim::start(&["--station", "9", "--set", "R5=7"]);
    fatek(&["--link", &original.url, "--station", "9", "backup", &backup, "R0-R9"]).ok();
    let copy = Sim::start(&["--memory", &backup]);
    fatek(&["--link", &copy.url, "--station", "9", "backup", &backup, "--compare"]).ok();
}

const PLANT: &str = "\
[class]
fast = { every = '50ms' }
[template.tank]
level = { at = 'R5:i16*0.1-40', class = 'fast' }
alarm = 'M7'
[plc.mixer]
link = 'tcp://192.0.2.3'
station = 1
use = ['tank']
tags = 'mixer.csv'
[plc.boiler]
link = 'udp://192.0.2.9:500?framing=binary'
station = 1
use = ['tank']
[bus.line1]
link = 'serial:/dev/ttyUSB0?baud=115200'
stations = { pump1 = 1, pump2 = 2 }
use = ['tank']
[sim.all]
set.alarm = true
[sim.mixer]
set.total = 70000
set.R9 = 'step(1..4,1ms)'
";

/// A folder with a plant, and the paths of the plant and of its copy.
fn plant(name: &str) -> (Folder, String, String) {
    let folder = Folder::new(name);
    let (path, copy) = (folder.file("plant.toml"), folder.file("sim.toml"));
    fs::write(&path, PLANT).unwrap();
    fs::write(folder.file("mixer.csv"), "name,at\ntotal,DR100\n").unwrap();
    (folder, path, copy)
}

#[test]
fn a_simulated_clock_is_read_and_set() {
    let sim = Sim::start(&["--clock", "2026-11-29T06:30:00"]);
    let read = || sim.fatek(&["clock", "--format", "csv"]).ok();
    assert_eq!(read(), "time,weekday\n2026-11-29 06:30:00,0\n");
    sim.fatek(&["clock", "--set", "2026-12-01T07:00:05"]).ok();
    assert_eq!(read(), "time,weekday\n2026-12-01 07:00:05,2\n");
    assert_eq!(Sim::start(&[]).fatek(&["clock"]).status, 3, "the PLC has no clock");
}

#[test]
#[cfg(unix)]
fn faults_of_options_replace_those_of_a_plant() {
    let (_folder, path, copy) = plant("sim-precedence");
    let sections = PLANT.replace("[sim.all]\n", "[sim.all]\nfault = 'ignore=100%,late=0%'\n");
    let sections = sections.replace("[sim.mixer]\n", "[sim.mixer]\nfault = 'ignore=0%'\n");
    fs::write(&path, sections).unwrap();
    let args = ["sim", "--config", &path, "--client-config", &copy, "--fault", "pump1/ignore=0%"];
    let sim = Running::start(&args, 3);
    let read = |plc: &str| fatek(&["--config", &copy, plc, "--timeout", "100ms", "read", "R9"]).status;
    assert_eq!((read("@mixer"), read("@boiler"), read("@pump1"), read("@pump2")), (0, 4, 0, 4));
    let stderr = sim.end();
    let line = |plcs: &str| stderr.lines().find(|line| line.starts_with(plcs)).unwrap_or_else(|| panic!("{stderr}"));
    assert!(line("mixer: ").ends_with("; faults drawn: mixer/ignore=0% 0, late=0% 0"), "{stderr}");
    let pumps = line("pump1, pump2: ");
    assert!(pumps.contains("; faults drawn: pump1/ignore=0% 0, pump2/ignore=100% "), "{stderr}");
}

#[test]
#[cfg(unix)]
fn a_copy_is_as_private_as_its_plant() {
    use std::os::unix::fs::PermissionsExt;
    let (_folder, path, copy) = plant("sim-private");
    fs::write(&path, format!("\u{feff}{PLANT}")).unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    let _sim = Running::start(&["sim", "--config", &path, "--client-config", &copy], 3);
    assert_eq!(fs::metadata(&copy).unwrap().permissions().mode() & 0o777, 0o600);
    // A byte order mark of the original does not make it unreadable.
    assert_eq!(
        fatek(&["--config", &copy, "@mixer", "read", "total", "--format", "csv"]).ok(),
        "tag,type,value\ntotal,u32,70000\n"
    );
}

#[test]
#[cfg(unix)]
fn a_plant_is_simulated_and_watched_with_two_commands() {
    let (_folder, path, copy) = plant("sim-plant");
    let sim =
        ["sim", "--config", &path, "--client-config", &copy, "--set", "level=12.5", "pump2/level=step(0..50,1ms)"];
    let sim = Running::start(&[&sim[..], &["--fault", "boiler/late=100%:1ms"]].concat(), 3);
    assert!(sim.lines[0].contains(" for tcp://192.0.2.3") && sim.lines[0].ends_with(": mixer"), "{:?}", sim.lines);
    assert!(sim.lines[1].starts_with("listening udp://127.0.0.1:"), "{:?}", sim.lines);
    assert!(sim.lines[2].ends_with(" for serial:/dev/ttyUSB0?baud=115200: pump1, pump2"), "{:?}", sim.lines);

    let watched = fatek(&["--config", &copy, "@all", "watch", "--count", "40", "--interval", "20ms"]).ok();
    for tag in
        ["mixer/level   12.5", "mixer/total   70000", "boiler/level  12.5", "pump1/alarm   1", "pump2/level   50.0"]
    {
        assert!(watched.lines().any(|line| line.ends_with(tag)), "{tag}: {watched}");
    }
    let read = |args: &[&str]| fatek(&[&["--config", &copy], args, &["--format", "csv"]].concat()).ok();
    assert_eq!(read(&["@mixer", "read", "R9"]), "tag,type,value\nR9,u16,4\n");
    fatek(&["--config", &copy, "@pump1", "write", "R5=1"]).ok();
    assert_eq!(read(&["@pump1", "read", "R5"]), "tag,type,value\nR5,u16,1\n");
    let stderr = sim.end();
    assert!(stderr.starts_with("boiler: ") && stderr.contains("; faults drawn: boiler/late=100%:1ms "), "{stderr}");
}

#[test]
fn a_plant_has_memory_and_ports_of_options() {
    let (folder, path, copy) = plant("sim-memory");
    let backup = folder.file("plc.backup");
    Sim::start(&["--set", "R5=407", "R9=3"]).fatek(&["backup", &backup, "R0-R9"]).ok();
    // The memory of one PLC, also if it shares its line with another; settings come behind it.
    let args = ["sim", "--config", &path, "--client-config", &copy, "--memory", &format!("pump2={backup}")];
    let _sim = Running::start(&args, 3);
    let read = |plc: &str, tag: &str| {
        let csv = fatek(&["--config", &copy, plc, "read", tag, "--format", "csv"]).ok();
        csv.trim_end().rsplit(',').next().unwrap().to_owned()
    };
    assert_eq!((read("@pump2", "level"), read("@pump2", "R9")), ("0.7".to_owned(), "3".to_owned()));
    assert_eq!((read("@pump1", "level"), read("@mixer", "level")), ("-40.0".to_owned(), "-40.0".to_owned()));
    assert_eq!((read("@pump2", "alarm"), read("@boiler", "alarm")), ("1".to_owned(), "1".to_owned()));
    // A copy can be replaced, and be simulated itself.
    let again = Running::start(&["sim", "--config", &copy, "--client-config", &copy], 3);
    assert!(again.lines[0].contains(" for tcp://127.0.0.1:"), "{:?}", again.lines);
}

#[test]
fn a_part_of_a_plant_is_simulated_on_given_ports() {
    let (_folder, path, copy) = plant("sim-part");
    let sim = Running::start(&["--config", &path, "@pump2", "sim"], 1);
    assert!(sim.lines[0].ends_with(" for serial:/dev/ttyUSB0?baud=115200: pump2"), "{:?}", sim.lines);
    let refused = |args: &[&str]| fatek(&[&["--config", &path], args].concat()).usage();
    let part = refused(&["@pump2", "sim", "--client-config", &copy]);
    assert!(part.contains("--client-config takes all PLCs of the plant: "), "{part}");
    assert!(refused(&["sim", "--station", "2"]).contains("leave out --station and --framing"));
    let unknown = refused(&["sim", "--set", "lvl=1"]);
    assert!(
        unknown.contains("--set lvl=1: `lvl` is neither a tag nor the name of a tag of a simulated PLC"),
        "{unknown}"
    );
    let other = refused(&["sim", "--set", "boiler/total=1"]);
    assert!(other.contains("nor is it a name of the tags of boiler"), "{other}");
    let host = refused(&["sim", "--listen", "udp://127.0.0.1:0"]);
    assert!(host.contains("cannot listen on `udp://127.0.0.1:0`: for a plant it must begin with `tcp://`"), "{host}");
    assert!(
        refused(&["sim", "--listen", "tcp://127.0.0.1:65534"]).contains("from port 65534 on there are too few ports")
    );

    // A file that is not a copy stays, as does the plant itself.
    let itself = fatek(&["--config", &path, "sim", "--client-config", &path]);
    assert_eq!((itself.status, fs::read_to_string(&path).unwrap()), (1, PLANT.to_owned()), "{itself:?}");
    fs::write(&path, PLANT.replace("set.total", "set.totl")).unwrap();
    let section = refused(&["sim"]);
    assert!(section.contains("plant.toml: line 22, sim.mixer.set.totl: `totl` is not a tag: "), "{section}");
    fs::write(&path, PLANT.replace("set.alarm = true", "set.alarn = true")).unwrap();
    assert!(refused(&["sim"]).contains("line 20, sim.all.set.alarn: `alarn` is neither a tag nor"));
}

#[test]
fn a_plant_of_the_environment_is_simulated_by_name_only() {
    let (_folder, path, _) = plant("sim-environment");
    let start = |args: &[&str]| {
        let mut child =
            Command::new(FATEK).args(args).env("FATEK_CONFIG", &path).stdout(Stdio::piped()).spawn().unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        child.kill().unwrap();
        child.wait().unwrap();
        line
    };
    let of_options = start(&["sim"]);
    assert!(of_options.starts_with("listening tcp://") && !of_options.contains(" for "), "{of_options}");
    assert!(start(&["@mixer", "sim"]).ends_with(": mixer\n"));
}

#[test]
fn several_links_are_read_and_watched_side_by_side() {
    let (first, second) =
        (Sim::start(&["--set", "R0=1"]), Sim::start(&["--set", "R0=2", "--station", "1", "--station", "2"]));
    let links = ["--link", &first.url, "--link", &second.url];
    let run = |args: &[&str]| -> Output { fatek(&[&links, args].concat()) };
    let read = run(&["--station", "1", "read", "R0", "--format", "csv"]).ok();
    assert_eq!(read, format!("plc,tag,type,value\n{},R0,u16,1\n{},R0,u16,2\n", first.url, second.url));
    let after = fatek(&[&["read", "R0", "--station", "1", "--format", "csv"], &links[..]].concat()).ok();
    assert_eq!(after, read, "also after the command");
    let watched = run(&["--station", "1", "watch", "R0", "--count", "2", "--interval", "50ms", "--format", "csv"]).ok();
    for (sim, value) in [(&first, 1), (&second, 2)] {
        assert!(watched.contains(&format!(",{}/R0,{value},good\n", sim.url)), "{watched}");
    }
    // Stations of each link: one is missing, the others are printed.
    let stations = run(&["--station", "1-2", "--timeout", "100ms", "read", "R0", "--format", "csv"]);
    let rows = format!("plc,tag,type,value\n1@{0},R0,u16,1\n1@{1},R0,u16,2\n2@{1},R0,u16,2\n", first.url, second.url);
    assert_eq!((stations.status, stations.stdout), (4, rows), "{}", stations.stderr);
    assert!(stations.stderr.contains(&format!("2@{}: R0: station 2 did not", first.url)), "{}", stations.stderr);
    // The same link is read once, and links after the command take the place of those before it.
    let twice = fatek(&["--link", &first.url, "--link", &first.url, "--station", "1", "read", "R0", "--format", "csv"]);
    assert_eq!(twice.ok(), "tag,type,value\nR0,u16,1\n");
    let replaced = run(&["--station", "1", "read", "R0", "--format", "csv", "--link", &second.url]).ok();
    assert_eq!(replaced, "tag,type,value\nR0,u16,2\n");
}

#[test]
fn commands_for_one_plc_refuse_several_links() {
    let links = ["--link", "tcp://127.0.0.1:1", "--link", "tcp://127.0.0.1:2", "--station", "1"];
    for command in [
        &["write", "R0=1"][..],
        &["status"],
        &["ping"],
        &["set", "M0"],
        &["backup", "x.backup", "R0"],
        &["program", "read", "x.program"],
        &["clock"],
        &["probe"],
        &["forced"],
        &["scan", "1-2"],
        &["plan", "R0"],
    ] {
        let refused = fatek(&[&links[..], command].concat()).usage();
        assert!(refused.starts_with("error: this command takes one PLC, not 2 links\n"), "{command:?}: {refused}");
    }
    // An empty one among several is not left out in silence.
    for links in [["--link", "", "--link", "tcp://127.0.0.1:1"], ["--link", "tcp://127.0.0.1:1", "--link", ""]] {
        let empty = fatek(&[&links[..], &["--station", "1", "read", "R0"]].concat()).usage();
        assert!(empty.starts_with("error: ``"), "{empty}");
    }
    let capabilities = |args: &[&str]| {
        let mut command = Command::new(FATEK);
        run(command.args(args).args(["read", "R0"]).env("FATEK_CAPABILITIES", "pump.json")).usage()
    };
    let rule = "leave out --capabilities, and unset FATEK_CAPABILITIES";
    for (args, plcs) in [(&links[..], 2), (&["--link", "tcp://127.0.0.1:1", "--station", "1-4"][..], 4)] {
        let refused = capabilities(args);
        assert!(refused.contains(&format!("capabilities are those of one PLC, not of {plcs}: {rule}")), "{refused}");
    }
    let missing = fatek(&["--station", "1", "read", "R0"]).usage();
    assert!(missing.starts_with("error: no link: give --link URL, or set FATEK_LINK\n"), "{missing}");
}
