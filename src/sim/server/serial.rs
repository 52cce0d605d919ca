//! Server on a serial port.

use std::io;
use std::time::Duration;

use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tokio::time;
use tracing::debug;

use super::connection::{Connection, ConnectionHandle};
use super::{SHUTDOWN_TIMEOUT, serve};
use crate::endpoint::{SerialSettings, Transport};
use crate::sim::Bus;
use crate::transport::BoxIo;
use crate::wire::Framing;

/// Pause before a lost port is opened again.
const REOPEN_AFTER: Duration = Duration::from_millis(200);

/// A server for a [`Bus`] on a serial port, as PLCs on that line.
///
/// A port that is lost, for instance unplugged, is opened again when it is back. The port is opened
/// exclusively. Faults that close a connection close the port for a moment.
///
/// Dropping it closes the port; [`shutdown`](Self::shutdown) also waits for that.
///
/// ```no_run
/// use fatek::endpoint::SerialSettings;
/// use fatek::sim::{Bus, Plc, SerialServer};
/// use fatek::wire::Framing;
///
/// # #[tokio::main(flavor = "current_thread")]
/// # async fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let bus = Bus::new().with_station(1, Plc::new())?;
/// let settings = SerialSettings::new(Framing::Ascii).with_baud(19_200)?;
/// let server = SerialServer::open("/dev/ttyUSB1", settings, bus, Framing::Ascii).await?;
/// server.shutdown().await;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct SerialServer {
    /// Stops the task when dropped.
    stop: oneshot::Sender<()>,
    task: JoinHandle<()>,
}

impl SerialServer {
    /// Opens the port with this path or name. Its requests are served as by [`serve`].
    ///
    /// # Errors
    /// The port cannot be opened; `Unsupported` without the feature `serial`.
    pub async fn open(
        path: impl Into<String>,
        settings: SerialSettings,
        bus: Bus,
        framing: Framing,
    ) -> io::Result<Self> {
        let transport = Transport::Serial { path: path.into(), settings };
        let port = open(&transport, framing).await?;
        let (stop, stopped) = oneshot::channel();
        let task = tokio::spawn(serve_port(stopped, transport, port, bus, framing));
        Ok(Self { stop, task })
    }

    /// Closes the port, and returns when that is done.
    ///
    /// Requests that have arrived are answered first, within one second.
    pub async fn shutdown(self) {
        drop(self.stop);
        if let Err(error) = self.task.await {
            debug!(%error, "the task of the simulated PLC failed");
        }
    }
}

async fn open(transport: &Transport, framing: Framing) -> io::Result<BoxIo> {
    transport.open(framing, false, 0).await
}

/// Serves the port until it is stopped, and opens it again when it is lost.
async fn serve_port(
    mut stopped: oneshot::Receiver<()>,
    transport: Transport,
    mut port: BoxIo,
    bus: Bus,
    framing: Framing,
) {
    loop {
        let handle = ConnectionHandle::new();
        let serving = serve(Connection::new(port, handle.clone()), bus.clone(), framing);
        tokio::pin!(serving);
        tokio::select! {
            biased;
            _ = &mut stopped => {
                handle.close();
                let _ = time::timeout(SHUTDOWN_TIMEOUT, serving).await;
                return;
            }
            result = &mut serving => debug!(?result, "the port was lost or closed"),
        }
        port = loop {
            tokio::select! {
                biased;
                _ = &mut stopped => return,
                () = time::sleep(REOPEN_AFTER) => {}
            }
            match open(&transport, framing).await {
                Ok(port) => break port,
                Err(error) => debug!(%error, "cannot open the port again"),
            }
        };
    }
}
