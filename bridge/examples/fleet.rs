//! Measures a fleet: `cargo run --release --example fleet -- --help`.
//!
//! It starts simulated PLCs in a process of their own, a nats-server, and bridges that write batches to stdout. It
//! prints when the links are first polled, what server and members use, how soon the PLCs of a member that is killed
//! are polled by others, how soon a new member has its share, and the longest pause of a PLC while all members are
//! started again, one after the other.

mod common;

use std::collections::HashMap;
use std::io::{BufRead as _, BufReader};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::time::{Duration, Instant};

use clap::Parser;
use common::{Process, Result, cpu_time, free_port, memory, nats_server, program, serve, start_plcs, start_server};

/// Measures a fleet with simulated PLCs
#[derive(Debug, Parser)]
struct Args {
    /// Number of PLCs, each with a link of its own
    #[arg(long, default_value_t = 1000)]
    plcs: usize,
    /// PLCs among them that do not answer, not even to connect
    #[arg(long, default_value_t = 0)]
    dead: usize,
    /// Number of bridges
    #[arg(long, default_value_t = 3)]
    members: usize,
    /// Tags of each PLC
    #[arg(long, default_value_t = 4)]
    tags: usize,
    /// Period of the readings
    #[arg(long, default_value = "1s")]
    every: humantime::Duration,
    /// Lease
    #[arg(long, default_value = "3s")]
    lease: humantime::Duration,
    /// Time in which server and members are measured
    #[arg(long = "for", default_value = "20s")]
    duration: humantime::Duration,
    /// Members that are killed, one after the other
    #[arg(long, default_value_t = 5)]
    kills: usize,
    /// All members are started again, one after the other
    #[arg(long)]
    rolling: bool,
    /// Bridge; by default fatek-bridge of the same profile
    #[arg(long)]
    bridge: Option<PathBuf>,
    /// Serve the PLCs: used by this program itself
    #[arg(long, hide = true)]
    serve: bool,
}

impl Args {
    /// Number of PLCs that answer.
    fn answering(&self) -> usize {
        self.plcs - self.dead
    }
}

/// The time for anything.
const PATIENCE: Duration = Duration::from_secs(60);

/// A batch of a PLC, by a member.
struct Arrival {
    member: usize,
    plc: usize,
    at: Instant,
}

#[tokio::main]
async fn main() -> Result<()> {
    let args = Args::parse();
    if args.dead > args.plcs {
        return Err(format!("--dead {}: there are {} PLCs", args.dead, args.plcs).into());
    }
    if args.serve {
        return serve(args.plcs, args.dead).await;
    }
    // An error has several lines.
    Bench::start(args)?.measure().inspect_err(|error| eprintln!("{error}"))
}

struct Bench {
    args: Args,
    folder: tempfile::TempDir,
    program: PathBuf,
    _plcs: Process,
    server: Process,
    members: Vec<Process>,
    arrivals: (Sender<Arrival>, Receiver<Arrival>),
    /// The member that polled a PLC last, and when.
    last: HashMap<usize, Arrival>,
    /// The number of PLCs that each member polls while all of them run.
    shares: Vec<usize>,
    /// The longest pause of a PLC since it was set to zero.
    pause: Duration,
}

impl Bench {
    fn start(args: Args) -> Result<Self> {
        let folder = tempfile::tempdir()?;
        let (plcs, addresses) = start_plcs(args.plcs, args.dead)?;
        let port = free_port()?;
        let server = start_server(nats_server(port, folder.path()), port)?;
        std::fs::write(folder.path().join("plant.toml"), configuration(&args, &addresses, port))?;
        let program = program(args.bridge.as_deref())?;
        let made = Command::new(&program).args(["fleet", "init"]).arg(folder.path().join("plant.toml")).status()?;
        if !made.success() {
            return Err("the store cannot be made".into());
        }
        let (members, arrivals, last, shares) = (Vec::new(), channel(), HashMap::new(), Vec::new());
        let pause = Duration::ZERO;
        Ok(Self { args, folder, program, _plcs: plcs, server, members, arrivals, last, shares, pause })
    }

    fn measure(mut self) -> Result<()> {
        let Args { plcs, dead, members, lease, every, .. } = self.args;
        let answering = self.args.answering();
        println!("{plcs} PLCs, of which {dead} do not answer, each {every}; {members} members; lease {lease}");
        let begin = Instant::now();
        for member in 0..members {
            let process = self.start_member(member)?;
            self.members.push(process);
        }
        self.until("all are polled", |bench| bench.last.len() == answering)?;
        println!("all links first polled within {:.2?}", begin.elapsed());
        self.pass(*lease * 2);
        self.shares = (0..members).map(|member| self.plcs_of(member).len()).collect();
        println!("shares: {:?}", self.shares);
        self.costs()?;

        let (mut takeovers, mut shares) = (Vec::new(), Vec::new());
        for kill in 0..self.args.kills {
            let member = kill % members;
            let lost = self.plcs_of(member);
            let begin = Instant::now();
            self.members[member].0.kill()?;
            self.members[member].0.wait()?;
            let is_taken = |bench: &Self| lost.iter().all(|plc| bench.last[plc].member != member);
            self.until("all are taken over", is_taken)?;
            takeovers.push(begin.elapsed().as_secs_f64() / lease.as_secs_f64());
            let begin = Instant::now();
            self.members[member] = self.start_member(member)?;
            self.until("the new member has a share", |bench| bench.has_share(member))?;
            shares.push(begin.elapsed().as_secs_f64());
            self.pass(Duration::from_secs(1));
        }
        if !takeovers.is_empty() {
            println!("killed: last PLC polled by another member after {} leases", figures(&mut takeovers));
            println!("a new member has its share {} s after its start", figures(&mut shares));
        }
        if self.args.rolling {
            self.roll()?;
        }
        self.warnings()
    }

    /// Starts all members again, one after the other.
    fn roll(&mut self) -> Result<()> {
        self.pass(Duration::from_secs(2));
        self.pause = Duration::ZERO;
        self.pass(Duration::from_secs(10));
        let before = self.pause;
        for member in 0..self.args.members {
            let pid = self.members[member].0.id().to_string();
            Command::new("kill").args(["-s", "TERM", &pid]).status()?;
            let begin = Instant::now();
            while self.members[member].0.try_wait()?.is_none() {
                self.pass(Duration::from_millis(10));
            }
            let ended = begin.elapsed();
            self.members[member] = self.start_member(member)?;
            self.until("the new member has a share", |bench| bench.has_share(member))?;
            println!("member {member} has ended after {ended:.2?}, and has its share after {:.2?}", begin.elapsed());
            self.pass(Duration::from_secs(2));
        }
        println!("longest time between two batches of a PLC: {:.2?}; {before:.2?} without restarts", self.pause);
        Ok(())
    }

    /// Prints what server and members use.
    fn costs(&mut self) -> Result<()> {
        let processes: Vec<u32> = self.members.iter().chain([&self.server]).map(|process| process.0.id()).collect();
        let begin = Instant::now();
        let before: Vec<Duration> = processes.iter().map(|process| cpu_time(*process)).collect::<Result<_>>()?;
        self.pass(*self.args.duration);
        let time = begin.elapsed().as_secs_f64();
        for (at, process) in processes.iter().enumerate() {
            let name = if at < self.members.len() { format!("member {at}") } else { "nats-server".to_owned() };
            let cpu = (cpu_time(*process)? - before[at]).as_secs_f64() / time * 100.0;
            println!("{name}: {cpu:.1} % of a core, {:.0} MiB", memory(*process)? as f64 / 1_048_576.0);
        }
        Ok(())
    }

    fn start_member(&self, member: usize) -> Result<Process> {
        let state = self.folder.path().join(format!("member-{member}"));
        std::fs::create_dir_all(&state)?;
        let log = std::fs::File::options().create(true).append(true).open(state.join("log"))?;
        let mut command = Command::new(&self.program);
        command.arg("run").arg(self.folder.path().join("plant.toml")).args(["--id", &format!("hall-{member}")]);
        command.env("STATE_DIRECTORY", &state).stdout(Stdio::piped()).stderr(log);
        let mut process = Process(command.spawn()?);
        let stdout = process.0.stdout.take().ok_or("no stdout of the bridge")?;
        let arrivals = self.arrivals.0.clone();
        let answering = self.args.answering();
        std::thread::spawn(move || {
            for line in BufReader::new(stdout).lines().map_while(std::result::Result::ok) {
                let name = line.split("\"plc\":\"plc_").nth(1).and_then(|rest| rest.split('"').next());
                let plc = name.and_then(|name| name.parse().ok()).filter(|plc| *plc < answering);
                // A replay is no sign of a poll, and neither is a tag that is not good.
                if let Some(plc) = plc.filter(|_| !line.contains("\"hist\":true") && !line.contains("\"q\":")) {
                    let _ = arrivals.send(Arrival { member, plc, at: Instant::now() });
                }
            }
        });
        Ok(process)
    }

    /// Takes the batches that come in a time.
    fn pass(&mut self, time: Duration) {
        let end = Instant::now() + time;
        while let Ok(arrival) = self.arrivals.1.recv_timeout(end.saturating_duration_since(Instant::now())) {
            self.take(arrival);
        }
    }

    /// Takes batches until this holds.
    fn until(&mut self, what: &str, holds: impl Fn(&Self) -> bool) -> Result<()> {
        let begin = Instant::now();
        while !holds(self) {
            if begin.elapsed() > PATIENCE {
                return Err(format!("{what}: not within {PATIENCE:?}; {}", self.state()?).into());
            }
            // Thousands come in a second.
            self.pass(Duration::from_millis(5));
        }
        Ok(())
    }

    fn take(&mut self, arrival: Arrival) {
        if let Some(before) = self.last.get(&arrival.plc) {
            self.pause = self.pause.max(arrival.at.saturating_duration_since(before.at));
        }
        self.last.insert(arrival.plc, arrival);
    }

    /// Prints the warnings in the logs of the members, but for those of PLCs that do not answer: without a fault from
    /// outside there are none.
    fn warnings(&self) -> Result<()> {
        let mut warnings = Vec::new();
        for member in 0..self.args.members {
            let log = std::fs::read_to_string(self.folder.path().join(format!("member-{member}/log")))?;
            let is_warning = |line: &&str| line.contains(" WARN") || line.contains("ERROR");
            let is_expected =
                |line: &&str| self.args.dead > 0 && line.contains("availability") && self.is_of_dead(line);
            let lines = log.lines().filter(is_warning).filter(|line| !is_expected(line));
            warnings.extend(lines.map(|line| format!("member {member}: {line}")));
        }
        println!("warnings in the logs of the members: {}", warnings.len());
        warnings.iter().take(5).for_each(|line| println!("{line}"));
        Ok(())
    }

    /// Returns whether a line says that a PLC does not answer which is not there, or more of them.
    fn is_of_dead(&self, line: &str) -> bool {
        let number =
            |text: &str| text.chars().take_while(char::is_ascii_digit).collect::<String>().parse::<usize>().ok();
        match line.split_once("plc_").map(|(_, rest)| number(rest)) {
            Some(plc) => plc.is_some_and(|plc| plc >= self.args.answering()),
            None => {
                let offline = line.split_once("answer: ").and_then(|(_, rest)| number(rest));
                offline.is_some_and(|offline| offline <= self.args.dead)
            }
        }
    }

    /// The members as the store has them, how many PLCs each of them polls, and the ends of their logs.
    fn state(&self) -> Result<String> {
        let plant = self.folder.path().join("plant.toml");
        let status = Command::new(&self.program).args(["fleet", "status"]).arg(plant).output()?;
        let head = |text: &str| text.lines().take(self.args.members + 2).collect::<Vec<_>>().join("\n");
        let mut text = format!("the fleet:\n{}\n", head(&String::from_utf8_lossy(&status.stdout)));
        for member in 0..self.args.members {
            let log = std::fs::read_to_string(self.folder.path().join(format!("member-{member}/log")))?;
            let end: Vec<&str> = log.lines().rev().take(8).collect();
            let polled = self.plcs_of(member).len();
            text += &format!("member {member} polls {polled}; the end of its log, backwards:\n{}\n", end.join("\n"));
        }
        Ok(text)
    }

    fn plcs_of(&self, member: usize) -> Vec<usize> {
        self.last.values().filter(|last| last.member == member).map(|last| last.plc).collect()
    }

    /// Returns whether a member polls as many PLCs as at first: placement is the same for the same members.
    fn has_share(&self, member: usize) -> bool {
        self.plcs_of(member).len() >= self.shares[member]
    }
}

/// Median and maximum.
fn figures(values: &mut [f64]) -> String {
    values.sort_unstable_by(f64::total_cmp);
    let (median, last) = (values[values.len() / 2], values[values.len() - 1]);
    format!("{median:.2} (median), {last:.2} (worst of {})", values.len())
}

fn configuration(args: &Args, addresses: &[String], port: u16) -> String {
    let mut text = format!(
        "[bridge]\nhttp = '127.0.0.1:0'\n[stdout]\n[nats]\nurl = 'nats://127.0.0.1:{port}'\n\
         [fleet]\nid = 'load'\nlease = '{}'\n[class]\nall = {{ every = '{}' }}\n[template.all]\n",
        args.lease, args.every
    );
    for tag in 0..args.tags {
        text += &format!("value_{tag} = {{ at = 'R{tag}:i16', class = 'all' }}\n");
    }
    for (plc, address) in addresses.iter().enumerate() {
        text += &format!("[plc.plc_{plc}]\nlink = 'tcp://{address}'\nstation = 1\nuse = ['all']\n");
    }
    text
}
