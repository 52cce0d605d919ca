//! The requests of the model's callers, and the other requests that ask for the same.

use bytes::BytesMut;
use fatek::command::{
    ControlPlc, ReadMixed, ReadProgramPage, ReadRegisters, Request, Value, WriteMixed, WriteRegisters,
};
use fatek::wire::Framing;
use fatek::{Element, Register, Symbol};

use super::op::Kind;
use super::state::{Sort, Spelling};

/// What a caller wants.
pub(crate) struct Wanted {
    pub(crate) broadcast: bool,
    pub(crate) lane: usize,
    pub(crate) sort: Sort,
    pub(crate) request: Request,
    first: u16,
    count: u16,
}

impl Wanted {
    /// The request of a kind, at this address.
    pub(crate) fn new(framing: Framing, kind: Kind, first: u16) -> Self {
        let count = match kind {
            Kind::Read(count) | Kind::Mixed(count) => u16::from(count % 8) + 1,
            Kind::Page(_) | Kind::Write | Kind::Broadcast | Kind::Run | Kind::Stop | Kind::BroadcastRun => 1,
        };
        let (lane, sort, request) = match kind {
            Kind::Page(number) if framing == Framing::Ascii => {
                (2, Sort::Page, Request::ReadProgramPage(ReadProgramPage::new(number.into())))
            }
            Kind::Read(_) | Kind::Page(_) => (2, Sort::Read, Request::ReadRegisters(read(first, count))),
            Kind::Mixed(_) => (2, Sort::Read, mixed((first..).take(count.into()))),
            Kind::Write | Kind::Broadcast => {
                let write = WriteRegisters::new(register(first), [first]).expect("one register");
                (1, Sort::Once, Request::WriteRegisters(write))
            }
            Kind::Run | Kind::BroadcastRun => (0, Sort::Once, Request::ControlPlc(ControlPlc::Run)),
            Kind::Stop => (0, Sort::Once, Request::ControlPlc(ControlPlc::Stop)),
        };
        let broadcast = matches!(kind, Kind::Broadcast | Kind::BroadcastRun);
        Self { broadcast, lane, sort, request, first, count }
    }

    /// The table of docs/DESIGN.md, "In step"; the first is the request itself.
    pub(crate) fn spellings(&self, framing: Framing, station: u8) -> Vec<Spelling> {
        let (first, count) = (self.first, self.count);
        let all = || (first..).take(count.into());
        let others: Vec<(Request, Option<u16>, u16)> = match &self.request {
            Request::ReadRegisters(_) => vec![
                (Request::ReadRegisters(read(first, count + 1)), Some(first + count), count + 1),
                (mixed(all()), None, count),
            ],
            Request::ReadMixed(_) => vec![(mixed(all().chain([first])), Some(first), 0)],
            Request::WriteRegisters(_) if !self.broadcast => {
                let items = vec![(Element::from(register(first)), Value::Word(first))];
                vec![(Request::WriteMixed(WriteMixed::new(items).expect("one register")), None, 0)]
            }
            _ => Vec::new(),
        };
        // Only a read of consecutive registers shows that the station has them.
        let shown = if matches!(self.request, Request::ReadRegisters(_)) { count } else { 0 };
        let plain = [(self.request.clone(), None, shown)];
        let spellings = plain.into_iter().chain(others).filter_map(|(request, extra, shown)| {
            let mut bytes = BytesMut::new();
            request.encode(framing, station, &mut bytes).ok()?;
            Some(Spelling { request: bytes.to_vec(), extra, shows: (first, shown) })
        });
        spellings.collect()
    }

    /// The number of registers that the caller gets.
    pub(crate) fn words(&self) -> usize {
        self.count.into()
    }
}

fn register(address: u16) -> Register {
    Register::new(Symbol::R, address).expect("there are 65536")
}

fn read(first: u16, count: u16) -> ReadRegisters<Register> {
    ReadRegisters::new(register(first), count.into()).expect("a few registers")
}

fn mixed(addresses: impl Iterator<Item = u16>) -> Request {
    let elements: Vec<_> = addresses.map(|address| Element::from(register(address))).collect();
    Request::ReadMixed(ReadMixed::new(elements).expect("a few registers"))
}
