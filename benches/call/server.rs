//! The other end: answers every request with the same prepared bytes, and does nothing else. It does not even look at a
//! request, for all that come are equally long.

use std::io;
use std::net::SocketAddr;

use bytes::BytesMut;
use fatek::command::{ReadRegisters, encode_reply, encode_request};
use fatek::register;
use fatek::wire::Framing;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpSocket, TcpStream};

use crate::Result;

/// What is read by each call.
pub(crate) const REGISTERS: usize = 64;

/// A request and the reply to it, as bytes.
#[derive(Clone, Debug)]
pub(crate) struct Script {
    pub(crate) request: Vec<u8>,
    pub(crate) reply: Vec<u8>,
    /// Whether the reply begins with the first two bytes of its request: the transaction id of Modbus.
    echoes_id: bool,
}

/// Where they are, and what they say.
#[derive(Debug)]
pub(crate) struct Servers {
    pub(crate) ascii: (SocketAddr, Script),
    pub(crate) binary: (SocketAddr, Script),
    pub(crate) modbus: (SocketAddr, Script),
}

impl Servers {
    /// Starts them in a thread of their own, which ends with the process.
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
    let mut buffer = [0; 1024];
    let mut filled = 0;
    loop {
        let read = stream.read(buffer.get_mut(filled..).unwrap_or_default()).await?;
        if read == 0 {
            return Ok(());
        }
        filled += read;
        while let Some((request, rest)) =
            buffer.get(..filled).and_then(|all| all.split_at_checked(script.request.len()))
        {
            if let (true, Some(id), Some(place)) = (script.echoes_id, request.get(..2), script.reply.get_mut(..2)) {
                place.copy_from_slice(id);
            }
            stream.write_all(&script.reply).await?;
            let left = filled - rest.len();
            buffer.copy_within(left..filled, 0);
            filled -= left;
        }
    }
}

fn values() -> Vec<u16> {
    (0_u16..).map(|n| n.wrapping_mul(0x1357)).take(REGISTERS).collect()
}

fn fatek(framing: Framing) -> Result<Script> {
    let asked = ReadRegisters::new(register!("R0"), REGISTERS)?;
    let (mut request, mut reply) = (BytesMut::new(), BytesMut::new());
    encode_request(&asked, framing, 1, &mut request)?;
    encode_reply(&asked, Ok(&values()), framing, 1, &mut reply);
    Ok(Script { request: request.to_vec(), reply: reply.to_vec(), echoes_id: false })
}

/// 03, read holding registers: id, protocol 0, length, unit, function, then address and count, or bytes and values.
fn modbus() -> Script {
    let request = vec![0, 0, 0, 0, 0, 6, 1, 3, 0, 0, 0, REGISTERS as u8];
    let mut reply = vec![0, 0, 0, 0, 0, 3 + 2 * REGISTERS as u8, 1, 3, 2 * REGISTERS as u8];
    reply.extend(values().into_iter().flat_map(u16::to_be_bytes));
    Script { request, reply, echoes_id: true }
}
