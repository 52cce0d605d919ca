//! Captures: files and streams of pcap and pcapng.
//!
//! Blocks are read one at a time, into a buffer of [`BUFFER_LEN`] bytes that grows up to
//! [`MAX_BLOCK_LEN`].

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io::{self, BufRead, Read};
use std::rc::Rc;
use std::time::Duration;

use pcap_parser::pcapng::Block;
use pcap_parser::traits::{PcapNGPacketBlock, PcapReaderIterator};
use pcap_parser::{LegacyPcapReader, PcapBlockOwned, PcapError, PcapNGReader};

use super::flows::Flows;
use super::packet::{self, Skipped};
use super::{ReadError, Remarks, Sink, SourceError};
use crate::conversation::Timestamp;

const BUFFER_LEN: usize = 64 * 1024;

/// Longest block. Programs that capture write packets of at most 256 KiB.
const MAX_BLOCK_LEN: usize = 4 * 1024 * 1024;

/// Interfaces of a section of pcapng.
const MAX_INTERFACES: usize = 65_536;

/// Link types of skipped packets that are told apart.
const MAX_LINK_TYPES: usize = 16;

const NANOSECONDS: u128 = 1_000_000_000;

/// Form of a capture, by its first four bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Form {
    Pcap,
    PcapNg,
}

impl Form {
    pub(super) fn of(head: &[u8]) -> Option<Self> {
        match head.get(..4)? {
            // Microseconds, nanoseconds, and the form with longer headers, of either byte order.
            b"\xA1\xB2\xC3\xD4" | b"\xD4\xC3\xB2\xA1" | b"\xA1\xB2\x3C\x4D" | b"\x4D\x3C\xB2\xA1"
            | b"\xA1\xB2\xCD\x34" | b"\x34\xCD\xB2\xA1" => Some(Self::Pcap),
            b"\x0A\x0D\x0D\x0A" => Some(Self::PcapNg),
            _ => None,
        }
    }
}

/// Reads a capture. Its connections are those with one of these ports.
pub(super) fn read(
    reader: &mut dyn BufRead,
    form: Form,
    ports: &[u16],
    sink: &mut Sink<'_>,
) -> Result<Remarks, ReadError> {
    let mut packets = PacketReader::new(ports);
    let ended = read_blocks(reader, form, &mut |block| packets.block(&block, sink));
    // Also of a capture that is cut off: its packets are good.
    for event in packets.flows.finish(packets.last_at) {
        sink(event).map_err(ReadError::Sink)?;
    }
    ended?;
    Ok(packets.remarks())
}

/// An action on the reader.
enum ReaderAction {
    Consume(usize),
    Refill,
    Grow,
    End,
    Fail(&'static str),
}

fn read_blocks(
    reader: &mut dyn BufRead,
    form: Form,
    each: &mut dyn FnMut(PcapBlockOwned<'_>) -> Result<(), ReadError>,
) -> Result<(), ReadError> {
    let head = head(reader, form)?;
    let failure = Failed::default();
    let input = Input { reader: io::Cursor::new(head).chain(reader), failure: failure.clone() };
    let opened: Result<Box<dyn PcapReaderIterator + '_>, _> = match form {
        Form::Pcap => LegacyPcapReader::new(BUFFER_LEN, input).map(|reader| Box::new(reader) as _),
        Form::PcapNg => PcapNGReader::new(BUFFER_LEN, input).map(|reader| Box::new(reader) as _),
    };
    let mut blocks = opened.map_err(|_| SourceError::Content("its first block is damaged or cut off".to_owned()))?;
    let mut capacity = BUFFER_LEN;
    loop {
        let action = match blocks.next() {
            Ok((len, block)) => {
                each(block)?;
                ReaderAction::Consume(len)
            }
            Err(PcapError::Eof) => ReaderAction::End,
            Err(PcapError::Incomplete(_)) => ReaderAction::Refill,
            Err(PcapError::BufferTooSmall) => ReaderAction::Grow,
            Err(PcapError::UnexpectedEof) => ReaderAction::Fail("it is cut off"),
            Err(PcapError::ReadError) => ReaderAction::Fail("it cannot be read"),
            Err(PcapError::HeaderNotRecognized | PcapError::NomError(..) | PcapError::OwnedNomError(..)) => {
                ReaderAction::Fail("it is damaged")
            }
        };
        let position = blocks.consumed();
        let fail = |rule: &str| SourceError::Content(format!("{rule} after byte {position}"));
        let held = blocks.data().len();
        match action {
            ReaderAction::Consume(0) => return Err(fail("it has an empty block").into()),
            ReaderAction::Consume(len) => blocks.consume(len),
            ReaderAction::End => return Ok(()),
            ReaderAction::Fail(rule) => return Err(fail(rule).into()),
            ReaderAction::Refill if blocks.reader_exhausted() => {
                return if held == 0 { Ok(()) } else { Err(fail("it is cut off").into()) };
            }
            ReaderAction::Refill | ReaderAction::Grow => {
                let refilled = blocks.refill().is_ok();
                if let Some(error) = failure.borrow_mut().take() {
                    return Err(error.into());
                }
                if !refilled {
                    return Err(fail("it cannot be read").into());
                }
                // A full buffer takes no more bytes, and a block that is longer needs them.
                if blocks.data().len() == held && !blocks.reader_exhausted() || matches!(action, ReaderAction::Grow) {
                    capacity = capacity.saturating_mul(2);
                    if capacity > MAX_BLOCK_LEN || !blocks.grow(capacity) {
                        return Err(fail("it has a block that is too long").into());
                    }
                }
            }
        }
    }
}

/// Reads the first header, which the parser wants whole.
fn head(reader: &mut dyn BufRead, form: Form) -> io::Result<Vec<u8>> {
    let mut head = Vec::new();
    let mut read_to = |len: usize, head: &mut Vec<u8>| {
        let missing = u64::try_from(len.saturating_sub(head.len())).unwrap_or_default();
        (&mut *reader).take(missing).read_to_end(head).map(drop)
    };
    match form {
        Form::Pcap => read_to(24, &mut head)?,
        Form::PcapNg => {
            // Type, length, and the magic number of the byte order.
            read_to(12, &mut head)?;
            let length = head.get(4..).and_then(|rest| rest.first_chunk()).copied().unwrap_or_default();
            let is_little = head.get(8) == Some(&0x4D);
            let length = if is_little { u32::from_le_bytes(length) } else { u32::from_be_bytes(length) };
            let length = usize::try_from(length).unwrap_or(usize::MAX).min(BUFFER_LEN / 2);
            read_to(length, &mut head)?;
        }
    }
    Ok(head)
}

/// The error of a reader, which the parser does not keep.
type Failed = Rc<RefCell<Option<io::Error>>>;

struct Input<R> {
    reader: R,
    failure: Failed,
}

impl<R: Read> Read for Input<R> {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        loop {
            match self.reader.read(buffer) {
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => {
                    let kind = error.kind();
                    *self.failure.borrow_mut() = Some(error);
                    return Err(kind.into());
                }
                read => return read,
            }
        }
    }
}

/// Interface of a capture.
#[derive(Clone, Copy, Debug)]
struct Interface {
    link_type: i32,
    /// Units of time per second.
    resolution: u64,
    /// Seconds that are added.
    offset: i64,
}

#[derive(Debug)]
struct PacketReader<'p> {
    flows: Flows<'p>,
    ports: &'p [u16],
    interfaces: Vec<Interface>,
    last_at: Timestamp,
    count: u64,
    cut: u64,
    skipped: BTreeMap<Skipped, u64>,
}

impl<'p> PacketReader<'p> {
    fn new(ports: &'p [u16]) -> Self {
        Self {
            flows: Flows::new(ports),
            ports,
            interfaces: Vec::new(),
            last_at: Timestamp::ZERO,
            count: 0,
            cut: 0,
            skipped: BTreeMap::new(),
        }
    }

    fn block(&mut self, block: &PcapBlockOwned<'_>, sink: &mut Sink<'_>) -> Result<(), ReadError> {
        match block {
            PcapBlockOwned::LegacyHeader(header) => {
                let resolution = if header.is_nanosecond_precision() { 1_000_000_000 } else { 1_000_000 };
                self.interfaces = vec![Interface { link_type: header.network.0, resolution, offset: 0 }];
                Ok(())
            }
            PcapBlockOwned::Legacy(packet) => {
                let Some(&interface) = self.interfaces.first() else { return Ok(()) };
                let units = u64::from(packet.ts_sec)
                    .saturating_mul(interface.resolution)
                    .saturating_add(u64::from(packet.ts_usec));
                self.packet(interface, interface.time(units), packet.data, sink)
            }
            PcapBlockOwned::NG(Block::SectionHeader(_)) => {
                self.interfaces.clear();
                Ok(())
            }
            PcapBlockOwned::NG(Block::InterfaceDescription(interface)) => {
                if self.interfaces.len() >= MAX_INTERFACES {
                    return Err(SourceError::Content(format!("it has more than {MAX_INTERFACES} interfaces")).into());
                }
                self.interfaces.push(Interface {
                    link_type: interface.linktype.0,
                    resolution: interface.ts_resolution().unwrap_or(1_000_000).max(1),
                    offset: interface.ts_offset(),
                });
                Ok(())
            }
            PcapBlockOwned::NG(Block::EnhancedPacket(packet)) => {
                let number = usize::try_from(packet.if_id).unwrap_or(usize::MAX);
                let Some(&interface) = self.interfaces.get(number) else {
                    return Err(
                        SourceError::Content(format!("it has a packet of an unknown interface, {number}")).into()
                    );
                };
                let units = u64::from(packet.ts_high) << 32 | u64::from(packet.ts_low);
                self.packet(interface, interface.time(units), packet.packet_data(), sink)
            }
            PcapBlockOwned::NG(Block::SimplePacket(packet)) => {
                // It has no time, and is of the first interface.
                let Some(&interface) = self.interfaces.first() else { return Ok(()) };
                self.packet(interface, self.last_at, packet.packet_data(), sink)
            }
            // Names, statistics, comments.
            PcapBlockOwned::NG(_) => Ok(()),
        }
    }

    fn packet(
        &mut self,
        interface: Interface,
        at: Timestamp,
        data: &[u8],
        sink: &mut Sink<'_>,
    ) -> Result<(), ReadError> {
        self.count += 1;
        self.last_at = at;
        let packet = match packet::parse(interface.link_type, data) {
            Ok(packet) => packet,
            Err(skipped) => {
                if self.skipped.len() < MAX_LINK_TYPES || self.skipped.contains_key(&skipped) {
                    *self.skipped.entry(skipped).or_default() += 1;
                }
                return Ok(());
            }
        };
        let before = self.flows.connections();
        let events = self.flows.push(at, &packet);
        self.cut += u64::from(packet.missing > 0 && (!events.is_empty() || self.flows.connections() > before));
        events.into_iter().try_for_each(|event| sink(event).map_err(ReadError::Sink))
    }

    fn remarks(&self) -> Remarks {
        let mut remarks = Remarks::new();
        let packets = |count: u64| if count == 1 { "1 packet".to_owned() } else { format!("{count} packets") };
        for (skipped, &count) in &self.skipped {
            match skipped {
                Skipped::LinkType(number) => {
                    remarks.push(format!("{} of the unknown link type {number} skipped", packets(count)));
                }
                Skipped::Fragment => remarks.push(format!("{} skipped: fragments of IP", packets(count))),
                Skipped::Other => {}
            }
        }
        if self.cut > 0 {
            remarks.push(format!("{} cut off by the capture: capture with a larger length (-s)", packets(self.cut)));
        }
        if self.flows.connections() == 0 {
            let ports = self.ports.iter().map(u16::to_string).collect::<Vec<_>>().join(" or ");
            let other =
                self.flows.other_port().map(|port| format!("; most of them have port {port}: try --port {port}"));
            let other = other.unwrap_or_default();
            remarks.push(format!("none of {} has port {ports}{other}", packets(self.count)));
        }
        remarks
    }
}

impl Interface {
    /// Time of a number of units.
    fn time(&self, units: u64) -> Timestamp {
        let nanoseconds = u128::from(units) * NANOSECONDS / u128::from(self.resolution);
        let (seconds, rest) = (nanoseconds / NANOSECONDS, nanoseconds % NANOSECONDS);
        let seconds = u64::try_from(seconds).unwrap_or(u64::MAX).saturating_add_signed(self.offset);
        Duration::new(seconds, u32::try_from(rest).unwrap_or_default())
    }
}

#[cfg(test)]
mod tests;
