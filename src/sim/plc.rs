use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use super::memory::{Memory, covered};
use super::{Error, Execute, Model, PageReply};
use crate::ErrorCode;
use crate::command::{ProgramPage, StatusFlags, Value};
use crate::element::{Discrete, Element};

/// A PLC in memory.
///
/// This is a handle: its clones are the same PLC. Two parties act on it. The *process* is the test: what it
/// [writes](Self::write) stands for the inputs and the ladder program. The *communication* is whatever client is
/// connected, or [`execute`](Self::execute).
///
/// The two differ for disabled discretes, which no longer follow the process: what it writes to them has no effect
/// until they are enabled again, and then the last of it takes effect. The communication reaches them all the same, with
/// 42 as well as with 45, 47 and 49; that is what disabling is for.
///
/// ```
/// use fatek::command::{ControlDiscrete, DiscreteControl, Value};
/// use fatek::{discrete, sim::Plc};
///
/// const LEVEL_HIGH: fatek::Discrete = discrete!("X3");
/// let plc = Plc::new();
/// plc.execute(&ControlDiscrete::new(DiscreteControl::Disable, LEVEL_HIGH)).unwrap();
/// plc.write(LEVEL_HIGH, true).unwrap(); // the tank is full, and the PLC does not notice
/// assert_eq!(plc.read(LEVEL_HIGH), Value::Bit(false));
///
/// plc.execute(&ControlDiscrete::new(DiscreteControl::Enable, LEVEL_HIGH)).unwrap();
/// assert_eq!(plc.read(LEVEL_HIGH), Value::Bit(true));
/// ```
///
/// A new PLC is stopped, with all memory 0, all discretes enabled and no program. It takes a few hundred bytes, and more
/// only as memory is written.
#[derive(Clone, Debug, Default)]
pub struct Plc {
    state: Arc<Mutex<State>>,
}

impl Plc {
    /// A PLC of the default [`Model`].
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// A PLC of this model.
    #[must_use]
    pub fn with_model(model: Model) -> Self {
        Self { state: Arc::new(Mutex::new(State { model, ..State::default() })) }
    }

    /// Does what a request asks, and gives the reply's content or the error that the PLC answers.
    ///
    /// A request that is refused has changed nothing.
    ///
    /// # Errors
    /// - [`ErrorCode::IllegalAddress`] for an element or a program page beyond the model's;
    /// - for 50, [`ErrorCode::WriteProhibited`] while a memory card is in use, else [`ErrorCode::IllegalFormat`] while
    ///   the PLC runs, unless its model [takes pages](Model::pages_while_running) then;
    /// - for 41, what [`refuse_run`](Self::refuse_run) has set.
    pub fn execute<C: Execute>(&self, request: &C) -> Result<C::Reply, ErrorCode> {
        request.execute(&mut self.lock())
    }

    /// What an element holds. Beyond the model's memory, as in what was never written, that is 0.
    #[must_use]
    pub fn read(&self, element: impl Into<Element>) -> Value {
        self.lock().memory.read(element.into())
    }

    /// Sets an element as the process does: disabled discretes keep their state until they are enabled.
    ///
    /// # Errors
    /// [`Error::WrongWidth`] and [`Error::BeyondModel`]; nothing is written then.
    pub fn write(&self, element: impl Into<Element>, value: impl Into<Value>) -> Result<(), Error> {
        self.lock().process_writes(element.into(), value.into())
    }

    /// Whether a discrete is disabled, so that it does not follow the process.
    #[must_use]
    pub fn is_disabled(&self, discrete: Discrete) -> bool {
        self.lock().is_disabled(discrete)
    }

    /// Whether the ladder program runs.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.flags().running()
    }

    /// Starts the PLC at its switch, which is never refused.
    pub fn run(&self) {
        self.lock().set_flag(RUNNING, true);
    }

    /// Stops the PLC at its switch.
    pub fn stop(&self) {
        self.lock().set_flag(RUNNING, false);
    }

    /// From now on answers this error to 41 RUN, and stays as it is; `None` lets it run again. The manuals have 5, 6, 7
    /// and 9 for this.
    pub fn refuse_run(&self, error: Option<ErrorCode>) {
        self.lock().refuse_run = error;
    }

    /// STATUS1, of 40 and 53.
    #[must_use]
    pub fn flags(&self) -> StatusFlags {
        self.lock().flags
    }

    /// Sets B1 of STATUS1. It has no other effect.
    pub fn set_battery_low(&self, on: bool) {
        self.lock().set_flag(1, on);
    }

    /// Sets B2 of STATUS1. It has no other effect; see [`refuse_run`](Self::refuse_run).
    pub fn set_ladder_checksum_error(&self, on: bool) {
        self.lock().set_flag(2, on);
    }

    /// Sets B3 of STATUS1: with a ROM pack or memory card in use, 50 answers error 3.
    pub fn set_memory_card(&self, on: bool) {
        self.lock().set_flag(3, on);
    }

    /// Sets B4 of STATUS1. It has no other effect.
    pub fn set_watchdog_timeout(&self, on: bool) {
        self.lock().set_flag(4, on);
    }

    /// Sets B5 of STATUS1. It has no other effect.
    pub fn set_id_set(&self, on: bool) {
        self.lock().set_flag(5, on);
    }

    /// Sets B6 of STATUS1. It has no other effect.
    pub fn set_emergency_stop(&self, on: bool) {
        self.lock().set_flag(6, on);
    }

    /// How many pages the program has, the header included: 207 for a ladder of 13184 words.
    #[must_use]
    pub fn pages(&self) -> u16 {
        self.lock().model.last_page() + 1
    }

    /// A page of the program; `None` beyond the last. Page 0 is the header, made from the model until it is written;
    /// any other that was never written is all zeros.
    #[must_use]
    pub fn page(&self, page: u16) -> Option<ProgramPage> {
        self.lock().page(page)
    }

    /// Sets a page of the program, even in a running PLC.
    ///
    /// # Errors
    /// [`Error::BeyondProgram`].
    pub fn set_page(&self, page: u16, content: ProgramPage) -> Result<(), Error> {
        self.lock().set_page(page, content)
    }

    pub(super) fn form_of_page_reply(&self) -> PageReply {
        self.lock().model.form_of_page_reply()
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // Nothing panics under the lock; a panic would at worst leave a request half done.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// All that a PLC is. It is public in name only, for [`Execute`]: no path leads here from outside.
#[derive(Debug, Default)]
pub struct State {
    pub(super) model: Model,
    pub(super) memory: Memory,
    /// The disabled discretes, each with what the process has written to it since, if it has.
    disabled: BTreeMap<Discrete, Option<bool>>,
    /// The pages that were written.
    program: BTreeMap<u16, ProgramPage>,
    pub(super) flags: StatusFlags,
    pub(super) refuse_run: Option<ErrorCode>,
}

impl State {
    pub(super) fn set_running(&mut self, on: bool) {
        self.set_flag(RUNNING, on);
    }

    pub(super) fn is_disabled(&self, discrete: Discrete) -> bool {
        self.disabled.contains_key(&discrete)
    }

    pub(super) fn disable(&mut self, discrete: Discrete) {
        self.disabled.entry(discrete).or_default();
    }

    pub(super) fn enable(&mut self, discrete: Discrete) {
        if let Some(Some(on)) = self.disabled.remove(&discrete) {
            self.memory.set_bit(discrete, on);
        }
    }

    pub(super) fn page(&self, page: u16) -> Option<ProgramPage> {
        let blank = || self.model.blank_page(page);
        (page <= self.model.last_page()).then(|| self.program.get(&page).cloned().unwrap_or_else(blank))
    }

    pub(super) fn set_page(&mut self, page: u16, content: ProgramPage) -> Result<(), Error> {
        let last = self.model.last_page();
        if page > last {
            return Err(Error::BeyondProgram { page, last });
        }
        self.program.insert(page, content);
        Ok(())
    }

    fn process_writes(&mut self, element: Element, value: Value) -> Result<(), Error> {
        if !self.model.has(element) {
            return Err(Error::BeyondModel { element });
        }
        // All of it is written, and then the disabled discretes among it are put back.
        let before = self.memory.read(element);
        self.memory.write(element, value)?;
        let (first, last) = covered(element);
        for (&discrete, meant) in &mut self.disabled {
            let same_area = discrete.symbol().area() == element.symbol().area();
            if same_area && (first..=last).contains(&discrete.address()) {
                *meant = Some(self.memory.bit(discrete));
                self.memory.set_bit(discrete, bit(before, discrete.address() - first));
            }
        }
        Ok(())
    }

    fn set_flag(&mut self, bit: u32, on: bool) {
        let StatusFlags(byte) = self.flags;
        self.flags = StatusFlags(byte & !(1 << bit) | u8::from(on) << bit);
    }
}

/// B0 of STATUS1.
const RUNNING: u32 = 0;

/// The `n`-th bit of a value, from the least significant.
fn bit(value: Value, n: u16) -> bool {
    match value {
        Value::Bit(on) => on,
        Value::Word(word) => word >> n & 1 == 1,
        Value::DWord(double) => double >> n & 1 == 1,
    }
}

#[cfg(test)]
mod tests;
