//! Servers of the PLCs: TCP port, pseudo-terminal or UDP port. Each is interrupted at random times.

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
use crate::rng::Rng;

/// Server of the PLCs of a line.
pub(crate) struct PlcServer {
    bus: Bus,
    framing: Framing,
    port: Port,
}

enum Port {
    Tcp(Server),
    Udp(UdpSocket),
    /// Path of a symbolic link to the pseudo-terminal.
    Serial(PathBuf),
}

impl PlcServer {
    pub(crate) async fn tcp(bus: Bus, framing: Framing) -> Result<Self> {
        let server = Server::bind("127.0.0.1:0", bus.clone(), framing).await?;
        Ok(Self { bus, framing, port: Port::Tcp(server) })
    }

    pub(crate) async fn udp(bus: Bus, framing: Framing) -> Result<Self> {
        let socket = UdpSocket::bind("127.0.0.1:0").await?;
        Ok(Self { bus, framing, port: Port::Udp(socket) })
    }

    pub(crate) fn serial(bus: Bus, framing: Framing, path: PathBuf) -> Result<Self> {
        Ok(Self { bus, framing, port: Port::Serial(path) })
    }

    pub(crate) fn address(&self) -> Result<SocketAddr> {
        match &self.port {
            Port::Tcp(server) => Ok(server.local_addr()),
            Port::Udp(socket) => Ok(socket.local_addr()?),
            Port::Serial(_) => Err("a serial port has no address".into()),
        }
    }

    /// Serves until `stop`, with interruptions. Returns their number.
    pub(crate) async fn serve(self, mut rng: Rng, stop: CancellationToken) -> Result<u64> {
        let Self { bus, framing, port } = self;
        let mut interruptions = 0;
        match port {
            Port::Tcp(mut server) => {
                let address = server.local_addr();
                while wait(&stop, rng.millis(3_000, 20_000)).await {
                    server.shutdown().await;
                    interruptions += 1;
                    sleep(rng.millis(1, 1_000)).await;
                    server = bind_again(address, &bus, framing).await?;
                }
                server.shutdown().await;
            }
            Port::Udp(socket) => {
                while !stop.is_cancelled() {
                    tokio::select! {
                        served = serve_datagrams(&socket, &bus, framing) => served?,
                        is_running = wait(&stop, rng.millis(3_000, 20_000)) => {
                            interruptions += u64::from(is_running);
                            // Datagrams are queued meanwhile, and are then late.
                            sleep(rng.millis(1, 400)).await;
                        }
                    }
                }
            }
            Port::Serial(path) => {
                while !stop.is_cancelled() {
                    tokio::select! {
                        served = serve_port(&path, &bus, framing) => served?,
                        is_running = wait(&stop, rng.millis(3_000, 20_000)) => interruptions += u64::from(is_running),
                    }
                    unplug(&path);
                    sleep(rng.millis(1, 300)).await;
                }
            }
        }
        Ok(interruptions)
    }
}

/// Waits for a time. Returns false if stopped meanwhile.
async fn wait(stop: &CancellationToken, time: Duration) -> bool {
    tokio::select! {
        () = stop.cancelled() => false,
        () = sleep(time) => true,
    }
}

/// Binds the address again. Retries while connections of the previous server are closing.
async fn bind_again(address: SocketAddr, bus: &Bus, framing: Framing) -> Result<Server> {
    for _ in 0..600 {
        if let Ok(server) = Server::bind(address, bus.clone(), framing).await {
            return Ok(server);
        }
        sleep(Duration::from_millis(100)).await;
    }
    Err(format!("cannot listen at {address} again").into())
}

/// Serves the PLCs behind a UDP serial server: all replies go to the sender of the last request.
///
/// Returns when a fault has closed the line.
async fn serve_datagrams(socket: &UdpSocket, bus: &Bus, framing: Framing) -> Result<()> {
    let (line, plcs) = duplex(4 * MAX_FRAME_LEN);
    let (mut from_line, mut to_line) = tokio::io::split(line);
    let last = Mutex::new(None);
    let requests = async {
        let mut datagram = [0; 2 * MAX_FRAME_LEN];
        loop {
            // An error belongs to an earlier datagram with a closed receiver.
            let Ok((len, from)) = socket.recv_from(&mut datagram).await else { continue };
            *lock(&last) = Some(from);
            if to_line.write_all(&datagram[..len]).await.is_err() {
                return;
            }
        }
    };
    let replies = async {
        let mut datagram = [0; 2 * MAX_FRAME_LEN];
        while let Ok(len @ 1..) = from_line.read(&mut datagram).await {
            let client = *lock(&last);
            if let Some(client) = client {
                let _ = socket.send_to(&datagram[..len], client).await;
            }
        }
    };
    tokio::select! {
        served = sim::serve(plcs, bus.clone(), framing) => drop(served),
        () = requests => {}
        () = replies => {}
    }
    Ok(())
}

#[cfg(all(target_os = "linux", feature = "serial"))]
async fn serve_port(path: &std::path::Path, bus: &Bus, framing: Framing) -> Result<()> {
    use tokio_serial::{SerialPort as _, SerialStream};

    let (line, mut port) = SerialStream::pair()?;
    port.set_exclusive(false)?;
    let name = port.name().ok_or("the pseudo-terminal has no name")?;
    // A pseudo-terminal works only while its other side is open.
    let _open = std::fs::File::open(&name)?;
    drop(port);
    unplug(path);
    std::os::unix::fs::symlink(&name, path)?;
    // Ends with an error when the line is disconnected.
    let _ = sim::serve(line, bus.clone(), framing).await;
    Ok(())
}

#[cfg(not(all(target_os = "linux", feature = "serial")))]
async fn serve_port(path: &std::path::Path, _bus: &Bus, _framing: Framing) -> Result<()> {
    Err(format!("no pseudo-terminals on this system, for {}", path.display()).into())
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

fn unplug(path: &std::path::Path) {
    let _ = std::fs::remove_file(path);
}
