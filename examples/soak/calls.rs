//! What callers ask, and how they compare what they get.

use fatek::command::{ControlDiscrete, ControlPlc, DiscreteControl, Request, WriteRegisters};
use fatek::wire::Framing;
use fatek::{Element, Error, Register, Register32, Station, Symbol, Value};
use tokio::time::Instant;

use crate::Result;
use crate::dice::Dice;
use crate::layout::{self, CONSTANTS, DOUBLES, Kind, Place};
use crate::line::Line;
use crate::shadow::Write;
use crate::tally::count;

/// One call of one caller.
pub(crate) struct Call<'a> {
    pub(crate) line: &'a Line,
    /// Which station, counted from 0.
    pub(crate) n: usize,
    pub(crate) station: Station,
    /// Who calls.
    pub(crate) caller: usize,
    pub(crate) dice: Dice,
}

/// How a call ended that was not given up: `Err` is what the link said.
type Ended = std::result::Result<(), Error>;

impl Call<'_> {
    /// Asks something at random. Fails when the call cannot be made at all.
    pub(crate) async fn make(mut self) -> Result<Ended> {
        // Mostly of the same few shapes, so that a reply could be taken for another.
        Ok(match self.dice.below(100) {
            0..20 => self.read_constants().await?,
            20..26 => self.read_constants32().await?,
            26..32 => self.read_relays().await?,
            32..37 => self.read_mixed_constants().await?,
            37..48 => self.read_doubles(self.caller).await?,
            48..51 => {
                let other = self.dice.below(self.line.callers);
                self.read_doubles(other).await?
            }
            51..66 => self.write_doubles().await?,
            66..70 => self.write_bits().await?,
            70..74 => self.read_bits().await?,
            74..80 => self.control(Kind::Switch).await?,
            80..84 => self.control(Kind::Force).await?,
            84..87 if self.running().owner == self.caller => self.control(Kind::Running).await?,
            84..88 => self.read_status().await?,
            88..90 => self.loop_back().await,
            90..93 if self.line.framing == Framing::Ascii => self.write_page().await?,
            90..96 if self.line.framing == Framing::Ascii => self.read_page().await?,
            90..97 => self.read_cast().await?,
            // Not over a second connection: with no answer, nothing tells which of the two was quicker.
            97..98 if self.caller < self.line.callers => self.broadcast().await?,
            _ => self.read_forced().await?,
        })
    }

    async fn read_constants(&mut self) -> Result<Ended> {
        // More than 64 are more than one request.
        let count = if self.dice.percent(80) { 1 } else { 1 + self.dice.below(100) };
        let first = self.dice.below(usize::from(CONSTANTS) - count) as u16;
        let read = self.station.read_registers(Register::r(first), count).await;
        Ok(read.map(|words| {
            let right = (0..count as u16).map(|i| layout::constant(self.line.number, self.n, first + i));
            self.compare("R", words.iter().copied().eq(right), first, count, &words);
        }))
    }

    async fn read_constants32(&mut self) -> Result<Ended> {
        let count = if self.dice.percent(80) { 1 } else { 1 + self.dice.below(16) };
        let first = self.dice.below(usize::from(CONSTANTS) - 2 * count) as u16;
        let read = self.station.read_registers32(Register32::new(Symbol::DR, first)?, count).await;
        Ok(read.map(|doubles| {
            let word = |address| u32::from(layout::constant(self.line.number, self.n, address));
            let right = (0..count as u16).map(|i| first + 2 * i).map(|a| word(a + 1) << 16 | word(a));
            self.compare("DR", doubles.iter().copied().eq(right), first, count, &doubles);
        }))
    }

    async fn read_relays(&mut self) -> Result<Ended> {
        let count = 1 + self.dice.below(64);
        let first = self.dice.below(usize::from(CONSTANTS) - count) as u16;
        let read = self.station.read_discretes(layout::relay(first)?, count).await;
        Ok(read.map(|states| {
            let right = (0..count as u16).map(|i| layout::constant_bit(self.line.number, self.n, first + i));
            self.compare("M", states.iter().copied().eq(right), first, count, &states);
        }))
    }

    async fn read_mixed_constants(&mut self) -> Result<Ended> {
        let address = self.dice.below(usize::from(CONSTANTS)) as u16;
        let elements = [Element::from(Register::r(address)), layout::relay(address)?.into()];
        let read = self.station.read_mixed(&elements).await;
        Ok(read.map(|values| {
            let word = layout::constant(self.line.number, self.n, address);
            let on = layout::constant_bit(self.line.number, self.n, address);
            self.compare("R and M", values == [Value::Word(word), Value::Bit(on)], address, 2, &values);
        }))
    }

    /// The cells of somebody, by one of the commands that reach them.
    async fn read_doubles(&mut self, owner: usize) -> Result<Ended> {
        let (first, count) = self.run_of_doubles();
        let register = layout::double(owner, first)?;
        let began = Instant::now();
        let read = match self.dice.below(3) {
            0 => self.station.read_registers32(register, count).await,
            1 => self.station.read_registers(register.low(), 2 * count).await.map(|words| layout::join(&words)),
            _ => {
                let read = self.station.read_mixed(&[register.into()]).await;
                read.map(|values| values.into_iter().map(double_of).collect())
            }
        };
        Ok(read.map(|values| {
            for (n, &value) in (first..).zip(&values) {
                self.look(Place { station: self.n, owner, kind: Kind::Double(n) }, value, began);
            }
        }))
    }

    async fn write_doubles(&mut self) -> Result<Ended> {
        let (first, count) = self.run_of_doubles();
        let register = layout::double(self.caller, first)?;
        let places: Vec<_> = (first..).take(count).map(|n| self.place(Kind::Double(n))).collect();
        let (write, values) = self.line.shadow().begin(&places, Instant::now());
        let result = match self.dice.below(10) {
            0..4 => self.station.write_registers32(register, &values).await,
            4..7 => self.station.write_registers(register.low(), &layout::split(&values)).await,
            7..9 => {
                let registers: Vec<Register32> =
                    (first..).take(count).map(|n| layout::double(self.caller, n)).collect::<Result<_>>()?;
                let items: Vec<_> =
                    registers.into_iter().map(Element::from).zip(values.iter().map(|&v| v.into())).collect();
                self.station.write_mixed(&items).await
            }
            _ => {
                // By choice, a write is repeated.
                let request = Request::WriteRegisters32(WriteRegisters::new(register, values.clone())?);
                self.line.shadow().may_be_repeated(self.n, request);
                let station = self.station.with_options(self.station.options().retry_writes(true));
                station.write_registers32(register, &values).await
            }
        };
        Ok(self.end(&write, result))
    }

    async fn write_bits(&mut self) -> Result<Ended> {
        let (write, values) = self.line.shadow().begin(&[self.place(Kind::Bits)], Instant::now());
        let first = layout::bits(self.caller)?;
        let result = match self.dice.below(2) {
            0 => self.station.write_discretes(first, &layout::split_bits(values[0])).await,
            _ => self.station.write_registers32(Register32::new(Symbol::DWM, first.address())?, &values).await,
        };
        Ok(self.end(&write, result))
    }

    async fn read_bits(&mut self) -> Result<Ended> {
        let first = layout::bits(self.caller)?;
        let began = Instant::now();
        let read = match self.dice.below(2) {
            0 => self.station.read_discretes(first, 32).await.map(|states| layout::join_bits(&states)),
            _ => {
                let register = Register32::new(Symbol::DWM, first.address())?;
                self.station
                    .read_registers32(register, 1)
                    .await
                    .map(|values| values.first().copied().unwrap_or_default())
            }
        };
        Ok(read.map(|value| self.look(self.place(Kind::Bits), value, began)))
    }

    /// Sets or resets, disables or enables, runs or stops.
    async fn control(&mut self, kind: Kind) -> Result<Ended> {
        let on = self.dice.percent(50);
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
        let write = self.line.shadow().begin_control(place, on, request, Instant::now());
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

    async fn read_forced(&mut self) -> Result<Ended> {
        let began = Instant::now();
        if self.dice.percent(50) {
            let read = self.station.read_disabled(layout::force(self.caller)?, 1).await;
            return Ok(read.map(|states| self.look(self.place(Kind::Force), layout::join_bits(&states), began)));
        }
        let read = self.station.read_discretes(layout::switch(self.caller)?, 1).await;
        Ok(read.map(|states| self.look(self.place(Kind::Switch), layout::join_bits(&states), began)))
    }

    async fn read_status(&mut self) -> Result<Ended> {
        let began = Instant::now();
        let flags = match self.dice.below(2) {
            0 => self.station.read_status().await.map(|status| status.flags()),
            _ => self.station.read_detailed_status().await.map(|status| status.flags()),
        };
        Ok(flags.map(|flags| self.look(self.running(), flags.running().into(), began)))
    }

    async fn loop_back(&mut self) -> Ended {
        let data = format!("{:016X}", self.dice.roll());
        self.station.loop_back(data).await
    }

    async fn write_page(&mut self) -> Result<Ended> {
        let (write, values) = self.line.shadow().begin(&[self.place(Kind::Page)], Instant::now());
        let content = layout::page_of(values[0]);
        let result = self.station.write_program_page(layout::page(self.caller), &content).await;
        Ok(self.end(&write, result))
    }

    async fn read_page(&mut self) -> Result<Ended> {
        let began = Instant::now();
        let read = self.station.read_program_page(layout::page(self.caller)).await;
        Ok(read.map(|page| match layout::value_of_page(&page) {
            Ok(value) => self.look(self.place(Kind::Page), value, began),
            Err(error) => self.line.wrong(self.n, &error.to_string()),
        }))
    }

    /// Nobody answers, so it may have been heard by any of them.
    async fn broadcast(&mut self) -> Result<Ended> {
        let register = layout::cast(self.caller)?;
        let value = self.line.shadow().begin_broadcast(self.caller, self.line.stations.len(), Instant::now());
        let all = self.station.link().broadcast().with_options(self.station.options());
        Ok(all.write_registers32(register, &[value]).await)
    }

    async fn read_cast(&mut self) -> Result<Ended> {
        let began = Instant::now();
        let read = self.station.read_registers32(layout::cast(self.caller)?, 1).await;
        Ok(read.map(|values| self.look(self.place(Kind::Cast), values.first().copied().unwrap_or_default(), began)))
    }

    fn place(&self, kind: Kind) -> Place {
        Place { station: self.n, owner: self.caller, kind }
    }

    fn running(&self) -> Place {
        Place { station: self.n, owner: self.n % self.line.callers, kind: Kind::Running }
    }

    fn run_of_doubles(&mut self) -> (u16, usize) {
        let first = self.dice.below(usize::from(DOUBLES)) as u16;
        let most = usize::from(DOUBLES - first);
        (first, if self.dice.percent(70) { 1 } else { 1 + self.dice.below(most) })
    }

    fn end(&self, write: &Write, result: Ended) -> Ended {
        self.line.shadow().end(write, &result, Instant::now());
        result
    }

    fn compare(&self, what: &str, right: bool, first: u16, count: usize, got: &dyn std::fmt::Debug) {
        crate::tally::count(&self.line.tally.values, count);
        if !right {
            self.line.wrong(self.n, &format!("{count} {what} from {first} on cannot be {got:04X?}"));
        }
    }

    /// A value that was read. If it is the caller's own, what was written before is known from now on.
    fn look(&self, place: Place, value: u32, began: Instant) {
        count(&self.line.tally.values, 1);
        let checked = {
            let mut shadow = self.line.shadow();
            let checked = shadow.check(place, value, began);
            if checked.is_ok() && place.owner == self.caller {
                shadow.holds(place, value, Instant::now());
            }
            checked
        };
        if let Err(wrong) = checked {
            self.line.wrong(self.n, &wrong);
        }
    }
}

fn double_of(value: Value) -> u32 {
    match value {
        Value::DWord(double) => double,
        Value::Word(word) => word.into(),
        Value::Bit(on) => on.into(),
    }
}
