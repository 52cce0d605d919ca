//! A PLC behind a real TCP listener, UDP socket or pseudo-terminal, with the faults that put a
//! client out of step.
//!
//! - Register Rn holds n, for n below 1024 unless set; relay Mn holds the lowest bit of n, for n
//!   below 256.
//! - Requests of all connections are executed one at a time, in the order of arrival. Each takes
//!   the PLC time.
//! - A reply may be copied. A copy keeps the order: it leaves at the latest just before the next
//!   reply.
//! - With [`ReplyTo::Latest`] the PLC side outlives its clients: a late reply goes to the newest
//!   client.
//!
//! Runs in threads: a copy 0.3 ms after its original needs a finer clock than the runtime's.
#![allow(dead_code, reason = "each test program uses a part of it")]

mod line;

use std::io::Read;
use std::net::{SocketAddr, TcpListener, TcpStream, UdpSocket};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fatek::command::Request;
use fatek::sim::{Bus, Plc};
use fatek::wire::{Codec, Framing, Side};
use fatek::{Element, Endpoint, Symbol};
use tokio_util::codec::Decoder;

use line::{Client, Event, Line, Output};

use crate::rng::Rng;

/// Transport to the PLC.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Transport {
    Tcp,
    Udp,
    /// A pseudo-terminal, paced as a line of this baud rate with ten bits a character.
    #[cfg(unix)]
    Serial(u32),
}

/// The client that gets a reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ReplyTo {
    /// The sender of the request. If it has gone, the reply is lost.
    Sender,
    /// The newest client that is still connected; over UDP, the most recent sender. A serial server
    /// does the same.
    Latest,
}

/// A second transmission of a reply.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Copy {
    /// Delay after the original; `None`: just before the next reply.
    pub(crate) after: Option<Duration>,
    /// The second answer is a refusal (error 4), as of a PLC that executes the request again.
    pub(crate) refused: bool,
}

impl Copy {
    pub(crate) fn after(delay: Duration) -> Self {
        Self { after: Some(delay), refused: false }
    }

    pub(crate) fn before_next() -> Self {
        Self { after: None, refused: false }
    }

    pub(crate) fn refused(self) -> Self {
        Self { refused: true, ..self }
    }
}

/// Decides for each reply, by its command, whether it is copied.
pub(crate) type Copies = Box<dyn FnMut(u8) -> Option<Copy> + Send>;

/// The commands that read elements.
pub(crate) const READS: &[u8] = &[0x44, 0x46, 0x48];
/// The commands that write elements.
pub(crate) const WRITES: &[u8] = &[0x45, 0x47, 0x49];
/// The commands that read or write elements.
pub(crate) const READS_AND_WRITES: &[u8] = &[0x44, 0x45, 0x46, 0x47, 0x48, 0x49];

/// Copies the n-th reply to any of these commands, counted from 1.
pub(crate) fn nth(n: usize, commands: &'static [u8], copy: Copy) -> Copies {
    let mut seen = 0;
    Box::new(move |command| {
        seen += usize::from(commands.contains(&command));
        (seen == n && commands.contains(&command)).then_some(copy)
    })
}

/// Copies every n-th reply to these commands.
pub(crate) fn every(n: usize, commands: &'static [u8], copy: Copy) -> Copies {
    let mut seen = 0;
    Box::new(move |command| {
        seen += usize::from(commands.contains(&command));
        (seen % n == 0 && commands.contains(&command)).then_some(copy)
    })
}

/// Copies one in `n` replies to any command, with a random delay of at most `longest`.
pub(crate) fn at_random(seed: u64, n: u64, longest: Duration) -> Copies {
    let mut rng = Rng(seed);
    let longest = u64::try_from(longest.as_micros()).unwrap();
    Box::new(move |_| {
        let delay = Duration::from_micros(rng.below(longest + 1));
        (rng.below(n) == 0).then(|| Copy::after(delay))
    })
}

/// Settings of a [`Server`]. Defaults: ASCII, 1024 registers, a PLC time of 5 ms, no faults.
pub(crate) struct Setup {
    pub(crate) transport: Transport,
    pub(crate) framing: Framing,
    /// Number of registers R that hold their address; the others hold 0.
    pub(crate) registers: u16,
    /// Time from the arrival of a request, or the end of the one before it, to its reply.
    pub(crate) plc_time: Duration,
    /// Number of first requests with another PLC time.
    pub(crate) slow_start: (usize, Duration),
    pub(crate) reply_to: ReplyTo,
    pub(crate) copies: Copies,
    /// Frames that are sent at the same moment share a segment.
    pub(crate) in_one_segment: bool,
    /// Requests that are refused with error 4 and not executed.
    pub(crate) refuses: fn(&Request) -> bool,
    /// Station number of answers to broadcasts.
    pub(crate) broadcast_reply: Option<u8>,
}

impl Setup {
    pub(crate) fn new(transport: Transport) -> Self {
        Self {
            transport,
            framing: Framing::Ascii,
            registers: 1024,
            plc_time: Duration::from_millis(5),
            slow_start: (0, Duration::ZERO),
            reply_to: ReplyTo::Sender,
            copies: Box::new(|_| None),
            in_one_segment: false,
            refuses: |_| false,
            broadcast_reply: None,
        }
    }

    pub(crate) fn start(self) -> Server {
        Server::start(self)
    }
}

/// Returns whether a request writes to a register D, for [`Setup::refuses`].
pub(crate) fn writes_d(request: &Request) -> bool {
    let is_d = |element: Element| element.symbol() == Symbol::D;
    match request {
        Request::WriteRegisters(write) => is_d(write.first().into()),
        Request::WriteMixed(write) => write.items().iter().any(|&(element, _)| is_d(element)),
        _ => false,
    }
}

/// Numbers of frames sent so far.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Sent {
    pub(crate) replies: usize,
    pub(crate) copies: usize,
}

/// A running server with a PLC at station 1, stopped on drop.
pub(crate) struct Server {
    pub(crate) plc: Plc,
    endpoint: Endpoint,
    sent: Arc<Mutex<Sent>>,
    stopped: Arc<AtomicBool>,
    events: Sender<Event>,
    address: Option<(Transport, SocketAddr)>,
    /// Keeps the other side of the pseudo-terminal open.
    _port: Option<std::fs::File>,
}

impl Server {
    fn start(setup: Setup) -> Self {
        let plc = filled_plc(setup.registers);
        let (events, received) = channel();
        let stopped = Arc::<AtomicBool>::default();
        let reader = Reader { framing: setup.framing, events: events.clone(), stopped: stopped.clone() };
        let mut port = None;
        let (endpoint, address, output) = match setup.transport {
            Transport::Tcp => {
                let listener = TcpListener::bind("127.0.0.1:0").unwrap();
                let address = listener.local_addr().unwrap();
                thread::spawn(move || reader.accept(&listener));
                (Endpoint::from(address), Some(address), Output::Tcp)
            }
            Transport::Udp => {
                let socket = Arc::new(UdpSocket::bind("127.0.0.1:0").unwrap());
                let address = socket.local_addr().unwrap();
                let output = Output::Udp(socket.clone());
                thread::spawn(move || reader.receive(&socket));
                (Endpoint::udp("127.0.0.1", address.port()), Some(address), output)
            }
            #[cfg(unix)]
            Transport::Serial(baud) => {
                let (line, slave, path) = pseudo_terminal();
                port = Some(slave);
                let character = Duration::from_secs(10) / baud;
                let output = Output::Serial(line.try_clone().unwrap(), character);
                thread::spawn(move || reader.read(line, &Client::Serial, character));
                let serial = fatek::endpoint::SerialSettings::new(setup.framing).with_baud(baud).unwrap();
                let endpoint = Endpoint::serial(path).with_framing(setup.framing).with_serial(serial).unwrap();
                (endpoint, None, output)
            }
        };
        let endpoint = endpoint.with_framing(setup.framing);
        let address = address.map(|address| (setup.transport, address));
        let sent = Arc::<Mutex<Sent>>::default();
        let bus = Bus::new().with_station(1, plc.clone()).unwrap();
        let line = Line::new(setup, bus, output, sent.clone());
        thread::spawn(move || line.run(&received));
        Self { plc, endpoint, sent, stopped, events, address, _port: port }
    }

    pub(crate) fn endpoint(&self) -> Endpoint {
        self.endpoint.clone()
    }

    pub(crate) fn sent(&self) -> Sent {
        *self.sent.lock().unwrap()
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        let _ = self.events.send(Event::Stop);
        // Wakes the thread that waits for clients.
        match self.address {
            Some((Transport::Tcp, address)) => drop(TcpStream::connect(address)),
            Some((_, address)) => drop(UdpSocket::bind("127.0.0.1:0").unwrap().send_to(b"", address)),
            None => {}
        }
    }
}

/// Creates the PLC. Each run needs one, so it must not take long.
fn filled_plc(registers: u16) -> Plc {
    let plc = Plc::new();
    plc.run();
    for n in 0..registers {
        plc.write(Element::new(Symbol::R, n).unwrap(), n).unwrap();
    }
    for n in (1..256).step_by(2) {
        plc.write(Element::new(Symbol::M, n).unwrap(), true).unwrap();
    }
    plc
}

#[cfg(unix)]
fn pseudo_terminal() -> (std::fs::File, std::fs::File, String) {
    use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};

    let line = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).unwrap();
    grantpt(&line).unwrap();
    unlockpt(&line).unwrap();
    let path = ptsname(&line, Vec::new()).unwrap().into_string().unwrap();
    let port = std::fs::File::open(&path).unwrap();
    (line.into(), port, path)
}

/// Threads that turn bytes into events.
#[derive(Clone)]
struct Reader {
    framing: Framing,
    events: Sender<Event>,
    stopped: Arc<AtomicBool>,
}

impl Reader {
    fn accept(self, listener: &TcpListener) {
        for stream in listener.incoming() {
            if self.stopped.load(Ordering::Relaxed) {
                return;
            }
            let stream = stream.unwrap();
            stream.set_nodelay(true).unwrap();
            let client = Client::Tcp(Arc::new(stream.try_clone().unwrap()));
            let _ = self.events.send(Event::Opened(client.clone()));
            let reader = self.clone();
            thread::spawn(move || {
                reader.read(stream, &client, Duration::ZERO);
                let _ = reader.events.send(Event::Closed(client));
            });
        }
    }

    fn read(&self, mut stream: impl Read, from: &Client, character: Duration) {
        let mut codec = Codec::new(self.framing, Side::Plc);
        let (mut buffer, mut received) = ([0; 1024], BytesMut::new());
        while let Ok(len @ 1..) = stream.read(&mut buffer) {
            let at = Instant::now() + character * u32::try_from(len).unwrap();
            received.extend_from_slice(&buffer[..len]);
            self.decode(&mut codec, &mut received, from, at);
        }
    }

    fn receive(&self, socket: &UdpSocket) {
        let mut buffer = [0; 2048];
        while !self.stopped.load(Ordering::Relaxed) {
            // The error of an earlier datagram to a closed port.
            let Ok((len, from)) = socket.recv_from(&mut buffer) else { continue };
            let mut received = BytesMut::from(&buffer[..len]);
            let mut codec = Codec::new(self.framing, Side::Plc);
            self.decode(&mut codec, &mut received, &Client::Udp(from), Instant::now());
        }
    }

    fn decode(&self, codec: &mut Codec, received: &mut BytesMut, from: &Client, at: Instant) {
        while let Some(item) = codec.decode(received).unwrap() {
            if let Some(frame) = item.frame() {
                let _ = self.events.send(Event::Request { frame, from: from.clone(), at });
            }
        }
    }
}
