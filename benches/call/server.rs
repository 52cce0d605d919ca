//! Server that answers each request with prepared bytes.
//!
//! It compares requests with the prepared ones, and decodes only the checks of a link.

use std::io;
use std::net::SocketAddr;

use bytes::BytesMut;
use fatek::command::{ReadMixed, ReadRegisters, encode_reply, encode_request};
use fatek::wire::{Codec, Framing, Side};
use fatek::{Element, register};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};
use tokio_util::codec::{Decoder, Encoder};

use crate::Result;

/// Number of registers per call.
pub(crate) const REGISTERS: usize = 64;

/// Bytes of a request and of its reply.
#[derive(Clone, Debug)]
pub(crate) struct Script {
    pub(crate) request: Vec<u8>,
    pub(crate) reply: Vec<u8>,
    /// Other spelling of the request (48), which a link uses in turn, and its reply.
    other: Option<(Vec<u8>, Vec<u8>)>,
    /// `None` for Modbus, whose reply begins with the transaction id of its request.
    framing: Option<Framing>,
}

/// Addresses and scripts of the servers.
#[derive(Debug)]
pub(crate) struct Servers {
    pub(crate) ascii: (SocketAddr, Script),
    pub(crate) binary: (SocketAddr, Script),
    pub(crate) modbus: (SocketAddr, Script),
}

impl Servers {
    /// Starts the servers in one thread, which ends with the process.
    pub(crate) fn start() -> Result<Self> {
        let (started, addresses) = std::sync::mpsc::channel();
        let scripts = [fatek(Framing::Ascii)?, fatek(Framing::Binary)?, modbus()];
        let run = scripts.clone();
        std::thread::Builder::new().name("server".to_owned()).spawn(move || -> io::Result<()> {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_io().build()?;
            runtime.block_on(async {
                for script in run {
                    let socket = TcpSocket::new_v4()?;
                    socket.bind(SocketAddr::from(([127, 0, 0, 1], 0)))?;
                    let listener = socket.listen(4096)?;
                    let _ = started.send(listener.local_addr()?);
                    tokio::spawn(accept(listener, script));
                }
                std::future::pending().await
            })
        })?;
        let [ascii, binary, modbus] = scripts;
        Ok(Self {
            ascii: (addresses.recv()?, ascii),
            binary: (addresses.recv()?, binary),
            modbus: (addresses.recv()?, modbus),
        })
    }
}

async fn accept(listener: TcpListener, script: Script) -> io::Result<()> {
    loop {
        let (stream, _) = listener.accept().await?;
        stream.set_nodelay(true)?;
        tokio::spawn(answer(stream, script.clone()));
    }
}

async fn answer(mut stream: TcpStream, mut script: Script) -> io::Result<()> {
    let mut buffer = [0; 2048];
    let mut filled = 0;
    loop {
        let read = stream.read(buffer.get_mut(filled..).unwrap_or_default()).await?;
        if read == 0 {
            return Ok(());
        }
        filled += read;
        while let Some(taken) = script.answer(buffer.get(..filled).unwrap_or_default(), &mut stream).await? {
            buffer.copy_within(taken..filled, 0);
            filled -= taken;
        }
    }
}

impl Script {
    /// Answers the first request of these bytes. Returns its length, or `None` if it is incomplete.
    async fn answer(&mut self, bytes: &[u8], stream: &mut TcpStream) -> io::Result<Option<usize>> {
        let Some(framing) = self.framing else {
            let Some(request) = bytes.get(..self.request.len()) else { return Ok(None) };
            if let (Some(id), Some(place)) = (request.get(..2), self.reply.get_mut(..2)) {
                place.copy_from_slice(id);
            }
            stream.write_all(&self.reply).await?;
            return Ok(Some(self.request.len()));
        };
        let plain = (&self.request, &self.reply);
        for (request, reply) in [plain].into_iter().chain(self.other.as_ref().map(|(request, reply)| (request, reply)))
        {
            if bytes.starts_with(request) {
                stream.write_all(reply).await?;
                return Ok(Some(request.len()));
            }
            if request.starts_with(bytes) {
                return Ok(None);
            }
        }
        self.answer_check(framing, bytes, stream).await
    }

    /// Answers the check of a link: a loop-back (4E), whose reply is its data.
    async fn answer_check(&self, framing: Framing, bytes: &[u8], stream: &mut TcpStream) -> io::Result<Option<usize>> {
        let mut left = BytesMut::from(bytes);
        let mut codec = Codec::new(framing, Side::Plc);
        let Some(frame) = codec.decode(&mut left)?.and_then(|item| item.frame()) else { return Ok(None) };
        assert_eq!(frame.command, 0x4E, "unknown request");
        let mut echo = BytesMut::new();
        codec.encode(&frame, &mut echo).map_err(io::Error::other)?;
        stream.write_all(&echo).await?;
        Ok(Some(bytes.len() - left.len()))
    }
}

fn values() -> Vec<u16> {
    (0_u16..).map(|n| n.wrapping_mul(0x1357)).take(REGISTERS).collect()
}

fn fatek(framing: Framing) -> Result<Script> {
    let command = ReadRegisters::new(register!("R0"), REGISTERS)?;
    let (mut request, mut reply) = (BytesMut::new(), BytesMut::new());
    encode_request(&command, framing, 1, &mut request)?;
    encode_reply(&command, Ok(&values()), framing, 1, &mut reply);
    let first = Element::from(register!("R0"));
    let elements = (0..REGISTERS).map(|n| first.nth(n)).collect::<std::result::Result<Vec<_>, _>>()?;
    let command = ReadMixed::new(elements)?;
    let (mut mixed, mut mixed_reply) = (BytesMut::new(), BytesMut::new());
    encode_request(&command, framing, 1, &mut mixed)?;
    encode_reply(&command, Ok(&values().into_iter().map(Into::into).collect()), framing, 1, &mut mixed_reply);
    let other = Some((mixed.to_vec(), mixed_reply.to_vec()));
    Ok(Script { request: request.to_vec(), reply: reply.to_vec(), other, framing: Some(framing) })
}

/// Script of Modbus function 03, read holding registers.
///
/// Id, protocol 0, length, unit and function, followed by address and count, or by byte count and
/// values.
fn modbus() -> Script {
    let request = vec![0, 0, 0, 0, 0, 6, 1, 3, 0, 0, 0, REGISTERS as u8];
    let mut reply = vec![0, 0, 0, 0, 0, 3 + 2 * REGISTERS as u8, 1, 3, 2 * REGISTERS as u8];
    reply.extend(values().into_iter().flat_map(u16::to_be_bytes));
    Script { request, reply, other: None, framing: None }
}
