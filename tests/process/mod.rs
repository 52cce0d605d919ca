//! Runs the command line as a process, against simulated and scripted PLCs.
#![allow(dead_code, reason = "each test program uses a part of it")]

use std::fs;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::Duration;

pub(crate) const FATEK: &str = env!("CARGO_BIN_EXE_fatek");

/// Exit status and output of a process.
#[derive(Debug)]
pub(crate) struct Output {
    pub(crate) status: i32,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

impl Output {
    /// Returns stdout. Panics unless the status is 0.
    #[track_caller]
    pub(crate) fn ok(self) -> String {
        assert_eq!(self.status, 0, "{self:?}");
        self.stdout
    }

    /// Returns stderr. Panics unless the status is 2 (usage error) and stdout is empty.
    #[track_caller]
    pub(crate) fn usage(self) -> String {
        assert_eq!((self.status, self.stdout.as_str()), (2, ""), "{self:?}");
        self.stderr
    }
}

pub(crate) fn fatek(args: &[&str]) -> Output {
    run(Command::new(FATEK).args(args).env_remove("FATEK_LINK").env_remove("FATEK_STATION"))
}

pub(crate) fn run(command: &mut Command) -> Output {
    let output = command.env_remove("RUST_LOG").output().unwrap();
    Output {
        status: output.status.code().expect("no signal"),
        stdout: String::from_utf8(output.stdout).unwrap(),
        stderr: String::from_utf8(output.stderr).unwrap(),
    }
}

/// A running `fatek sim` process, killed on drop.
pub(crate) struct Sim {
    pub(crate) child: Child,
    pub(crate) stdout: BufReader<std::process::ChildStdout>,
    /// Endpoint URL, with the framing.
    pub(crate) url: String,
}

impl Sim {
    pub(crate) fn start(args: &[&str]) -> Self {
        let mut child = Command::new(FATEK).arg("sim").args(args).stdout(Stdio::piped()).spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let mut line = String::new();
        stdout.read_line(&mut line).unwrap();
        let url = line.strip_prefix("listening ").and_then(|line| line.strip_suffix('\n'));
        let mut url = url.unwrap_or_else(|| panic!("{line:?}")).to_owned();
        if args.contains(&"binary") {
            url += "?framing=binary";
        }
        Self { child, stdout, url }
    }

    /// Runs the command line against station 1.
    pub(crate) fn fatek(&self, args: &[&str]) -> Output {
        fatek(&[&["--link", &self.url, "--station", "1"], args].concat())
    }
}

impl Drop for Sim {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// A scripted PLC on TCP: answers every request with `reply` and records what it received. Echoes
/// loop-backs.
pub(crate) struct ScriptedPlc {
    pub(crate) url: String,
    recorded: Arc<Mutex<Recorded>>,
}

#[derive(Default)]
struct Recorded {
    connections: usize,
    received: Vec<u8>,
}

impl ScriptedPlc {
    pub(crate) fn start(reply: impl Fn(&[u8]) -> Vec<u8> + Send + Sync + 'static) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let url = format!("tcp://{}", listener.local_addr().unwrap());
        let recorded = Arc::<Mutex<Recorded>>::default();
        let (shared, reply) = (recorded.clone(), Arc::new(reply));
        // The thread ends with the process.
        thread::spawn(move || {
            for stream in listener.incoming() {
                shared.lock().unwrap().connections += 1;
                let (shared, reply) = (shared.clone(), reply.clone());
                thread::spawn(move || Self::serve(stream.unwrap(), &shared, &*reply));
            }
        });
        Self { url, recorded }
    }

    /// Starts a proxy before a simulator. Requests that `pass` rejects get no reply.
    pub(crate) fn proxy(sim: &Sim, pass: impl Fn(&[u8]) -> bool + Send + Sync + 'static) -> Self {
        let plc = TcpStream::connect(sim.url.strip_prefix("tcp://").unwrap()).unwrap();
        plc.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
        let plc = Mutex::new(plc);
        Self::start(move |request| {
            let mut reply = vec![];
            if pass(request) {
                let mut plc = plc.lock().unwrap();
                plc.write_all(request).unwrap();
                let mut byte = [0];
                while reply.last() != Some(&0x03) {
                    plc.read_exact(&mut byte).unwrap();
                    reply.push(byte[0]);
                }
            }
            reply
        })
    }

    fn serve(mut stream: TcpStream, recorded: &Mutex<Recorded>, reply: &dyn Fn(&[u8]) -> Vec<u8>) {
        let mut buffer = [0; 1024];
        while let Ok(len @ 1..) = stream.read(&mut buffer) {
            recorded.lock().unwrap().received.extend_from_slice(&buffer[..len]);
            let is_loop_back = buffer[..len].get(3..5) == Some(b"4E");
            let bytes = if is_loop_back { buffer[..len].to_vec() } else { reply(&buffer[..len]) };
            if stream.write_all(&bytes).is_err() {
                return;
            }
        }
    }

    /// Runs the command line against station 1.
    pub(crate) fn fatek(&self, args: &[&str]) -> Output {
        fatek(&[&["--link", &self.url, "--station", "1"], args].concat())
    }

    pub(crate) fn connections(&self) -> usize {
        self.recorded.lock().unwrap().connections
    }

    pub(crate) fn received(&self) -> Vec<u8> {
        self.recorded.lock().unwrap().received.clone()
    }
}

/// Runs the command line, sends a signal such as `INT` when `when` holds of the received bytes, and
/// returns status and stderr.
#[cfg(unix)]
pub(crate) fn run_and_signal(
    plc: &ScriptedPlc,
    signal: &str,
    args: &[&str],
    when: impl Fn(&[u8]) -> bool,
) -> (i32, String) {
    let mut command = Command::new(FATEK);
    command.args(["--link", &plc.url, "--station", "1", "--timeout", "60s"]).args(args);
    let child = command.stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    while !when(&plc.received()) {
        thread::sleep(Duration::from_millis(5));
    }
    Command::new("kill").args([&format!("-{signal}"), &child.id().to_string()]).status().unwrap();
    let ended = child.wait_with_output().unwrap();
    (ended.status.code().expect("no signal"), String::from_utf8(ended.stderr).unwrap())
}

/// Encodes a frame of the ASCII framing.
pub(crate) fn ascii(content: &str) -> Vec<u8> {
    let mut frame = format!("\x02{content}").into_bytes();
    let lrc = frame.iter().fold(0_u8, |sum, &byte| sum.wrapping_add(byte));
    frame.extend_from_slice(format!("{lrc:02X}\x03").as_bytes());
    frame
}

/// Runs the command line on a pseudo-terminal, answers its question, and returns status and output.
#[cfg(unix)]
pub(crate) fn run_at_terminal(sim: &Sim, args: &[&str], answer: &str) -> (i32, String) {
    run_at_terminal_on(&sim.url, args, answer)
}

/// The same against station 1 of any URL.
#[cfg(unix)]
pub(crate) fn run_at_terminal_on(url: &str, args: &[&str], answer: &str) -> (i32, String) {
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
    use std::fs::{File, OpenOptions};

    let terminal = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&terminal).unwrap();
    unlockpt(&terminal).unwrap();
    let path = ptsname(&terminal, Vec::new()).unwrap().into_string().unwrap();
    let mut terminal = File::from(terminal);
    let side = || Stdio::from(OpenOptions::new().read(true).write(true).open(&path).unwrap());
    let mut command = Command::new(FATEK);
    command.args(["--link", url, "--station", "1"]).args(args);
    command.env("TERM", "xterm").env("NO_COLOR", "1");
    let mut child = command.stdin(side()).stdout(side()).stderr(side()).spawn().unwrap();
    // Only the child holds the other side now, so reading ends with the child.
    drop(command);
    let (mut shown, mut answered) = (String::new(), false);
    let mut buffer = [0; 4096];
    while let Ok(len @ 1..) = terminal.read(&mut buffer) {
        shown += &String::from_utf8_lossy(&buffer[..len]);
        if !answered && shown.ends_with("[y/N] ") {
            terminal.write_all(answer.as_bytes()).unwrap();
            answered = true;
        }
    }
    assert!(answered || answer.is_empty(), "{shown}");
    (child.wait().unwrap().code().unwrap(), shown)
}

/// A temporary folder, removed on drop.
pub(crate) struct Folder(pub(crate) PathBuf);

impl Folder {
    pub(crate) fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("fatek-cli-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir(&path).unwrap();
        Self(path)
    }

    pub(crate) fn file(&self, name: &str) -> String {
        self.0.join(name).to_str().unwrap().to_owned()
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}
