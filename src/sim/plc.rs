mod clock;
mod movements;

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use self::movements::Movements;
use super::memory::Memory;
use super::quirk::Quirks;
use super::span::Span;
use super::{Error, Execute, Model, PageReply};
use crate::ErrorCode;
use crate::clock::Clock;
use crate::command::{ProgramPage, StatusFlags, Value};
use crate::element::{Discrete, Element};

/// A simulated PLC.
///
/// A handle: clones are the same PLC. It is accessed in two ways:
///
/// - by the process, that is the test: [`write`](Self::write) stands for inputs and the ladder
///   program;
/// - by communication, that is the connected clients, and [`execute`](Self::execute).
///
/// The two differ for disabled discretes (42). A write of the process to a disabled discrete takes
/// effect when the discrete is enabled again. Communication writes it at once, with 42, 45, 47 and
/// 49: that is a forced discrete.
///
/// ```
/// use fatek::command::{ControlDiscrete, DiscreteControl, Value};
/// use fatek::{discrete, sim::Plc};
///
/// const LEVEL_HIGH: fatek::Discrete = discrete!("X3");
/// let plc = Plc::new();
/// plc.execute(&ControlDiscrete::new(DiscreteControl::Disable, LEVEL_HIGH)).unwrap();
/// plc.write(LEVEL_HIGH, true).unwrap(); // no effect while disabled
/// assert_eq!(plc.read(LEVEL_HIGH), Value::Bit(false));
///
/// plc.execute(&ControlDiscrete::new(DiscreteControl::Enable, LEVEL_HIGH)).unwrap();
/// assert_eq!(plc.read(LEVEL_HIGH), Value::Bit(true));
/// ```
///
/// A new PLC is in STOP, with all memory 0, all discretes enabled and no program. It takes a few
/// hundred bytes, and more as memory is written.
#[derive(Clone, Debug, Default)]
pub struct Plc {
    inner: Arc<Mutex<PlcInner>>,
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
        Self { inner: Arc::new(Mutex::new(PlcInner { model, ..PlcInner::default() })) }
    }

    /// Executes a request, and returns the content of the reply.
    ///
    /// # Errors
    /// The error code of the PLC; the request has changed nothing then:
    ///
    /// - [`ErrorCode::IllegalAddress`] for elements and program pages beyond the model, for several
    ///   counters of 32 bits as a run, and for one of them as 16 bits;
    /// - for 50, [`ErrorCode::WriteProhibited`] with a memory card, else
    ///   [`ErrorCode::IllegalFormat`] in RUN, unless the model
    ///   [accepts pages](Model::pages_while_running) then;
    /// - for 41, the error set with [`refuse_run`](Self::refuse_run).
    pub fn execute<C: Execute>(&self, request: &C) -> Result<C::Reply, ErrorCode> {
        let mut inner = self.lock();
        inner.move_accessed(request);
        let reply = request.execute(&mut inner);
        inner.settle_clock();
        reply
    }

    /// The value of an element: 0 if it was never written, or is beyond the model.
    #[must_use]
    pub fn read(&self, element: impl Into<Element>) -> Value {
        let (element, mut inner) = (element.into(), self.lock());
        inner.move_element(element);
        inner.memory.read(element)
    }

    /// Writes an element as the process. Disabled discretes keep their state until enabled. Ends the
    /// [movement](Self::set_movement) of the element.
    ///
    /// # Errors
    /// [`Error::Element`] for a value of another width than the element, and
    /// [`Error::BeyondModel`]. Nothing is written then.
    pub fn write(&self, element: impl Into<Element>, value: impl Into<Value>) -> Result<(), Error> {
        let (element, mut inner) = (element.into(), self.lock());
        inner.write_as_process(element, value.into())?;
        inner.movements.end(Span::new(element, 1));
        Ok(())
    }

    /// Returns whether a discrete is disabled (42), so that writes of the process have no effect.
    #[must_use]
    pub fn is_disabled(&self, discrete: Discrete) -> bool {
        self.lock().is_disabled(discrete)
    }

    /// Returns whether the PLC is in RUN.
    #[must_use]
    pub fn is_running(&self) -> bool {
        self.flags().running()
    }

    /// Sets RUN at the PLC's switch, which [`refuse_run`](Self::refuse_run) does not prevent.
    pub fn run(&self) {
        self.lock().set_flag(RUNNING, true);
    }

    /// Sets STOP at the PLC's switch.
    pub fn stop(&self) {
        self.lock().set_flag(RUNNING, false);
    }

    /// Sets the error with which the PLC refuses RUN (41); `None` accepts it.
    ///
    /// The manuals have the errors 5, 6, 7 and 9 for this.
    pub fn refuse_run(&self, error: Option<ErrorCode>) {
        self.lock().refuse_run = error;
    }

    /// STATUS1 of 40 and 53.
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

    /// Sets B3 of STATUS1: a ROM pack or memory card is in use, and 50 gives error 3.
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

    /// Number of pages of the program memory, header included: 207 for a ladder of 13184 words.
    #[must_use]
    pub fn pages(&self) -> u16 {
        self.lock().model.last_page() + 1
    }

    /// A page of the program; `None` beyond the last.
    ///
    /// Page 0 is the header, which follows from the model until it is written. Other pages are
    /// zeros until they are written.
    #[must_use]
    pub fn page(&self, page: u16) -> Option<ProgramPage> {
        self.lock().page(page)
    }

    /// Sets a page of the program, in RUN, too.
    ///
    /// # Errors
    /// [`Error::BeyondProgram`].
    pub fn set_page(&self, page: u16, content: ProgramPage) -> Result<(), Error> {
        self.lock().set_page(page, content)
    }

    /// Returns whether the model has the element.
    pub(super) fn has(&self, element: Element) -> bool {
        self.lock().model.has(element)
    }

    pub(super) fn form_of_page_reply(&self) -> PageReply {
        self.lock().model.form_of_page_reply()
    }

    pub(super) fn quirks(&self) -> Quirks {
        self.lock().quirks.clone()
    }

    pub(super) fn change_quirks(&self, change: impl FnOnce(&mut Quirks)) {
        change(&mut self.lock().quirks);
    }

    fn lock(&self) -> MutexGuard<'_, PlcInner> {
        // Nothing panics under the lock.
        self.inner.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// State of a simulated PLC. Only nominally public, for [`Execute`]: its module is private.
#[derive(Debug, Default)]
pub struct PlcInner {
    pub(super) model: Model,
    pub(super) memory: Memory,
    /// Disabled discretes, each with the last write of the process since, if any.
    disabled: BTreeMap<Discrete, Option<bool>>,
    /// Pages that were written.
    program: BTreeMap<u16, ProgramPage>,
    pub(super) flags: StatusFlags,
    pub(super) refuse_run: Option<ErrorCode>,
    quirks: Quirks,
    clock: Option<Clock>,
    /// M1952 after the last request or write.
    clock_settable: bool,
    movements: Movements,
}

impl PlcInner {
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

    fn write_as_process(&mut self, element: Element, value: Value) -> Result<(), Error> {
        if !self.model.has(element) {
            return Err(Error::BeyondModel { element });
        }
        // Writes all bits, then restores those of disabled discretes.
        let before = self.memory.read(element);
        self.memory.write(element, value)?;
        let (first, last) = element.covered();
        for (&discrete, written) in &mut self.disabled {
            let same_area = discrete.symbol().area() == element.symbol().area();
            if same_area && (first..=last).contains(&discrete.address()) {
                *written = Some(self.memory.bit(discrete));
                self.memory.set_bit(discrete, bit(before, discrete.address() - first));
            }
        }
        self.settle_clock();
        Ok(())
    }

    fn set_flag(&mut self, bit: u32, on: bool) {
        let StatusFlags(byte) = self.flags;
        self.flags = StatusFlags(byte & !(1 << bit) | u8::from(on) << bit);
    }
}

/// B0 of STATUS1.
const RUNNING: u32 = 0;

/// Bit `n` of a value, from the least significant.
fn bit(value: Value, n: u16) -> bool {
    match value {
        Value::Bit(on) => on,
        Value::Word(word) => word >> n & 1 == 1,
        Value::DWord(double) => double >> n & 1 == 1,
    }
}

#[cfg(test)]
mod tests;
