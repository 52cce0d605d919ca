//! `fatek scan --discover`: Ethernet modules that answer a broadcast. Unverified on hardware.

mod packet;

use std::collections::BTreeMap;
use std::io;
use std::net::{IpAddr, Ipv4Addr, SocketAddr, SocketAddrV4};
use std::time::Duration;

use fatek::endpoint;
use tokio::net::UdpSocket;
use tokio::time::{Instant, timeout_at};

use self::packet::{Module, PACKETS, PORT};
use crate::args::DiscoverArgs;
use crate::failure::Failure;
use crate::output::{Format, Output, Rows, hex};
use crate::printable::excerpt;
use crate::progress::StatusLine;
use crate::signal::unless_signalled;

/// The broadcast address of all networks of this computer; most systems use one network only.
pub(crate) const DEFAULT_BROADCAST: &str = "255.255.255.255";
/// Time for replies without `--timeout`.
const DEFAULT_TIMEOUT: Duration = Duration::from_secs(2);
/// Limit of the replies that are kept.
const MAX_REPLIES: usize = 4096;
/// Bytes of an unknown reply that are shown.
const SHOWN: usize = 24;
const UNVERIFIED: &str = "unverified on hardware";

/// Replies by sender; a module may send the same one for each packet.
type Replies = BTreeMap<SocketAddr, Vec<Vec<u8>>>;

pub(crate) async fn discover(args: &DiscoverArgs, given: Option<Duration>, output: &Output) -> Result<(), Failure> {
    let addresses: Vec<SocketAddr> = args.broadcast.iter().map(|text| address(text)).collect::<Result<_, _>>()?;
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, args.source_port)).await;
    let socket = socket.and_then(|socket| socket.set_broadcast(true).map(|()| socket));
    let socket = socket.map_err(|error| Failure::Discover {
        subject: format!("UDP port {} (--source-port chooses another)", args.source_port),
        error,
    })?;
    for address in &addresses {
        for packet in PACKETS {
            let sent = socket.send_to(&packet, address).await;
            sent.map_err(|error| Failure::Discover { subject: address.to_string(), error })?;
        }
    }
    output.remark(format_args!("discovery of modules is {UNVERIFIED}"));
    let mut replies = Replies::new();
    let progress = StatusLine::new(output);
    let received =
        unless_signalled(receive(&socket, given.unwrap_or(DEFAULT_TIMEOUT), &mut replies, &progress)).await?;
    drop(progress);
    print(&replies, output)?;
    received
        .map_err(Failure::interrupted(""))?
        .map_err(|error| Failure::Discover { subject: format!("UDP port {}", args.source_port), error })?;
    let all = replies.iter().flat_map(|(sender, replies)| replies.iter().map(move |reply| (sender, reply)));
    let known = all.clone().filter_map(|(sender, reply)| Some((sender, Module::parse(reply)?)));
    if let Some((sender, module)) = known.clone().next() {
        output.remark(format_args!("hint: to find its stations: {}", scan_command(sender.ip(), module.fatek_port)));
    }
    match (known.count(), all.count()) {
        (0, 0) => Err(Failure::NoModule),
        (0, unknown) => Err(Failure::UnknownReplies { unknown }),
        (_, _) => Ok(()),
    }
}

/// The scan of a module. `address`: the sender of the reply, since a module can state another address.
fn scan_command(address: IpAddr, port: u16) -> String {
    match port {
        0 | endpoint::DEFAULT_PORT => format!("fatek scan --network {address}"),
        _ => format!("fatek scan --network {address} --tcp {port} --udp {port}"),
    }
}

/// Parses an IPv4 address, with a port if it is not the modules' own.
fn address(text: &str) -> Result<SocketAddr, Failure> {
    let address = text.parse::<SocketAddrV4>().ok().filter(|address| address.port() != 0);
    let address = address.or_else(|| Some(SocketAddrV4::new(text.parse().ok()?, PORT)));
    let rule = "an IPv4 address, such as 192.168.1.255, if need be with a port";
    address.map(SocketAddr::V4).ok_or_else(|| Failure::Usage(format!("`{}` is not {rule}", excerpt(text))))
}

/// Collects replies for this time.
async fn receive(socket: &UdpSocket, time: Duration, all: &mut Replies, progress: &StatusLine) -> io::Result<()> {
    let until = Instant::now() + time;
    let mut buffer = [0; 2048];
    let mut count = 0;
    while count < MAX_REPLIES {
        progress.show(format_args!("{count} replies"));
        let (len, sender) = match timeout_at(until, socket.recv_from(&mut buffer)).await {
            Err(_) => break,
            Ok(Ok(received)) => received,
            // A host says that its port is closed: Windows reports this here.
            Ok(Err(error)) if error.kind() == io::ErrorKind::ConnectionReset => continue,
            Ok(Err(error)) => return Err(error),
        };
        let reply = buffer.get(..len).unwrap_or_default();
        let of_sender = all.entry(sender).or_default();
        if !of_sender.iter().any(|other| other == reply) {
            of_sender.push(reply.to_vec());
            count += 1;
            progress.event(format_args!("reply of {len} bytes from {sender}"));
        }
    }
    Ok(())
}

fn print(all: &Replies, output: &Output) -> Result<(), Failure> {
    let mut table = Rows::new(["sender", "name", "description", "firmware", "port", "mac", "note"]);
    let mut rows = Rows::new([
        "sender",
        "name",
        "description",
        "firmware",
        "mac",
        "address",
        "gateway",
        "mask",
        "fatek_port",
        "modbus_port",
        "verified",
        "note",
    ]);
    for (sender, reply) in all.iter().flat_map(|(sender, replies)| replies.iter().map(move |reply| (sender, reply))) {
        let module = Module::parse(reply);
        let module = module.as_ref();
        let note = note(*sender, reply, module);
        let sender = sender.ip().to_string();
        let name = module.map(|module| module.name.clone());
        let description = module.map(|module| module.description.clone());
        let firmware = module.map(Module::firmware_text);
        let mac = module.map(Module::mac_text);
        if output.format == Format::Table {
            let port = module.map(|module| u32::from(module.fatek_port));
            let row = [name.into(), description.into(), firmware.into(), port.into(), mac.into(), note.into()];
            let [name, description, firmware, port, mac, note] = row;
            table.push([sender.into(), name, description, firmware, port, mac, note]);
        } else {
            rows.push([
                sender.into(),
                name.into(),
                description.into(),
                firmware.into(),
                mac.into(),
                module.map(|module| module.address.to_string()).into(),
                module.map(|module| module.gateway.to_string()).into(),
                module.map(|module| module.mask.to_string()).into(),
                module.map(|module| u32::from(module.fatek_port)).into(),
                module.map(|module| u32::from(module.modbus_port)).into(),
                false.into(),
                note.into(),
            ]);
        }
    }
    output.rows(&if output.format == Format::Table { table.without_empty("note") } else { rows })
}

fn note(sender: SocketAddr, reply: &[u8], module: Option<&Module>) -> Option<String> {
    match module {
        Some(module) if IpAddr::from(module.address) != sender.ip() => {
            Some(format!("states the address {}", module.address))
        }
        Some(_) => None,
        None => {
            let shown = reply.get(..SHOWN).unwrap_or(reply);
            let more = if reply.len() > SHOWN { "..." } else { "" };
            let texts = packet::texts(reply);
            let texts = if texts.is_empty() { String::new() } else { format!(", with {}", texts.join(", ")) };
            Some(format!("unknown reply of {} bytes: {}{more}{texts}", reply.len(), hex(shown)))
        }
    }
}
