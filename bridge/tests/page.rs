//! The page in a browser: headless Chromium, driven by `tests/page/test.mjs`, against a bridge with simulated PLCs.
//!
//! On a machine that is busy its waits of 60 s are too short: `FATEK_BRIDGE_SKIP_PAGE=1` leaves it out.
//! Needs node, npm and chromium. Playwright's driver and axe are installed from `tests/page/package-lock.json`.
//!
//! `PAGE_FILES=$PWD/src/http/page` takes the files of the page from there, so that a change needs no build.
//! `FATEK_BRIDGE_PAGE_SCRIPT` names another script to run in place of `test.mjs`.

mod common;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::Duration;

use common::http::{HttpBridge, command};
use common::plc::SimPlc;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStdin, Command};
use tokio::time::{sleep, timeout};

/// The time for all checks in the browser.
const LIMIT: Duration = Duration::from_secs(900);
/// The tags of the PLC that shows that many tags can be handled.
const MANY: usize = 9_000;

/// The bridge with its PLCs, as the script controls it.
struct Stage {
    bridge: HttpBridge,
    mixer: SimPlc,
    _others: Vec<SimPlc>,
}

impl Stage {
    async fn start() -> Self {
        let mixer = SimPlc::start(&[
            ("R5:i16*0.1", "sine(20..80,20s)"),
            ("R6:i16*0.1", "ramp(0..100,15s)"),
            ("DR100:u32", "counter(200ms)"),
            ("R200:f32", "random(39.5..40.5,1s)"),
            ("M7", "square(0..1,6s)"),
        ])
        .await;
        for (register, word) in (10..).zip("Mixer 2 <b>".as_bytes().chunks(2)) {
            let [low, high] = [0, 1].map(|index| u16::from(*word.get(index).unwrap_or(&0)));
            mixer.plc.write(fatek::Register::r(register), low | (high << 8)).unwrap();
        }
        let boiler = SimPlc::start(&[("R0:i16*0.1", "sine(60..95,30s)"), ("R1:i16*0.01", "random(1.8..2.2,2s)")]).await;
        let store = SimPlc::start(&[]).await;
        let plc = store.plc.clone();
        // Movements of thousands of registers would cost more than all the rest.
        tokio::spawn(async move {
            for value in (0..u16::MAX).cycle() {
                (0..3840).for_each(|register| plc.write(fatek::Register::r(register), value).unwrap());
                sleep(Duration::from_secs(1)).await;
            }
        });
        let mut config = format!(
            r#"
[bridge]
id = "hall-2"
http = "HTTP"
[class]
fast = {{ every = "250ms", stale_after = "1s" }}
slow = {{ every = "2s" }}
[plc.mixer]
link = "{}"
station = 1
tag.level = {{ at = "R5:i16*0.1", class = "fast", unit = "%", comment = "Level of the tank" }}
tag.speed = {{ at = "R6:i16*0.1", class = "fast", unit = "rpm" }}
tag.total = {{ at = "DR100:u32", class = "fast", unit = "l", comment = "<img src=x onerror=alert(1)>" }}
tag.setpoint = {{ at = "R200:f32", class = "fast", unit = "°C", write = {{ min = 0.0, max = 80.0 }} }}
tag.running = {{ at = "M7", class = "fast", comment = "Motor on" }}
tag.start = {{ at = "M100", class = "fast", write = {{ pulse = "500ms" }} }}
tag.name = {{ at = "R10-R19:text", class = "slow" }}
tag.recipe = {{ at = "R30-R39", class = "slow" }}
[plc.boiler]
link = "{}"
station = 1
tag.temperature = {{ at = "R0:i16*0.1", class = "fast", unit = "°C" }}
tag.pressure = {{ at = "R1:i16*0.01", class = "fast", unit = "bar" }}
[stdout]
[plc.store]
link = "{}"
station = 1
"#,
            mixer.link(),
            boiler.link(),
            store.link(),
        );
        let places = (0..3840).map(|place| format!("R{place}")).chain((0..3840).map(|place| format!("R{place}:i16")));
        let places = places.chain((0..1900).map(|place| format!("M{place}")));
        for (number, place) in places.take(MANY).enumerate() {
            writeln!(config, "tag.place-{number:04} = {{ at = \"{place}\", class = \"slow\" }}").unwrap();
        }
        let bridge = HttpBridge::start(&config).await;
        Self { bridge, mixer, _others: vec![boiler, store] }
    }

    /// Does what the script asks for.
    async fn act(&mut self, request: &str) {
        match request {
            "stop mixer" => self.mixer.stop().await,
            "resume mixer" => self.mixer.resume().await,
            "kill bridge" => self.bridge.child.kill().await.unwrap(),
            "start bridge" => {
                self.bridge.child = command(&self.bridge.folder().join("bridge.toml")).spawn().unwrap();
            }
            other => panic!("the script asks for {other}"),
        }
    }
}

/// Returns whether programs are there; without them the test is skipped, unless all are required.
fn has_programs(programs: &[&str]) -> bool {
    let is_missing = |program: &&&str| {
        let mut version = std::process::Command::new(program);
        version.arg("--version").stdout(Stdio::null()).stderr(Stdio::null()).status().is_err()
    };
    let Some(missing) = programs.iter().find(is_missing) else { return true };
    assert!(std::env::var_os("FATEK_BRIDGE_REQUIRE_SERVERS").is_none(), "{missing} is not installed");
    println!("skipped: {missing} is not installed");
    false
}

/// Installs the packages of the lock file, unless they are there.
async fn install(folder: &Path) {
    let mut npm = Command::new("npm");
    npm.args(["ci", "--no-audit", "--no-fund", "--ignore-scripts"]).current_dir(folder).stdout(Stdio::null());
    let lock = |path: &str| std::fs::read_to_string(folder.join(path)).ok();
    let is_there =
        ["playwright-core", "axe-core"].iter().all(|name| lock(&format!("node_modules/{name}/package.json")).is_some());
    if !is_there {
        assert!(npm.status().await.unwrap().success(), "npm ci failed");
    }
}

/// Does what the script asks for by lines that begin with `@`, until it ends.
async fn serve(script: &mut Child, stage: &mut Stage, stdin: &mut ChildStdin) {
    let mut lines = BufReader::new(script.stdout.take().unwrap()).lines();
    while let Some(line) = lines.next_line().await.unwrap() {
        match line.strip_prefix('@') {
            None => println!("{line}"),
            Some(request) => {
                stage.act(request).await;
                stdin.write_all(b"done\n").await.unwrap();
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_page_works_in_a_browser() {
    if std::env::var_os("FATEK_BRIDGE_SKIP_PAGE").is_some() {
        println!("skipped: FATEK_BRIDGE_SKIP_PAGE is set");
        return;
    }
    if !has_programs(&["node", "npm", "chromium"]) {
        return;
    }
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("tests/page");
    install(&folder).await;
    let mut stage = Stage::start().await;
    let name = std::env::var("FATEK_BRIDGE_PAGE_SCRIPT").unwrap_or_else(|_| "test.mjs".to_owned());
    let mut script = Command::new("node");
    script.arg(name).arg(format!("http://{}/", stage.bridge.http)).current_dir(folder);
    let mut script = script.stdin(Stdio::piped()).stdout(Stdio::piped()).kill_on_drop(true).spawn().unwrap();
    let mut stdin = script.stdin.take().unwrap();
    timeout(LIMIT, serve(&mut script, &mut stage, &mut stdin)).await.expect("the script hangs");
    assert!(script.wait().await.unwrap().success(), "checks of the page failed: see above");
}
