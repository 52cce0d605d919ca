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
            Kind::Mixed(_) => (2, Sort::Read, mixed(scattered(first, count))),
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
        let others: Vec<(Request, Option<u16>)> = match &self.request {
            Request::ReadRegisters(_) => {
                let (all, extra) = (first..first + count, first + count);
                let mut others =
                    vec![(Request::ReadRegisters(read(first, count + 1)), Some(extra)), (mixed(all), None)];
                if let Some(before) = first.checked_sub(1) {
                    others.push((Request::ReadRegisters(read(before, count + 1)), Some(before)));
                }
                others
            }
            Request::ReadMixed(_) => vec![(mixed(scattered(first, count).chain([first])), Some(first))],
            Request::WriteRegisters(_) if !self.broadcast => {
                let items = vec![(Element::from(register(first)), Value::Word(first))];
                vec![(Request::WriteMixed(WriteMixed::new(items).expect("one register")), None)]
            }
            _ => Vec::new(),
        };
        let shown: Vec<u16> = match &self.request {
            Request::ReadRegisters(_) => (first..first + count).collect(),
            Request::ReadMixed(_) => scattered(first, count).collect(),
            _ => Vec::new(),
        };
        let plain = [(self.request.clone(), None)];
        let spellings = plain.into_iter().chain(others).filter_map(|(request, extra)| {
            let mut bytes = BytesMut::new();
            request.encode(framing, station, &mut bytes).ok()?;
            let shows = shown.iter().copied().chain(extra).collect();
            let before = matches!(self.request, Request::ReadRegisters(_)) && extra.is_some_and(|extra| extra < first);
            Some(Spelling { request: bytes.to_vec(), extra, before, shows })
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

/// The addresses of a list: every other one.
fn scattered(first: u16, count: u16) -> impl Iterator<Item = u16> {
    (first..).step_by(2).take(count.into())
}

fn mixed(addresses: impl Iterator<Item = u16>) -> Request {
    let elements: Vec<_> = addresses.map(|address| Element::from(register(address))).collect();
    Request::ReadMixed(ReadMixed::new(elements).expect("a few registers"))
}
