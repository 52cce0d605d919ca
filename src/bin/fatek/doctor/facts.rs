//! Facts of an examination, by the exchanges so far.

use std::collections::BTreeMap;

use fatek::MemoryMap;
use fatek::command::DetailedStatus;
use fatek::memory_map::PlcModel;
use fatek::wire::Framing;

use super::exchange::{Answer, Ask, Exchange};
use super::line::Medium;
use super::request::Requests;

/// Properties of the PLC and its line that have shown so far.
#[derive(Debug)]
pub(crate) struct Facts {
    pub(crate) requests: Requests,
    pub(crate) medium: Medium,
    /// All exchanges, those that separate others included.
    pub(crate) log: Vec<Exchange>,
    /// Of the commands that were asked: whether one was answered with data.
    answered: BTreeMap<u8, bool>,
    detailed: Option<DetailedStatus>,
    /// The line sends back each request.
    pub(crate) echoes: bool,
}

impl Facts {
    pub(crate) fn new(requests: Requests, medium: Medium) -> Self {
        Self { requests, medium, log: Vec::new(), answered: BTreeMap::new(), detailed: None, echoes: false }
    }

    pub(crate) fn framing(&self) -> Framing {
        self.requests.framing
    }

    /// Adds an exchange.
    pub(crate) fn note(&mut self, exchange: Exchange) {
        let framing = self.framing();
        if let (Some(request), Answer::Data(data)) = (exchange.ask.request(), exchange.answer(framing)) {
            self.answered.insert(request.frame.command, true);
            if request.frame.command == 0x53 {
                self.detailed = DetailedStatus::from_raw(self.requests.bytes(data));
            }
        } else if let (Some(request), Ask::Reply(_)) = (exchange.ask.request(), &exchange.ask) {
            self.answered.entry(request.frame.command).or_insert(false);
        }
        self.log.push(exchange);
    }

    /// Returns whether a command is executed; `None` if it was not asked.
    pub(crate) fn has_command(&self, code: u8) -> Option<bool> {
        self.answered.get(&code).copied()
    }

    /// The detailed status, if the PLC has sent one.
    pub(crate) fn detailed(&self) -> Option<&DetailedStatus> {
        self.detailed.as_ref()
    }

    /// The model whose counts are those of the PLC, or else the one with the same number of registers D.
    pub(crate) fn model(&self) -> Option<PlcModel> {
        let own = counts(self.detailed.as_ref()?);
        let with = |is_it: &dyn Fn(&[u16]) -> bool| {
            PlcModel::ALL.iter().copied().find(|model| is_it(&counts(&model.detailed_status())))
        };
        with(&|known| known == own).or_else(|| with(&|known| known.get(D) == own.get(D)))
    }

    /// The memory map of the model.
    pub(crate) fn map(&self) -> Option<MemoryMap> {
        self.model().map(MemoryMap::of)
    }
}

/// The counts of relays, registers, timers and counters in a detailed status.
pub(crate) fn counts(status: &DetailedStatus) -> [u16; 7] {
    [
        status.m_relays(),
        status.s_relays(),
        status.l_relays(),
        status.r_registers(),
        status.d_registers(),
        status.timers(),
        status.counters(),
    ]
}

/// Place of the registers D among the [`counts`].
const D: usize = 4;
