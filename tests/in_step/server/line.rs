//! The PLC's side of the line: a queue of requests, and copies of replies.

use std::collections::VecDeque;
use std::io::Write;
use std::net::{Shutdown, SocketAddr, TcpStream, UdpSocket};
use std::sync::mpsc::{Receiver, RecvTimeoutError};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, Instant};

use bytes::{Bytes, BytesMut};
use fatek::ErrorCode;
use fatek::command::{Request, encode_refusal};
use fatek::sim::Bus;
use fatek::wire::{Codec, Frame, Received, Side};
use tokio_util::codec::{Decoder, Encoder};

use super::{Copy, ReplyTo, Sent, Setup, Transport};

/// Sender of a request.
#[derive(Clone, Debug)]
pub(super) enum Client {
    Tcp(Arc<TcpStream>),
    Udp(SocketAddr),
    #[cfg(unix)]
    Serial,
}

impl Client {
    fn is(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Tcp(this), Self::Tcp(other)) => Arc::ptr_eq(this, other),
            (Self::Udp(this), Self::Udp(other)) => this == other,
            #[cfg(unix)]
            (Self::Serial, Self::Serial) => true,
            _ => false,
        }
    }
}

pub(super) enum Event {
    Opened(Client),
    Closed(Client),
    Request { frame: Frame, from: Client, at: Instant },
    Stop,
}

pub(super) enum Output {
    Tcp,
    Udp(Arc<UdpSocket>),
    #[cfg(unix)]
    Serial(std::fs::File, Duration),
}

impl Output {
    /// Sends bytes. A client that has gone is no error.
    fn send(&mut self, to: &Client, bytes: &[u8]) {
        match (self, to) {
            (_, Client::Tcp(stream)) => drop((&**stream).write_all(bytes)),
            (Self::Udp(socket), Client::Udp(address)) => drop(socket.send_to(bytes, address)),
            #[cfg(unix)]
            (Self::Serial(line, character), Client::Serial) => {
                thread::sleep(*character * u32::try_from(bytes.len()).unwrap());
                let _ = line.write_all(bytes);
            }
            _ => unreachable!("a client of another transport"),
        }
    }
}

/// A frame to send. A copy without a due time goes out just before the next reply.
struct Pending {
    due: Option<Instant>,
    to: Client,
    bytes: Bytes,
}

/// The queue of requests and the copies that are due.
pub(super) struct Line {
    setup: Setup,
    bus: Bus,
    output: Output,
    /// Clients in the order of connecting; over UDP only the most recent sender.
    clients: Vec<Client>,
    sent: Arc<Mutex<Sent>>,
    served: usize,
}

impl Line {
    pub(super) fn new(setup: Setup, bus: Bus, output: Output, sent: Arc<Mutex<Sent>>) -> Self {
        Self { setup, bus, output, clients: vec![], sent, served: 0 }
    }

    pub(super) fn run(mut self, events: &Receiver<Event>) {
        let mut queue = VecDeque::new();
        let mut copies = VecDeque::<Pending>::new();
        let mut current: Option<(Instant, Frame, Client)> = None;
        let mut free = Instant::now();
        loop {
            if current.is_none()
                && let Some((frame, from, at)) = queue.pop_front()
            {
                current = Some((free.max(at) + self.plc_time(), frame, from));
            }
            let copy_due = copies.front().and_then(|copy| copy.due);
            let reply_due = current.as_ref().map(|&(due, ..)| due);
            let next = copy_due.into_iter().chain(reply_due).min();
            let wait = next.map_or(Duration::from_secs(3600), |due| due.saturating_duration_since(Instant::now()));
            match events.recv_timeout(wait) {
                Ok(Event::Opened(client)) => self.clients.push(client),
                Ok(Event::Closed(client)) => self.clients.retain(|other| !other.is(&client)),
                Ok(Event::Request { frame, from, at }) => {
                    if !matches!(from, Client::Tcp(_)) {
                        self.clients = vec![from.clone()];
                    }
                    queue.push_back((frame, from, at));
                }
                Ok(Event::Stop) | Err(RecvTimeoutError::Disconnected) => return self.close(),
                Err(RecvTimeoutError::Timeout) => {}
            }
            let now = Instant::now();
            while copies.front().is_some_and(|copy| copy.due.is_some_and(|due| due <= now)) {
                self.send_all(copies.pop_front(), 0);
            }
            if let Some((due, frame, from)) = current.take_if(|(due, ..)| *due <= now) {
                free = due;
                if let Some((bytes, copy)) = self.answer(&frame) {
                    let reply = Pending { due: None, to: from.clone(), bytes: bytes.clone() };
                    let copy = copy.map(|(copy, bytes)| {
                        let due = copy.after.map(|after| Instant::now() + after);
                        Pending { due, to: from, bytes }
                    });
                    let at_once = copy.as_ref().is_some_and(|copy| copy.due.is_some_and(|due| due <= Instant::now()));
                    let (now, later) = if at_once { (copy, None) } else { (None, copy) };
                    self.send_all(copies.drain(..).chain([reply]).chain(now), 1);
                    copies.extend(later);
                }
            }
        }
    }

    fn plc_time(&mut self) -> Duration {
        self.served += 1;
        let (slow, time) = self.setup.slow_start;
        if self.served <= slow { time } else { self.setup.plc_time }
    }

    /// Reply to a request, if any, and its copy.
    fn answer(&mut self, frame: &Frame) -> Option<(Bytes, Option<(Copy, Bytes)>)> {
        let framing = self.setup.framing;
        let broadcast = frame.station == 0;
        let station = if broadcast { self.setup.broadcast_reply } else { Some(frame.station) };
        let request = Frame { station: if broadcast { 1 } else { frame.station }, ..frame.clone() };
        let mut reply = BytesMut::new();
        if Request::decode(frame, framing).is_ok_and(|request| (self.setup.refuses)(&request)) {
            encode_refusal(frame.command, ErrorCode::IllegalFormat, framing, request.station, &mut reply);
        } else {
            self.bus.answer(&Received::Frame(request), framing, &mut reply);
        }
        let station = station.filter(|_| !reply.is_empty())?;
        if broadcast {
            let mut codec = Codec::new(framing, Side::Client);
            let unheard = codec.decode(&mut reply).unwrap().and_then(Received::frame).unwrap();
            Codec::new(framing, Side::Plc).encode(Frame { station, ..unheard }, &mut reply).unwrap();
        }
        let reply = reply.freeze();
        let copy = (self.setup.copies)(frame.command).map(|copy| {
            let mut refusal = BytesMut::new();
            encode_refusal(frame.command, ErrorCode::IllegalFormat, framing, station, &mut refusal);
            (copy, if copy.refused { refusal.freeze() } else { reply.clone() })
        });
        Some((reply, copy))
    }

    /// Sends frames at the same moment: copies, and this number of replies.
    fn send_all(&mut self, frames: impl IntoIterator<Item = Pending>, replies: usize) {
        let mut segments: Vec<(Client, BytesMut)> = vec![];
        let mut count = 0;
        for frame in frames {
            count += 1;
            let to = match self.setup.reply_to {
                ReplyTo::Sender => Some(&frame.to),
                ReplyTo::Latest => self.clients.last(),
            };
            match (to, segments.last_mut()) {
                (None, _) => {}
                (Some(to), Some((client, segment)))
                    if self.setup.in_one_segment && self.setup.transport != Transport::Udp && client.is(to) =>
                {
                    segment.extend_from_slice(&frame.bytes);
                }
                (Some(to), _) => segments.push((to.clone(), BytesMut::from(&frame.bytes[..]))),
            }
        }
        for (client, segment) in segments {
            self.output.send(&client, &segment);
        }
        let mut sent = self.sent.lock().unwrap();
        sent.replies += replies;
        sent.copies += count - replies;
    }

    fn close(self) {
        for client in self.clients {
            if let Client::Tcp(stream) = client {
                let _ = stream.shutdown(Shutdown::Both);
            }
        }
    }
}
