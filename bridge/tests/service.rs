//! The bridge as a service of systemd: the messages that it sends to the socket of the service manager.
//!
//! Seen without one of the messages: without `READY=1`, `STOPPING=1` or signs of life no message came within 30 s;
//! without `RELOADING=1` the first message after SIGHUP was `READY=1`.

mod common;

use std::io::ErrorKind;
use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::{Duration, Instant};

use common::bridge::{Bridge, PATIENCE, write_config};
use tempfile::TempDir;

/// The PLC does not answer: nothing of this depends on it.
const CONFIG: &str = "[bridge]\nhttp = '127.0.0.1:0'\n[plc.mixer]\nlink = 'tcp://127.0.0.1:9'\nstation = 1\n\
                      tag.level = 'R5'\n";

/// A service manager with the folder of the service.
struct Manager {
    folder: TempDir,
    socket: UnixDatagram,
}

impl Manager {
    fn new() -> Self {
        let folder = TempDir::new().unwrap();
        let socket = UnixDatagram::bind(folder.path().join("notify")).unwrap();
        Self { folder, socket }
    }

    /// Starts the service. `watchdog`: the variables of systemd for `WatchdogSec=`.
    fn start(&self, config: &str, watchdog: &[(&str, &str)]) -> Bridge {
        let config = write_config(self.folder.path(), config);
        let mut command = Command::new(env!("CARGO_BIN_EXE_fatek-bridge"));
        command.arg("run").arg(config).env_remove("RUST_LOG").env_remove("WATCHDOG_PID").env_remove("WATCHDOG_USEC");
        command.env("STATE_DIRECTORY", self.folder.path()).env("NOTIFY_SOCKET", self.folder.path().join("notify"));
        command.envs(watchdog.iter().copied());
        Bridge::spawn(command)
    }

    /// The next message, as lines; `None`: none came in time.
    fn message_within(&self, time: Duration) -> Option<Vec<String>> {
        self.socket.set_read_timeout(Some(time)).unwrap();
        let mut bytes = [0; 4096];
        match self.socket.recv(&mut bytes) {
            Ok(len) => Some(std::str::from_utf8(&bytes[..len]).unwrap().lines().map(str::to_owned).collect()),
            Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut) => None,
            Err(error) => panic!("{error}"),
        }
    }

    fn message(&self) -> Vec<String> {
        self.message_within(PATIENCE).unwrap_or_else(|| panic!("no message within {PATIENCE:?}"))
    }

    /// Takes the two messages of a reload, and returns the time of its begin on the monotonic clock.
    fn reload(&self) -> Duration {
        let begin = self.message();
        assert_eq!((begin.len(), begin[0].as_str()), (2, "RELOADING=1"), "{begin:?}");
        let time = begin[1].strip_prefix("MONOTONIC_USEC=").unwrap();
        assert_eq!(self.message(), ["READY=1"]);
        Duration::from_micros(time.parse().unwrap())
    }
}

#[test]
fn start_reload_and_end_are_reported() {
    let manager = Manager::new();
    let mut bridge = manager.start(CONFIG, &[]);
    assert_eq!(manager.message(), ["READY=1"]);

    let before = Instant::now();
    write_config(manager.folder.path(), &format!("{CONFIG}tag.alarm = 'M7'\n"));
    bridge.signal("HUP");
    let first = manager.reload();
    bridge.wait_for_log("reloaded; PLCs: ");
    // A file with faults ends its reload, too: systemd would wait for it.
    write_config(manager.folder.path(), "[plc.mixer]\n");
    bridge.signal("HUP");
    let second = manager.reload();
    bridge.wait_for_log("the configuration was not reloaded, and nothing has changed");
    assert!(first < second && second - first < before.elapsed(), "{first:?} {second:?}");

    bridge.signal("TERM");
    assert_eq!(manager.message(), ["STOPPING=1"]);
    assert!(bridge.wait().success(), "{}", bridge.log());
    assert_eq!(manager.message_within(Duration::from_millis(1)), None);
}

#[test]
fn signs_of_life_come_within_the_time_of_the_watchdog() {
    let limit = Duration::from_secs(2);
    let manager = Manager::new();
    let bridge = manager.start(CONFIG, &[("WATCHDOG_USEC", "2000000")]);
    // The first sign can come before it is ready.
    let mut last = Instant::now();
    let (mut signs, mut longest) = (0, Duration::ZERO);
    while signs < 5 {
        let message = manager.message();
        if message == ["WATCHDOG=1"] {
            signs += 1;
            longest = longest.max(last.elapsed());
            last = Instant::now();
        } else {
            assert_eq!(message, ["READY=1"]);
            last = Instant::now();
        }
    }
    println!("longest time between two signs of life: {longest:?} of {limit:?}");
    assert!(longest < limit, "{longest:?}; {}", bridge.log());
}

#[test]
fn without_a_watchdog_of_its_own_there_is_no_sign_of_life() {
    let manager = Manager::new();
    // The variables are those of another process, as in a script that starts the bridge.
    let others = ("WATCHDOG_PID", "1");
    for watchdog in [&[][..], &[("WATCHDOG_USEC", "20000"), others], &[("WATCHDOG_USEC", "0")]] {
        let mut bridge = manager.start(CONFIG, watchdog);
        assert_eq!(manager.message(), ["READY=1"]);
        assert_eq!(manager.message_within(Duration::from_millis(300)), None, "{watchdog:?}");
        bridge.signal("TERM");
        assert_eq!(manager.message(), ["STOPPING=1"]);
        assert!(bridge.wait().success());
    }
}

#[test]
fn a_configuration_with_faults_is_never_ready() {
    let manager = Manager::new();
    let mut bridge = manager.start("[plc.mixer]\n", &[]);
    // The unit does not start it again with this status.
    assert_eq!(bridge.wait().code(), Some(2), "{}", bridge.log());
    assert_eq!(manager.message_within(Duration::from_millis(1)), None);
}

#[test]
fn a_service_manager_that_is_gone_does_no_harm() {
    let manager = Manager::new();
    let mut bridge = manager.start(CONFIG, &[("WATCHDOG_USEC", "20000")]);
    assert_eq!(manager.message().len(), 1);
    std::fs::remove_file(manager.folder.path().join("notify")).unwrap();
    bridge.wait_for_log("the service manager cannot be told");
    bridge.signal("TERM");
    assert!(bridge.wait().success(), "{}", bridge.log());
}
