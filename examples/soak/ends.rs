//! Where the PLCs are: a TCP port, a pseudo-terminal, a UDP port. They go away now and then, and come back.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use fatek::sim::{self, Bus, Server};
use fatek::wire::{Framing, MAX_FRAME_LEN};
use tokio::io::{AsyncReadExt, AsyncWriteExt, duplex};
use tokio::net::UdpSocket;
use tokio::time::sleep;
use tokio_util::sync::CancellationToken;

use crate::Result;
use crate::dice::Dice;

/// The PLCs' end of a line.
pub(crate) struct End {
    bus: Bus,
    framing: Framing,
    means: Means,
}

enum Means {
    Tcp(Server),
    Udp(UdpSocket),
    /// The path at which the port comes and goes.
    Serial(PathBuf),
}

impl End {
    pub(crate) async fn tcp(bus: Bus, framing: Framing) -> Result<Self> {
        let server = Server::bind("127.0.0.1:0", bus.clone(), framing).await?;
        Ok(Self { bus, framing, means: Means::Tcp(server) })
    }

    pub(crate) async fn udp(bus: Bus, framing: Framing) -> Result<Self> {
        let socket = UdpSocket::bind("127.0.0.1:0").await?;
        Ok(Self { bus, framing, means: Means::Udp(socket) })
    }

    pub(crate) fn serial(bus: Bus, framing: Framing, path: PathBuf) -> Result<Self> {
        Ok(Self { bus, framing, means: Means::Serial(path) })
    }

    pub(crate) fn address(&self) -> Result<SocketAddr> {
        match &self.means {
            Means::Tcp(server) => Ok(server.local_addr()),
            Means::Udp(socket) => Ok(socket.local_addr()?),
            Means::Serial(_) => Err("a serial port has no address".into()),
        }
    }

    /// Serves until it is stopped, with interruptions; gives how many there were.
    pub(crate) async fn serve(self, mut dice: Dice, stop: CancellationToken) -> Result<u64> {
        let Self { bus, framing, means } = self;
        let mut interruptions = 0;
        match means {
            Means::Tcp(mut server) => {
                let address = server.local_addr();
                while goes_on(&stop, dice.millis(3_000, 20_000)).await {
                    server.shutdown().await;
                    interruptions += 1;
                    sleep(dice.millis(1, 1_000)).await;
                    server = bind_again(address, &bus, framing).await?;
                }
                server.shutdown().await;
            }
            Means::Udp(socket) => {
                while !stop.is_cancelled() {
                    tokio::select! {
                        served = serve_datagrams(&socket, &bus, framing) => served?,
                        goes_on = goes_on(&stop, dice.millis(3_000, 20_000)) => {
                            interruptions += u64::from(goes_on);
                            // Datagrams wait meanwhile, and are then late.
                            sleep(dice.millis(1, 400)).await;
                        }
                    }
                }
            }
            Means::Serial(path) => {
                while !stop.is_cancelled() {
                    tokio::select! {
                        served = serve_port(&path, &bus, framing) => served?,
                        goes_on = goes_on(&stop, dice.millis(3_000, 20_000)) => interruptions += u64::from(goes_on),
                    }
                    unplug(&path);
                    sleep(dice.millis(1, 300)).await;
                }
            }
        }
        Ok(interruptions)
    }
}

/// Waits so long; says whether it has not been stopped meanwhile.
async fn goes_on(stop: &CancellationToken, time: Duration) -> bool {
    tokio::select! {
        () = stop.cancelled() => false,
        () = sleep(time) => true,
    }
}

/// Connections of the one before may still be ending.
async fn bind_again(address: SocketAddr, bus: &Bus, framing: Framing) -> Result<Server> {
    for _ in 0..600 {
        if let Ok(server) = Server::bind(address, bus.clone(), framing).await {
            return Ok(server);
        }
        sleep(Duration::from_millis(100)).await;
    }
    Err(format!("cannot listen at {address} again").into())
}

/// The PLCs behind a converter from UDP to a serial line: whoever has asked last is told what comes from there.
///
/// Ends when a fault has closed the line.
async fn serve_datagrams(socket: &UdpSocket, bus: &Bus, framing: Framing) -> Result<()> {
    let (line, plcs) = duplex(4 * MAX_FRAME_LEN);
    let (mut from_line, mut to_line) = tokio::io::split(line);
    let last = Mutex::new(None);
    let ask = async {
        let mut datagram = [0; 2 * MAX_FRAME_LEN];
        loop {
            // An error is that of an earlier datagram whose receiver was gone.
            let Ok((len, from)) = socket.recv_from(&mut datagram).await else { continue };
            *lock(&last) = Some(from);
            if to_line.write_all(&datagram[..len]).await.is_err() {
                return;
            }
        }
    };
    let answer = async {
        let mut datagram = [0; 2 * MAX_FRAME_LEN];
        while let Ok(len @ 1..) = from_line.read(&mut datagram).await {
            let asker = *lock(&last);
            if let Some(asker) = asker {
                let _ = socket.send_to(&datagram[..len], asker).await;
            }
        }
    };
    tokio::select! {
        served = sim::serve(plcs, bus.clone(), framing) => drop(served),
        () = ask => {}
        () = answer => {}
    }
    Ok(())
}

#[cfg(all(target_os = "linux", feature = "serial"))]
async fn serve_port(path: &std::path::Path, bus: &Bus, framing: Framing) -> Result<()> {
    use tokio_serial::{SerialPort as _, SerialStream};

    let (line, mut port) = SerialStream::pair()?;
    port.set_exclusive(false)?;
    let name = port.name().ok_or("the pseudo-terminal has no name")?;
    // A line that nobody has open does not work.
    let _open = std::fs::File::open(&name)?;
    drop(port);
    unplug(path);
    std::os::unix::fs::symlink(&name, path)?;
    // It ends with an error when the line is cut.
    let _ = sim::serve(line, bus.clone(), framing).await;
    Ok(())
}

#[cfg(not(all(target_os = "linux", feature = "serial")))]
async fn serve_port(path: &std::path::Path, _bus: &Bus, _framing: Framing) -> Result<()> {
    Err(format!("no serial port can be made here, for {}", path.display()).into())
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn unplug(path: &std::path::Path) {
    let _ = std::fs::remove_file(path);
}
