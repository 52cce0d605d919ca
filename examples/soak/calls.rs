//! Calls, and the checks of their results.

use fatek::command::{ControlDiscrete, ControlPlc, DiscreteControl, Request, WriteRegisters};
use fatek::wire::Framing;
use fatek::{Element, Error, Register, Register32, Station, Symbol, Value};
use tokio::time::Instant;

use crate::Result;
use crate::counters::count;
use crate::expected::Write;
use crate::layout::{self, CONSTANTS, DWORDS, Kind, Place};
use crate::line::Line;
use crate::rng::Rng;

/// One call of one caller.
pub(crate) struct Call<'a> {
    pub(crate) line: &'a Line,
    /// Index of the station, from 0.
    pub(crate) n: usize,
    pub(crate) station: Station,
    /// Number of the caller.
    pub(crate) caller: usize,
    pub(crate) rng: Rng,
}

/// Result of a call that was not dropped.
type CallResult = std::result::Result<(), Error>;

impl Call<'_> {
    /// Makes a random call. Fails if the call cannot be made at all.
    pub(crate) async fn make(mut self) -> Result<CallResult> {
        // Most calls have the same few shapes, so that replies can be confused.
        Ok(match self.rng.below(100) {
            0..20 => self.read_constants().await?,
            20..26 => self.read_constants32().await?,
            26..32 => self.read_relays().await?,
            32..37 => self.read_mixed_constants().await?,
            37..48 => self.read_dwords(self.caller).await?,
            48..51 => {
                let other = self.rng.below(self.line.callers);
                self.read_dwords(other).await?
            }
            51..66 => self.write_dwords().await?,
            66..70 => self.write_bits().await?,
            70..74 => self.read_bits().await?,
            74..80 => self.control(Kind::Switch).await?,
            80..84 => self.control(Kind::Force).await?,
            84..87 if self.running().owner == self.caller => self.control(Kind::Running).await?,
            84..88 => self.read_status().await?,
            88..90 => self.loop_back().await,
            90..93 if self.line.framing == Framing::Ascii => self.write_page().await?,
            90..96 if self.line.framing == Framing::Ascii => self.read_page().await?,
            90..97 => self.read_broadcast_cell().await?,
            // On one connection only: without replies the order of two connections is unknown.
            97..98 if self.caller < self.line.callers => self.broadcast().await?,
            _ => self.read_forced().await?,
        })
    }

    async fn read_constants(&mut self) -> Result<CallResult> {
        // Reads of more than 64 registers are split into several requests.
        let count = if self.rng.percent(80) { 1 } else { 1 + self.rng.below(100) };
        let first = self.rng.below(usize::from(CONSTANTS) - count) as u16;
        let read = self.station.read_registers(Register::r(first), count).await;
        Ok(read.map(|words| {
            let right = (0..count as u16).map(|i| layout::constant(self.line.number, self.n, first + i));
            self.compare("R", words.iter().copied().eq(right), first, count, &words);
        }))
    }

    async fn read_constants32(&mut self) -> Result<CallResult> {
        let count = if self.rng.percent(80) { 1 } else { 1 + self.rng.below(16) };
        let first = self.rng.below(usize::from(CONSTANTS) - 2 * count) as u16;
        let read = self.station.read_registers32(Register32::new(Symbol::DR, first)?, count).await;
        Ok(read.map(|dwords| {
            let word = |address| u32::from(layout::constant(self.line.number, self.n, address));
            let right = (0..count as u16).map(|i| first + 2 * i).map(|a| word(a + 1) << 16 | word(a));
            self.compare("DR", dwords.iter().copied().eq(right), first, count, &dwords);
        }))
    }

    async fn read_relays(&mut self) -> Result<CallResult> {
        let count = 1 + self.rng.below(64);
        let first = self.rng.below(usize::from(CONSTANTS) - count) as u16;
        let read = self.station.read_discretes(layout::relay(first)?, count).await;
        Ok(read.map(|states| {
            let right = (0..count as u16).map(|i| layout::constant_bit(self.line.number, self.n, first + i));
            self.compare("M", states.iter().copied().eq(right), first, count, &states);
        }))
    }

    async fn read_mixed_constants(&mut self) -> Result<CallResult> {
        let address = self.rng.below(usize::from(CONSTANTS)) as u16;
        let elements = [Element::from(Register::r(address)), layout::relay(address)?.into()];
        let read = self.station.read_mixed(&elements).await;
        Ok(read.map(|values| {
            let word = layout::constant(self.line.number, self.n, address);
            let on = layout::constant_bit(self.line.number, self.n, address);
            self.compare("R and M", values == [Value::Word(word), Value::Bit(on)], address, 2, &values);
        }))
    }

    /// Reads cells of an owner, by one of three commands.
    async fn read_dwords(&mut self, owner: usize) -> Result<CallResult> {
        let (first, count) = self.random_dwords();
        let register = layout::dword(owner, first)?;
        let began = Instant::now();
        let read = match self.rng.below(3) {
            0 => self.station.read_registers32(register, count).await,
            1 => self.station.read_registers(register.low()?, 2 * count).await.map(|words| layout::join(&words)),
            _ => {
                let read = self.station.read_mixed(&[register.into()]).await;
                read.map(|values| values.into_iter().map(dword_of).collect())
            }
        };
        Ok(read.map(|values| {
            for (n, &value) in (first..).zip(&values) {
                self.check_value(Place { station: self.n, owner, kind: Kind::DWord(n) }, value, began);
            }
        }))
    }

    async fn write_dwords(&mut self) -> Result<CallResult> {
        let (first, count) = self.random_dwords();
        let register = layout::dword(self.caller, first)?;
        let places: Vec<_> = (first..).take(count).map(|n| self.place(Kind::DWord(n))).collect();
        let (write, values) = self.line.expected().begin(&places, Instant::now());
        let result = match self.rng.below(10) {
            0..4 => self.station.write_registers32(register, &values).await,
            4..7 => self.station.write_registers(register.low()?, &layout::split(&values)).await,
            7..9 => {
                let registers: Vec<Register32> =
                    (first..).take(count).map(|n| layout::dword(self.caller, n)).collect::<Result<_>>()?;
                let items: Vec<_> =
                    registers.into_iter().map(Element::from).zip(values.iter().map(|&v| v.into())).collect();
                self.station.write_mixed(&items).await
            }
            _ => {
                // With retries of writes allowed.
                let request = Request::WriteRegisters32(WriteRegisters::new(register, values.clone())?);
                self.line.expected().may_be_repeated(self.n, request);
                let station = self.station.with_options(self.station.options().with_retry_writes(true));
                station.write_registers32(register, &values).await
            }
        };
        Ok(self.end(&write, result))
    }

    async fn write_bits(&mut self) -> Result<CallResult> {
        let (write, values) = self.line.expected().begin(&[self.place(Kind::Bits)], Instant::now());
        let first = layout::bits(self.caller)?;
        let result = match self.rng.below(2) {
            0 => self.station.write_discretes(first, &layout::split_bits(values[0])).await,
            _ => self.station.write_registers32(Register32::new(Symbol::DWM, first.address())?, &values).await,
        };
        Ok(self.end(&write, result))
    }

    async fn read_bits(&mut self) -> Result<CallResult> {
        let first = layout::bits(self.caller)?;
        let began = Instant::now();
        let read = match self.rng.below(2) {
            0 => self.station.read_discretes(first, 32).await.map(|states| layout::join_bits(&states)),
            _ => {
                let register = Register32::new(Symbol::DWM, first.address())?;
                self.station
                    .read_registers32(register, 1)
                    .await
                    .map(|values| values.first().copied().unwrap_or_default())
            }
        };
        Ok(read.map(|value| self.check_value(self.place(Kind::Bits), value, began)))
    }

    /// Sends a control command: set or reset, disable or enable, run or stop.
    async fn control(&mut self, kind: Kind) -> Result<CallResult> {
        let on = self.rng.percent(50);
        let discrete = |control, discrete| Request::ControlDiscrete(ControlDiscrete::new(control, discrete));
        let (output, input) = (layout::switch(self.caller)?, layout::force(self.caller)?);
        let request = match (kind, on) {
            (Kind::Switch, true) => discrete(DiscreteControl::Set, output),
            (Kind::Switch, false) => discrete(DiscreteControl::Reset, output),
            (Kind::Force, true) => discrete(DiscreteControl::Disable, input),
            (Kind::Force, false) => discrete(DiscreteControl::Enable, input),
            (_, true) => Request::ControlPlc(ControlPlc::Run),
            (_, false) => Request::ControlPlc(ControlPlc::Stop),
        };
        let place = if kind == Kind::Running { self.running() } else { self.place(kind) };
        let write = self.line.expected().begin_control(place, on, request, Instant::now());
        let result = match (kind, on) {
            (Kind::Switch, true) => self.station.set(output).await,
            (Kind::Switch, false) => self.station.reset(output).await,
            (Kind::Force, true) => self.station.disable(input).await,
            (Kind::Force, false) => self.station.enable(input).await,
            (_, true) => self.station.run().await,
            (_, false) => self.station.stop().await,
        };
        Ok(self.end(&write, result))
    }

    async fn read_forced(&mut self) -> Result<CallResult> {
        let began = Instant::now();
        if self.rng.percent(50) {
            let read = self.station.read_disabled(layout::force(self.caller)?, 1).await;
            return Ok(read.map(|states| self.check_value(self.place(Kind::Force), layout::join_bits(&states), began)));
        }
        let read = self.station.read_discretes(layout::switch(self.caller)?, 1).await;
        Ok(read.map(|states| self.check_value(self.place(Kind::Switch), layout::join_bits(&states), began)))
    }

    async fn read_status(&mut self) -> Result<CallResult> {
        let began = Instant::now();
        let flags = match self.rng.below(2) {
            0 => self.station.read_status().await.map(|status| status.flags()),
            _ => self.station.read_detailed_status().await.map(|status| status.flags()),
        };
        Ok(flags.map(|flags| self.check_value(self.running(), flags.running().into(), began)))
    }

    async fn loop_back(&mut self) -> CallResult {
        let data = format!("{:016X}", self.rng.next_u64());
        self.station.loop_back(data).await
    }

    async fn write_page(&mut self) -> Result<CallResult> {
        let (write, values) = self.line.expected().begin(&[self.place(Kind::Page)], Instant::now());
        let content = layout::page_of(values[0]);
        let result = self.station.write_program_page(layout::page(self.caller), &content).await;
        Ok(self.end(&write, result))
    }

    async fn read_page(&mut self) -> Result<CallResult> {
        let began = Instant::now();
        let read = self.station.read_program_page(layout::page(self.caller)).await;
        Ok(read.map(|page| match layout::value_of_page(&page) {
            Ok(value) => self.check_value(self.place(Kind::Page), value, began),
            Err(error) => self.line.wrong(self.n, &error.to_string()),
        }))
    }

    /// Broadcasts have no reply, so each station may or may not have received it.
    async fn broadcast(&mut self) -> Result<CallResult> {
        let register = layout::broadcast_register(self.caller)?;
        let value = self.line.expected().begin_broadcast(self.caller, self.line.stations.len(), Instant::now());
        let all = self.station.link().broadcast().with_options(self.station.options());
        Ok(all.write_registers32(register, &[value]).await)
    }

    async fn read_broadcast_cell(&mut self) -> Result<CallResult> {
        let began = Instant::now();
        let read = self.station.read_registers32(layout::broadcast_register(self.caller)?, 1).await;
        Ok(read.map(|values| {
            self.check_value(self.place(Kind::Broadcast), values.first().copied().unwrap_or_default(), began)
        }))
    }

    fn place(&self, kind: Kind) -> Place {
        Place { station: self.n, owner: self.caller, kind }
    }

    fn running(&self) -> Place {
        Place { station: self.n, owner: self.n % self.line.callers, kind: Kind::Running }
    }

    fn random_dwords(&mut self) -> (u16, usize) {
        let first = self.rng.below(usize::from(DWORDS)) as u16;
        let limit = usize::from(DWORDS - first);
        (first, if self.rng.percent(70) { 1 } else { 1 + self.rng.below(limit) })
    }

    fn end(&self, write: &Write, result: CallResult) -> CallResult {
        self.line.expected().end(write, &result, Instant::now());
        result
    }

    fn compare(&self, what: &str, right: bool, first: u16, count: usize, got: &dyn std::fmt::Debug) {
        crate::counters::count(&self.line.counters.values, count);
        if !right {
            self.line.wrong(self.n, &format!("{count} {what} from {first} on have wrong values {got:04X?}"));
        }
    }

    /// Checks a value that was read. A read by the owner resolves earlier writes in doubt.
    fn check_value(&self, place: Place, value: u32, began: Instant) {
        count(&self.line.counters.values, 1);
        let checked = {
            let mut expected = self.line.expected();
            let checked = expected.check(place, value, began);
            if checked.is_ok() && place.owner == self.caller {
                expected.holds(place, value, Instant::now());
            }
            checked
        };
        if let Err(error) = checked {
            self.line.wrong(self.n, &error);
        }
    }
}

fn dword_of(value: Value) -> u32 {
    match value {
        Value::DWord(double) => double,
        Value::Word(word) => word.into(),
        Value::Bit(on) => on.into(),
    }
}
