//! Simulated PLCs that record when each connection sent, and the process at its other end.
//!
//! One thread reads all sockets in turns. Bytes of a socket came after the last turn in which it had none, and before
//! they were read: so two arrivals are in a certain order, or in none.

use std::collections::BTreeMap;
use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use bytes::BytesMut;
use fatek::sim::{Bus, Plc};
use fatek::wire::{Codec, Framing, Side};
use tokio_util::codec::Decoder as _;

use super::processes::Processes;

/// The time between two turns.
const TURN: Duration = Duration::from_millis(1);
/// The turns in which the process of a connection is looked for.
const LOOKS: u32 = 5;

/// A connection to a PLC.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Connection {
    /// The number of its process; `None`: it had ended before it was looked for.
    pub(crate) process: Option<usize>,
    pub(crate) link: usize,
    /// It was made before this time.
    pub(crate) accepted: Instant,
}

/// Bytes that a PLC got.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Arrival {
    pub(crate) connection: usize,
    /// They came after this time.
    pub(crate) after: Instant,
    /// They came before this time.
    pub(crate) before: Instant,
}

/// The connections and arrivals.
#[derive(Debug, Default)]
pub(crate) struct Record {
    pub(crate) connections: BTreeMap<usize, Connection>,
    pub(crate) arrivals: Vec<Arrival>,
}

/// The PLCs. Their thread ends when they are dropped.
pub(crate) struct Plcs {
    ports: Vec<u16>,
    record: Arc<Mutex<Record>>,
    last: Arc<Mutex<Vec<Option<Instant>>>>,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

struct Open {
    number: usize,
    link: usize,
    stream: TcpStream,
    codec: Codec,
    buffer: BytesMut,
    looks: u32,
    quiet: Instant,
}

struct Reader {
    listeners: Vec<TcpListener>,
    ports: Vec<u16>,
    buses: Vec<Bus>,
    open: Vec<Open>,
    next: usize,
    processes: Processes,
    record: Arc<Mutex<Record>>,
    last: Arc<Mutex<Vec<Option<Instant>>>>,
}

impl Plcs {
    pub(crate) fn start(count: usize, processes: Processes) -> Self {
        let listeners: Vec<_> = (0..count).map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
        listeners.iter().for_each(|listener| listener.set_nonblocking(true).unwrap());
        let ports: Vec<u16> = listeners.iter().map(|listener| listener.local_addr().unwrap().port()).collect();
        let buses = (0..count).map(|_| Bus::new().with_station(1, Plc::new()).unwrap()).collect();
        let (record, stop) = (Arc::new(Mutex::new(Record::default())), Arc::new(AtomicBool::new(false)));
        let last = Arc::new(Mutex::new(vec![None; count]));
        let mut reader = Reader {
            listeners,
            ports: ports.clone(),
            buses,
            open: Vec::new(),
            next: 0,
            processes,
            record: record.clone(),
            last: last.clone(),
        };
        let stopped = stop.clone();
        let thread = std::thread::spawn(move || {
            while !stopped.load(Ordering::Relaxed) {
                reader.turn();
                std::thread::sleep(TURN);
            }
        });
        Self { ports, record, last, stop, thread: Some(thread) }
    }

    pub(crate) fn ports(&self) -> &[u16] {
        &self.ports
    }

    /// The time of the last request to each PLC.
    pub(crate) fn last(&self) -> Vec<Option<Instant>> {
        self.last.lock().unwrap().clone()
    }

    /// Takes the arrivals since the last call, with all connections that are or were theirs.
    pub(crate) fn take(&self) -> Record {
        let mut record = self.record.lock().unwrap();
        Record { connections: record.connections.clone(), arrivals: std::mem::take(&mut record.arrivals) }
    }
}

impl Drop for Plcs {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let result = thread.join();
            assert!(result.is_ok() || std::thread::panicking(), "the thread of the PLCs has failed");
        }
    }
}

impl Reader {
    fn turn(&mut self) {
        let begin = Instant::now();
        for link in 0..self.listeners.len() {
            while let Ok((stream, _)) = self.listeners[link].accept() {
                stream.set_nonblocking(true).unwrap();
                let _ = stream.set_nodelay(true);
                let (codec, buffer) = (Codec::new(Framing::Ascii, Side::Plc), BytesMut::new());
                let open = Open { number: self.next, link, stream, codec, buffer, looks: 0, quiet: begin };
                let connection = Connection { process: None, link, accepted: Instant::now() };
                self.record.lock().unwrap().connections.insert(self.next, connection);
                self.open.push(open);
                self.next += 1;
            }
        }
        self.look();
        let mut open = std::mem::take(&mut self.open);
        open.retain_mut(|one| self.read(one));
        self.open = open;
    }

    /// Looks for the processes of new connections.
    fn look(&mut self) {
        let unknown = self.open.iter_mut().filter(|open| open.looks < LOOKS);
        let mut ports = BTreeMap::new();
        for open in unknown {
            open.looks += 1;
            if let Ok(peer) = open.stream.peer_addr() {
                ports.insert((peer.port(), self.ports[open.link]), open.number);
            }
        }
        if ports.is_empty() {
            return;
        }
        let found = self.processes.find(&ports);
        let mut record = self.record.lock().unwrap();
        for (number, process) in found {
            if let Some(connection) = record.connections.get_mut(&number) {
                connection.process = Some(process);
            }
            self.open.iter_mut().filter(|open| open.number == number).for_each(|open| open.looks = LOOKS);
        }
    }

    /// Reads a connection, and answers. Returns `false` at its end.
    fn read(&mut self, open: &mut Open) -> bool {
        let mut bytes = [0; 4096];
        loop {
            let begin = Instant::now();
            match open.stream.read(&mut bytes) {
                Ok(0) => return false,
                Ok(length) => {
                    let now = Instant::now();
                    let arrival = Arrival { connection: open.number, after: open.quiet, before: now };
                    self.record.lock().unwrap().arrivals.push(arrival);
                    self.last.lock().unwrap()[open.link] = Some(now);
                    open.quiet = begin;
                    open.buffer.extend_from_slice(&bytes[..length]);
                    let mut replies = BytesMut::new();
                    while let Ok(Some(received)) = open.codec.decode(&mut open.buffer) {
                        self.buses[open.link].answer(&received, Framing::Ascii, &mut replies);
                    }
                    // A reply is short, and the peer may have gone.
                    let _ = open.stream.write_all(&replies);
                }
                Err(error) if error.kind() == ErrorKind::WouldBlock => {
                    open.quiet = begin;
                    return true;
                }
                Err(_) => return false,
            }
        }
    }
}
