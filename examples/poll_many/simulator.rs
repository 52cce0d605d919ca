//! The second process: the PLCs. It ends with the process that has started it, however that ends, because its standard
//! input does.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use fatek::sim;
use fatek::wire::Framing;
use tokio::net::{TcpListener, TcpSocket};

use crate::options::Options;
use crate::{Result, plc, process};

/// Makes this program the simulator.
pub(crate) const FLAG: &str = "--simulator";

/// The simulator, as seen from the process that polls. Dropping it kills it.
pub(crate) struct Simulator {
    child: Child,
    plcs: u32,
    /// One for all PLCs, or one each.
    ports: Vec<u16>,
}

impl Simulator {
    pub(crate) async fn start(options: &Options) -> Result<Self> {
        let listeners = if options.one_port_each { options.plcs } else { 1 };
        Self::start_at(options, vec![0; listeners as usize]).await
    }

    /// Starts it again where it was.
    pub(crate) async fn start_again(&mut self, options: &Options) -> Result<()> {
        *self = Self::start_at(options, self.ports.clone()).await?;
        Ok(())
    }

    async fn start_at(options: &Options, ports: Vec<u16>) -> Result<Self> {
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
        // From here on, it is killed whatever happens.
        let mut simulator = Self { child, plcs, ports: Vec::new() };
        simulator.ports = split(&line).map_err(|_| "the simulator has not started")?;
        Ok(simulator)
    }

    pub(crate) fn process(&self) -> u32 {
        self.child.id()
    }

    /// Where the PLCs are.
    pub(crate) fn endpoints(&self) -> impl Iterator<Item = SocketAddr> {
        (0..self.plcs).map(|n| plc::address(n, &self.ports))
    }

    /// Kills it, so that it has no time to say good-bye to anybody.
    pub(crate) fn kill(&mut self) -> std::io::Result<()> {
        self.child.kill()?;
        self.child.wait().map(drop)
    }
}

impl Drop for Simulator {
    fn drop(&mut self) {
        // If it has ended by itself, all is well.
        let _ = self.kill();
    }
}

/// The simulator itself.
pub(crate) async fn run() -> Result<()> {
    let plcs: u32 = std::env::args().nth(2).ok_or("how many PLCs?")?.parse()?;
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
    // Nothing is written to it any more, so this waits for its end.
    tokio::task::spawn_blocking(|| std::io::stdin().lock().read_to_end(&mut Vec::new())).await??;
    Ok(())
}

fn listen(address: SocketAddr) -> std::io::Result<TcpListener> {
    let socket = TcpSocket::new_v4()?;
    // The connections of a simulator that was killed linger for a while.
    socket.set_reuseaddr(true)?;
    socket.bind(address)?;
    socket.listen(4096)
}

/// Serves the connections of one PLC, or of all, which differ by the address that was dialled.
async fn accept(listener: TcpListener, only: Option<u32>, plcs: u32) {
    loop {
        let Ok((stream, peer)) = listener.accept().await else {
            // Such as too many open files: it takes a moment to pass.
            tokio::time::sleep(Duration::from_millis(100)).await;
            continue;
        };
        let dialled = stream.local_addr().map(|address| address.ip());
        let number = match (only, dialled) {
            (Some(n), _) => Some(n),
            (None, Ok(IpAddr::V4(address))) => plc::number(address),
            _ => None,
        };
        // The port is open to the network, and the PLCs are not.
        let Some(n) = number.filter(|&n| n < plcs && peer.ip().is_loopback()) else { continue };
        let Ok(bus) = plc::bus(n) else { continue };
        // A reply is one small segment, and the client waits for it.
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
