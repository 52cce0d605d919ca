//! Test bench: a simulated PLC of modest size, a station, and all of its memory.

use std::time::Duration;

use fatek::command::{Request, Value};
use fatek::sim::{self, Bus, Faults, LogEntry, Model, Plc};
use fatek::tag::Tag;
use fatek::wire::Framing;
use fatek::{CallOptions, Element, Link, Station, Symbol, element};

pub(crate) use crate::rng::Rng;

pub(crate) const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

/// Last element of each area.
const LAST: [Element; 11] = [
    element!("X255"),
    element!("Y255"),
    element!("M2001"),
    element!("S999"),
    element!("T255"),
    element!("C255"),
    element!("RT255"),
    element!("DRC255"),
    element!("R3839"),
    element!("D3071"),
    element!("F100"),
];

pub(crate) struct Bench {
    pub(crate) plc: Plc,
    pub(crate) faults: Faults,
    pub(crate) framing: Framing,
    bus: Bus,
}

impl Bench {
    pub(crate) fn new(framing: Framing, faults: Faults) -> Self {
        Self::with_model(framing, faults, model())
    }

    pub(crate) fn with_model(framing: Framing, faults: Faults, model: Model) -> Self {
        let plc = Plc::with_model(model);
        let faults = faults.log_capacity(1_000_000);
        let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
        Self { plc, faults, framing, bus }
    }

    /// A station over a new link.
    pub(crate) fn station(&self) -> Station {
        self.station_named("in memory")
    }

    /// A station over a new link of this name.
    pub(crate) fn station_named(&self, name: &str) -> Station {
        let connector = sim::connector(self.bus.clone(), self.framing);
        let options = CallOptions::new().with_response_timeout(Duration::from_millis(60));
        Link::connector_builder(name, self.framing, connector).options(options).build().station(1).unwrap()
    }

    /// Fills all memory with random values.
    pub(crate) fn fill(&self, rng: &mut Rng) {
        for element in memory() {
            self.plc.write(element, random(element, rng)).unwrap();
        }
    }

    pub(crate) fn snapshot(&self) -> Vec<(Element, Value)> {
        memory().map(|element| (element, self.plc.read(element))).collect()
    }

    /// First element and count of all writes that arrived, refused and lost ones included.
    pub(crate) fn writes(&self) -> Vec<(Element, usize)> {
        self.faults.log().entries().iter().filter_map(written).collect()
    }

    pub(crate) fn clear_log(&self) {
        self.faults.log().clear();
    }
}

pub(crate) fn model() -> Model {
    LAST.into_iter().fold(Model::default(), Model::last)
}

/// All elements of this model, without overlaps.
pub(crate) fn memory() -> impl Iterator<Item = Element> {
    // Counters from DRC200 on have 32 bits, the others are `RC`.
    let symbol = |last: Element, address| match last.symbol() {
        Symbol::DRC if address < 200 => Symbol::RC,
        symbol => symbol,
    };
    LAST.into_iter()
        .flat_map(move |last| (0..=last.address()).map(move |address| element(symbol(last, address), address)))
}

fn element(symbol: Symbol, address: u16) -> Element {
    Element::new(symbol, address).unwrap()
}

pub(crate) fn random(element: Element, rng: &mut Rng) -> Value {
    let bits = rng.next();
    match element {
        Element::Discrete(_) => Value::Bit(bits & 1 == 1),
        Element::Register(_) => Value::Word(bits as u16),
        Element::Register32(_) => Value::DWord(bits as u32),
    }
}

pub(crate) fn written(entry: &LogEntry) -> Option<(Element, usize)> {
    Some(match entry.request()? {
        Request::WriteDiscretes(write) => (write.first().into(), write.states().len()),
        Request::WriteRegisters(write) => (write.first().into(), write.values().len()),
        Request::WriteRegisters32(write) => (write.first().into(), write.values().len()),
        // Another spelling of the same write: see `in_step`.
        Request::WriteMixed(write) => (write.items().first()?.0, write.items().len()),
        _ => return None,
    })
}

pub(crate) fn tags<const N: usize>(texts: [&str; N]) -> [Tag; N] {
    texts.map(|text| text.parse().unwrap())
}

/// The elements of these ranges as discretes and 16-bit registers.
pub(crate) fn base_elements(ranges: &[Tag]) -> Vec<Element> {
    let of = |range: &Tag| {
        let (first, last) = (range.first(), range.elements().last().unwrap());
        let symbol: Symbol = match first.symbol() {
            Symbol::WM | Symbol::DWM => Symbol::M,
            Symbol::WY | Symbol::DWY => Symbol::Y,
            Symbol::WX | Symbol::DWX => Symbol::X,
            Symbol::DR => Symbol::R,
            Symbol::DD => Symbol::D,
            Symbol::DRC if !first.is_counter_of_32_bits() => Symbol::RC,
            symbol => symbol,
        };
        (first.address()..last.address() + last.step()).map(move |address| element(symbol, address))
    };
    ranges.iter().flat_map(of).collect()
}
