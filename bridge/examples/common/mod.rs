//! Parts of the programs that measure the bridge: processes, their figures, and simulated PLCs.

#![allow(unreachable_pub, reason = "each program has its own copy")]

use std::error::Error;
use std::io::{BufRead as _, BufReader};
use std::net::{SocketAddr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use fatek::register;
use fatek::sim::{Model, Plc};
use tokio::net::{TcpSocket, TcpStream};

pub type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

/// A process that is ended with this program.
pub struct Process(pub Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Serves PLCs and prints their addresses, one a line. Nothing answers at the last ones, not even to connect.
pub async fn serve(count: usize, dead: usize) -> Result<()> {
    let mut servers = Vec::new();
    let mut plcs = Vec::new();
    for _ in dead..count {
        let plc = Plc::with_model(Model::largest());
        let server = plc.serve("127.0.0.1:0").await?;
        println!("{}", server.local_addr());
        servers.push(server);
        plcs.push(plc);
    }
    let mut silent = Vec::new();
    for _ in 0..dead {
        let socket = TcpSocket::new_v4()?;
        socket.bind(SocketAddr::from(([127, 0, 0, 1], 0)))?;
        let listener = socket.listen(1)?;
        let address = listener.local_addr()?;
        // They fill its queue, and the system drops all further attempts.
        let first = [(); 4].map(|()| tokio::spawn(TcpStream::connect(address)));
        println!("{address}");
        silent.push((listener, first));
    }
    for count in 0_u16.. {
        tokio::time::sleep(Duration::from_millis(50)).await;
        for plc in &plcs {
            plc.write(register!("R0"), count)?;
        }
    }
    Ok(())
}

/// Serves simulated PLCs in a process of their own, as [`serve`] does. Returns it with their addresses.
pub fn start_plcs(count: usize, dead: usize) -> Result<(Process, Vec<String>)> {
    let mut command = Command::new(std::env::current_exe()?);
    command.args(["--serve", "--plcs", &count.to_string()]).stdout(Stdio::piped());
    if dead > 0 {
        command.args(["--dead", &dead.to_string()]);
    }
    let mut plcs = Process(command.spawn()?);
    let stdout = plcs.0.stdout.take().ok_or("no stdout of the PLCs")?;
    let addresses: Vec<String> = BufReader::new(stdout).lines().take(count).collect::<std::io::Result<_>>()?;
    Ok((plcs, addresses))
}

/// The bridge: this one, or `fatek-bridge` of the same profile.
pub fn program(bridge: Option<&Path>) -> Result<PathBuf> {
    match bridge {
        Some(program) => Ok(program.to_owned()),
        None => Ok(std::env::current_exe()?.parent().and_then(Path::parent).ok_or("no folder")?.join("fatek-bridge")),
    }
}

/// A nats-server with JetStream.
pub fn nats_server(port: u16, folder: &Path) -> Command {
    let mut command = Command::new("nats-server");
    command.args(["-js", "-a", "127.0.0.1", "-p", &port.to_string(), "-sd"]).arg(folder.join("nats"));
    command
}

/// Starts a server, and waits until it listens.
pub fn start_server(mut command: Command, port: u16) -> Result<Process> {
    let path = format!("{}:/usr/sbin", std::env::var("PATH").unwrap_or_default());
    let server = Process(command.env("PATH", path).stdout(Stdio::null()).stderr(Stdio::null()).spawn()?);
    let until = Instant::now() + Duration::from_secs(10);
    while std::net::TcpStream::connect(("127.0.0.1", port)).is_err() {
        if Instant::now() > until {
            return Err("the server does not start".into());
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    Ok(server)
}

/// A port of loopback that was free a moment ago.
pub fn free_port() -> Result<u16> {
    Ok(TcpListener::bind("127.0.0.1:0")?.local_addr()?.port())
}

/// The processor time of a process, in steps of 10 ms.
pub fn cpu_time(process: u32) -> Result<Duration> {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat"))?;
    // Behind the name, which may have blanks: state, and 10 fields before the times of user and system.
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    let ticks = |at: usize| -> Result<u64> { Ok(fields.get(at).ok_or("no time of the process")?.parse()?) };
    Ok(Duration::from_millis((ticks(11)? + ticks(12)?) * 10))
}

/// The memory of a process, in bytes.
pub fn memory(process: u32) -> Result<u64> {
    let status = std::fs::read_to_string(format!("/proc/{process}/status"))?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).ok_or("no memory of the process")?;
    Ok(line.trim().trim_end_matches(" kB").parse::<u64>()? * 1024)
}
