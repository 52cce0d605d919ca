//! The second process with the PLCs. It exits at the end of its standard input, so it never
//! outlives its parent.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use fatek::sim;
use fatek::wire::Framing;
use tokio::net::{TcpListener, TcpSocket};

use crate::options::Options;
use crate::{Result, plc, process};

/// Argument that starts this program as the simulator.
pub(crate) const FLAG: &str = "--simulator";

/// Handle of the simulator process, killed on drop.
pub(crate) struct Simulator {
    child: Child,
    plcs: u32,
    /// One port for all PLCs, or one per PLC.
    ports: Vec<u16>,
}

impl Simulator {
    pub(crate) async fn start(options: &Options) -> Result<Self> {
        let listeners = if options.one_port_each { options.plcs } else { 1 };
        Self::spawn(options, vec![0; listeners as usize]).await
    }

    /// Starts the simulator again with the same ports.
    pub(crate) async fn restart(&mut self, options: &Options) -> Result<()> {
        *self = Self::spawn(options, self.ports.clone()).await?;
        Ok(())
    }

    async fn spawn(options: &Options, ports: Vec<u16>) -> Result<Self> {
        let plcs = options.plcs;
        let starting = tokio::task::spawn_blocking(move || -> std::io::Result<_> {
            let program = std::env::current_exe()?;
            let mut command = Command::new(program);
            let mut child =
                command.arg(FLAG).arg(plcs.to_string()).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
            if let Some(stdin) = &mut child.stdin {
                writeln!(stdin, "{}", join(&ports))?;
            }
            let mut line = String::new();
            if let Some(stdout) = child.stdout.take() {
                BufReader::new(stdout).read_line(&mut line)?;
            }
            Ok((child, line))
        });
        let (child, line) = starting.await??;
        // From here on the child is killed on drop.
        let mut simulator = Self { child, plcs, ports: Vec::new() };
        simulator.ports = split(&line).map_err(|_| "the simulator did not start")?;
        Ok(simulator)
    }

    pub(crate) fn process(&self) -> u32 {
        self.child.id()
    }

    /// Addresses of the PLCs.
    pub(crate) fn endpoints(&self) -> impl Iterator<Item = SocketAddr> {
        (0..self.plcs).map(|n| plc::address(n, &self.ports))
    }

    /// Kills the process without an orderly end of its connections.
    pub(crate) fn kill(&mut self) -> std::io::Result<()> {
        self.child.kill()?;
        self.child.wait().map(drop)
    }
}

impl Drop for Simulator {
    fn drop(&mut self) {
        // Fails if the process has already exited, which is no problem.
        let _ = self.kill();
    }
}

/// Runs the simulator until the end of standard input.
pub(crate) async fn run() -> Result<()> {
    let plcs: u32 = std::env::args().nth(2).ok_or("the number of PLCs is missing")?.parse()?;
    let mut line = String::new();
    std::io::stdin().lock().read_line(&mut line)?;
    let ports = split(&line)?;
    process::allow_open_files(u64::from(plcs) + ports.len() as u64 + 100)?;
    let mut bound = Vec::new();
    for (n, &port) in ports.iter().enumerate() {
        let shared = ports.len() == 1;
        let address = if shared { Ipv4Addr::UNSPECIFIED } else { Ipv4Addr::LOCALHOST };
        let listener = listen((address, port).into())?;
        bound.push(listener.local_addr()?.port());
        tokio::spawn(accept(listener, (!shared).then_some(n as u32), plcs));
    }
    println!("{}", join(&bound));
    // Nothing more is written to standard input, so this waits for the end of the parent.
    tokio::task::spawn_blocking(|| std::io::stdin().lock().read_to_end(&mut Vec::new())).await??;
    Ok(())
}

fn listen(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = TcpSocket::new_v4()?;
    // Connections of the killed simulator stay in TIME_WAIT for a while.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(4096)
}

/// Serves the connections of one PLC, or of all PLCs, distinguished by the destination address.
async fn accept(listener: TcpListener, only: Option<u32>, plcs: u32) {
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            // A temporary error, such as too many open files.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let destination = stream.local_addr().map(|address| address.ip());
        let number = match (only, destination) {
            (Some(n), _) => Some(n),
            (None, Ok(IpAddr::V4(address))) => plc::number(address),
            (None, Ok(IpAddr::V6(_)) | Err(_)) => None,
        };
        // The port is reachable from the network; only local clients are served.
        let Some(n) = number.filter(|&n| n < plcs && peer.ip().is_loopback()) else { continue };
        let Ok(bus) = plc::bus(n) else { continue };
        // A reply is one small segment that must not be delayed.
        let _ = stream.set_nodelay(true);
        tokio::spawn(sim::serve(stream, bus, Framing::Ascii));
    }
}

fn join(ports: &[u16]) -> String {
    ports.iter().map(u16::to_string).collect::<Vec<_>>().join(",")
}

fn split(line: &str) -> Result<Vec<u16>> {
    Ok(line.trim().split(',').map(str::parse).collect::<std::result::Result<_, _>>()?)
}
