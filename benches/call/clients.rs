//! Methods of reading 64 registers, and their callers.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use fatek::{Endpoint, Link, Station, register};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::sync::{Mutex, mpsc, oneshot};
use tokio::time::timeout;
use tokio_modbus::Slave;
use tokio_modbus::client::{Context, Reader, tcp};

use crate::server::{REGISTERS, Script, Servers};
use crate::{Result, Setting};

/// Method of reading 64 registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Way {
    /// [`Station`], which allocates the values.
    Fatek(Bytes),
    /// [`Station`], into memory of the caller.
    Into(Bytes),
    /// The same, in the binary framing, over a link whose line never doubles a reply (`copies=0`).
    Single,
    /// Bare write and read of the same bytes.
    Bare(Bytes),
    /// Bare write and read by a task that owns the connection, with channels to the callers.
    Task(Bytes),
    /// tokio-modbus.
    Modbus,
    /// tokio-modbus with a timeout per call, as with each call of a `Station`.
    Timed,
}

/// Framing of the bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Bytes {
    Ascii,
    Binary,
}

impl Way {
    pub(crate) const ALL: [Self; 10] = [
        Self::Fatek(Bytes::Binary),
        Self::Bare(Bytes::Binary),
        Self::Modbus,
        Self::Timed,
        Self::Into(Bytes::Binary),
        Self::Fatek(Bytes::Ascii),
        Self::Bare(Bytes::Ascii),
        Self::Into(Bytes::Ascii),
        Self::Single,
        Self::Task(Bytes::Binary),
    ];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Fatek(Bytes::Ascii) => "fatek-ascii",
            Self::Fatek(Bytes::Binary) => "fatek-binary",
            Self::Into(Bytes::Ascii) => "into-ascii",
            Self::Into(Bytes::Binary) => "into-binary",
            Self::Single => "single-binary",
            Self::Bare(Bytes::Ascii) => "bare-ascii",
            Self::Bare(Bytes::Binary) => "bare-binary",
            Self::Task(Bytes::Ascii) => "task-ascii",
            Self::Task(Bytes::Binary) => "task-binary",
            Self::Modbus => "tokio-modbus",
            Self::Timed => "modbus-timed",
        }
    }
}

/// Caller.
pub(crate) enum Client {
    Fatek(Station),
    Into(Station, [u16; REGISTERS]),
    Bare(Bare),
    Task(mpsc::Sender<oneshot::Sender<io::Result<usize>>>),
    /// tokio-modbus, with a timeout if given.
    Modbus(Context, Option<Duration>),
    /// tokio-modbus with one context for all callers, as is usual.
    Shared(Arc<Mutex<Context>>, Option<Duration>),
}

/// Default deadline of a call of a `Station`.
const TIMEOUT: Duration = Duration::from_secs(10);

/// Connection with its request and reply.
pub(crate) struct Bare {
    stream: TcpStream,
    script: Script,
}

/// Connects the callers of a setting.
pub(crate) async fn connect(way: Way, setting: Setting, servers: &Servers) -> Result<Vec<Client>> {
    let mut clients = Vec::new();
    for _ in 0..setting.links {
        match way {
            Way::Fatek(_) | Way::Into(_) | Way::Single => {
                let bytes = if let Way::Fatek(bytes) | Way::Into(bytes) = way { bytes } else { Bytes::Binary };
                let (address, _) = server(bytes, servers);
                let framing = if bytes == Bytes::Ascii { "ascii" } else { "binary" };
                let copies = if way == Way::Single { "&copies=0" } else { "" };
                let endpoint: Endpoint = format!("tcp://{address}?framing={framing}{copies}").parse()?;
                // Under a profiler with 1000 links a reply takes longer than the default allows.
                let link = Link::builder(endpoint).response_timeout(TIMEOUT).call_timeout(6 * TIMEOUT).build();
                let station = link.station(1)?;
                clients.extend((0..setting.callers).map(|_| match way {
                    Way::Into(_) | Way::Single => Client::Into(station.clone(), [0; REGISTERS]),
                    _ => Client::Fatek(station.clone()),
                }));
            }
            // A bare connection cannot be shared: its limit is one caller without pauses.
            Way::Bare(bytes) => clients.push(Client::Bare(Bare::connect(server(bytes, servers)).await?)),
            Way::Task(bytes) => {
                let (requests, task) = mpsc::channel(64);
                tokio::spawn(Bare::connect(server(bytes, servers)).await?.serve(task));
                clients.extend((0..setting.callers).map(|_| Client::Task(requests.clone())));
            }
            Way::Modbus | Way::Timed => {
                let limit = (way == Way::Timed).then_some(TIMEOUT);
                let context = tcp::attach_slave(open(servers.modbus.0).await?, Slave(1));
                if setting.callers == 1 {
                    clients.push(Client::Modbus(context, limit));
                } else {
                    let shared = Arc::new(Mutex::new(context));
                    clients.extend((0..setting.callers).map(|_| Client::Shared(shared.clone(), limit)));
                }
            }
        }
    }
    for client in &mut clients {
        client.call(1).await?;
    }
    Ok(clients)
}

fn server(bytes: Bytes, servers: &Servers) -> &(SocketAddr, Script) {
    match bytes {
        Bytes::Ascii => &servers.ascii,
        Bytes::Binary => &servers.binary,
    }
}

async fn open(address: SocketAddr) -> io::Result<TcpStream> {
    let stream = TcpStream::connect(address).await?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

impl Client {
    /// Makes requests, one at a time.
    pub(crate) async fn call(&mut self, requests: usize) -> Result<()> {
        for _ in 0..requests {
            let registers = match self {
                Self::Fatek(station) => station.read_registers(register!("R0"), REGISTERS).await?.len(),
                Self::Into(station, values) => {
                    station.read_registers_into(register!("R0"), values).await?;
                    values.len()
                }
                Self::Bare(bare) => bare.call().await?,
                Self::Task(task) => {
                    let (sender, reply) = oneshot::channel();
                    task.send(sender).await?;
                    reply.await??
                }
                Self::Modbus(context, None) => read(context).await?,
                Self::Modbus(context, Some(limit)) => timeout(*limit, read(context)).await??,
                Self::Shared(context, None) => read(&mut *context.lock().await).await?,
                Self::Shared(context, Some(limit)) => {
                    timeout(*limit, async { read(&mut *context.lock().await).await }).await??
                }
            };
            if registers != REGISTERS {
                return Err(format!("{registers} registers read, expected {REGISTERS}").into());
            }
        }
        Ok(())
    }
}

async fn read(context: &mut Context) -> Result<usize> {
    Ok(context.read_holding_registers(0, REGISTERS as u16).await??.len())
}

impl Bare {
    async fn connect((address, script): &(SocketAddr, Script)) -> io::Result<Self> {
        Ok(Self { stream: open(*address).await?, script: script.clone() })
    }

    async fn call(&mut self) -> io::Result<usize> {
        self.stream.write_all(&self.script.request).await?;
        // Longer than the reply: after a read that fills its buffer Tokio reads once more in vain.
        let mut buffer = [0; 1024];
        let mut filled = 0;
        while filled < self.script.reply.len() {
            match self.stream.read(buffer.get_mut(filled..).unwrap_or_default()).await? {
                0 => return Err(io::ErrorKind::UnexpectedEof.into()),
                read => filled += read,
            }
        }
        Ok(REGISTERS)
    }

    async fn serve(mut self, mut requests: mpsc::Receiver<oneshot::Sender<io::Result<usize>>>) {
        while let Some(sender) = requests.recv().await {
            let _ = sender.send(self.call().await);
        }
    }
}
