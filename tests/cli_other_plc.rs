//! Files of another PLC: told before and after writing, and written with `--force` only.
#![cfg(feature = "cli")]

mod process;

use fatek::element;
use fatek::sim::{Bus, Model, Plc, Server};
use fatek::wire::Framing;

use self::process::{Folder, Output, fatek};

/// Stations 1 and 2 of one model, and station 1 of three others.
struct Plants {
    own: Server,
    others: Vec<(Server, &'static str)>,
    /// The PLCs of all stations 1, and station 2 at last.
    plcs: Vec<Plc>,
}

impl Plants {
    async fn start() -> Self {
        let model = || Model::default().ladder_words(640);
        let (one, two) = (Plc::with_model(model()), Plc::with_model(model()));
        let bus = Bus::new().with_station(1, one.clone()).unwrap().with_station(2, two.clone()).unwrap();
        let own = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
        let (mut others, mut plcs) = (Vec::new(), vec![one]);
        for (model, difference) in [
            (model().os_version(3, 2), "OS version 3.2 instead of 3.1"),
            (model().main_unit(0), "main unit MA/MU instead of MC"),
            (model().io_points_code(9), "I/O points code 9 instead of "),
        ] {
            let plc = Plc::with_model(model);
            let bus = Bus::new().with_station(1, plc.clone()).unwrap();
            plcs.push(plc);
            others.push((Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap(), difference));
        }
        plcs.push(two);
        Self { own, others, plcs }
    }

    /// URL, station and difference of each PLC but the first.
    fn cases(&self) -> impl Iterator<Item = (String, &'static str, &'static str, &Plc)> {
        let others = self.others.iter().map(|(server, difference)| (url(server), "1", *difference));
        let cases = others.chain([(url(&self.own), "2", "station 2 instead of 1")]);
        cases.zip(&self.plcs[1..]).map(|((url, station, difference), plc)| (url, station, difference, plc))
    }

    /// Saves R0 to R9, all 0, then changes R5 of all PLCs.
    fn saved(&self, folder: &Folder) -> String {
        let file = folder.file("plant.backup");
        on(&url(&self.own), "1", &["backup", &file, "R0-R9", "-q"]).ok();
        self.plcs.iter().for_each(|plc| plc.write(element!("R5"), 9_u16).unwrap());
        file
    }
}

fn url(server: &Server) -> String {
    format!("tcp://{}", server.local_addr())
}

fn on(url: &str, station: &str, args: &[&str]) -> Output {
    fatek(&[&["--link", url, "--station", station], args].concat())
}

fn r5(plc: &Plc) -> String {
    format!("{:?}", plc.read(element!("R5")))
}

#[tokio::test(flavor = "multi_thread")]
async fn a_backup_of_another_plc_is_restored_with_force_only() {
    let (plants, folder) = (Plants::start().await, Folder::new("other-plc"));
    let file = plants.saved(&folder);
    let held = r5(&plants.plcs[0]);
    for (url, station, difference, plc) in plants.cases() {
        let restore = |args: &[&str]| on(&url, station, &[&["restore", &file], args].concat());
        // Before: status 0, and `1 of 10 elements would be written` without another word.
        let dry = restore(&["--dry-run", "--format", "csv"]);
        assert_eq!((dry.status, dry.stdout.as_str()), (7, "element,backup,plc\nR5,0,9\n"), "{dry:?}");
        assert!(dry.stderr.contains(&format!("plant.backup is of another PLC: {difference}")), "{dry:?}");
        assert!(dry.stderr.contains("\n1 of 10 elements would be written\n"), "{dry:?}");
        // Before: status 0, and R5 was written.
        let refused = restore(&["--yes"]);
        assert_eq!(refused.status, 7, "{refused:?}");
        let error = format!("error: the file is of another PLC: {difference}");
        assert!(refused.stderr.starts_with(&error), "{refused:?}");
        assert!(refused.stderr.ends_with("; to write it nevertheless, give --force\n"), "{refused:?}");
        assert_eq!(r5(plc), held, "nothing was written");

        let dry = restore(&["--dry-run", "--force"]);
        assert_eq!(dry.status, 0, "{dry:?}");
        assert!(dry.stderr.contains(difference), "{dry:?}");
        // The report tells it, too. Before: `10 elements compared, 1 differed, 1 written`.
        let forced = restore(&["--yes", "--force"]);
        let report =
            format!("\n10 elements compared, 1 differed, 1 written; another PLC than that of the backup: {difference}");
        assert!(forced.status == 0 && forced.stderr.contains(&report), "{forced:?}");
        assert_ne!(r5(plc), held);
        let compared = on(&url, station, &["backup", &file, "--compare"]);
        assert!(
            compared.status == 0 && compared.stderr.contains(&format!("another PLC: {difference}")),
            "{compared:?}"
        );
    }
    let own = on(&url(&plants.own), "1", &["restore", &file, "--yes"]);
    assert!(own.stderr.ends_with("\n10 elements compared, 1 differed, 1 written\n"), "{own:?}");
    own.ok();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_program_of_another_plc_is_written_with_force_only() {
    let (plants, folder) = (Plants::start().await, Folder::new("other-plc-program"));
    let file = folder.file("pump.program");
    on(&url(&plants.own), "1", &["program", "read", &file, "-q"]).ok();
    for (server, difference) in &plants.others {
        // Page 3 differs.
        let raw = folder.file("changed.bin");
        let mut bytes = vec![0; 11 * 128];
        bytes[..128].fill(0xFF);
        bytes[..6].copy_from_slice(b"FB00\x02\x80");
        bytes[3 * 128..4 * 128].fill(0x33);
        std::fs::write(&raw, bytes).unwrap();
        let program = |args: &[&str]| on(&url(server), "1", &[&["program"], args].concat());
        // A raw file states no PLC.
        program(&["write", "--raw", &raw, "--yes"]).ok();
        // Before: status 0, and the page was written.
        for args in [&["--yes"][..], &["--dry-run"]] {
            let refused = program(&[&["write", &file], args].concat());
            assert_eq!(refused.status, 7, "{refused:?}");
            let error = format!("error: the file is of another PLC: {difference}");
            assert!(refused.stderr.starts_with(&error), "{refused:?}");
            assert!(refused.stderr.ends_with("give --force\n"), "{refused:?}");
        }
        assert_eq!(program(&["verify", "--raw", &raw]).status, 0, "nothing was written");
        let dry = program(&["write", &file, "--dry-run", "--force"]);
        assert!(dry.status == 0 && dry.stderr.contains(difference), "{dry:?}");
        let forced = program(&["write", &file, "--yes", "--force"]);
        assert!(forced.status == 0 && forced.stderr.contains("1 of 11 pages written and compared"), "{forced:?}");
        assert!(forced.stderr.contains(&format!("pump.program is of another PLC: {difference}")), "{forced:?}");
        assert_eq!(program(&["verify", &file]).status, 0);
    }
}

#[tokio::test(flavor = "multi_thread")]
#[cfg(unix)]
async fn the_prompt_tells_that_the_file_is_of_another_plc() {
    use self::process::run_at_terminal_on;

    let (plants, folder) = (Plants::start().await, Folder::new("other-plc-prompt"));
    let (file, program) = (plants.saved(&folder), folder.file("pump.program"));
    on(&url(&plants.own), "1", &["program", "read", &program, "-q"]).ok();
    let (server, difference) = &plants.others[0];
    let held = r5(&plants.plcs[1]);
    for command in [&["restore", &file][..], &["program", "write", &program]] {
        // Before: a prompt without a word of it.
        let (status, shown) = run_at_terminal_on(&url(server), command, "");
        assert!(status == 7 && shown.contains("give --force") && !shown.contains("[y/N]"), "{shown}");
        let (status, shown) = run_at_terminal_on(&url(server), &[command, &["--force"]].concat(), "n\n");
        assert!(status == 1 && shown.contains(&format!("? It is of ANOTHER PLC: {difference}. [y/N] ")), "{shown}");
    }
    assert_eq!(r5(&plants.plcs[1]), held);
}
