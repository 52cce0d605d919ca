//! Calls of the model's callers, with all spellings of their requests.

use bytes::BytesMut;
use fatek::command::{
    ControlPlc, ReadMixed, ReadProgramPage, ReadRegisters, Request, Value, WriteMixed, WriteRegisters,
};
use fatek::wire::Framing;
use fatek::{Element, Register, Symbol};

use super::op::CallKind;
use super::state::{CallClass, Spelling};

/// A call that a caller will make.
pub(crate) struct PlannedCall {
    pub(crate) broadcast: bool,
    pub(crate) lane: usize,
    pub(crate) class: CallClass,
    pub(crate) request: Request,
    first: u16,
    count: u16,
}

impl PlannedCall {
    /// Creates a call of a kind at this address.
    pub(crate) fn new(framing: Framing, kind: CallKind, first: u16) -> Self {
        let count = match kind {
            CallKind::Read(count) | CallKind::Mixed(count) => u16::from(count % 8) + 1,
            CallKind::Page(_)
            | CallKind::Write
            | CallKind::Broadcast
            | CallKind::Run
            | CallKind::Stop
            | CallKind::BroadcastRun => 1,
        };
        let (lane, class, request) = match kind {
            CallKind::Page(number) if framing == Framing::Ascii => {
                (2, CallClass::Page, Request::ReadProgramPage(ReadProgramPage::new(number.into())))
            }
            CallKind::Read(_) | CallKind::Page(_) => (2, CallClass::Read, Request::ReadRegisters(read(first, count))),
            CallKind::Mixed(_) => (2, CallClass::Read, mixed(scattered(first, count))),
            CallKind::Write | CallKind::Broadcast => {
                let write = WriteRegisters::new(register(first), [first]).expect("one register");
                (1, CallClass::Write, Request::WriteRegisters(write))
            }
            CallKind::Run | CallKind::BroadcastRun => (0, CallClass::Write, Request::ControlPlc(ControlPlc::Run)),
            CallKind::Stop => (0, CallClass::Write, Request::ControlPlc(ControlPlc::Stop)),
        };
        let broadcast = matches!(kind, CallKind::Broadcast | CallKind::BroadcastRun);
        Self { broadcast, lane, class, request, first, count }
    }

    /// All spellings of the request, from the table in docs/DESIGN.md, "In step". The first is the
    /// plain one.
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

    /// Number of registers in the result.
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

/// Addresses of a list: every other register from `first` on.
fn scattered(first: u16, count: u16) -> impl Iterator<Item = u16> {
    (first..).step_by(2).take(count.into())
}

fn mixed(addresses: impl Iterator<Item = u16>) -> Request {
    let elements: Vec<_> = addresses.map(|address| Element::from(register(address))).collect();
    Request::ReadMixed(ReadMixed::new(elements).expect("a few registers"))
}
