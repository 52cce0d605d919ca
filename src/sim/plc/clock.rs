//! The clock of a simulated PLC. It stands still: only a client or the test sets it.

use super::{Plc, PlcInner};
use crate::clock::{CLOCK_LEN, CLOCK_PRESENT, CLOCK_REGISTERS, CLOCK_SETTABLE, CLOCK_WRONG, Clock};
use crate::element::Register;

impl Plc {
    /// Sets the clock; `None` removes it. Default: `None`, and R4128 to R4134 are plain registers.
    ///
    /// With a clock M1954 is 1, and R4128 to R4134 hold its time. Values written there remain only
    /// while M1952 is 1. When M1952 becomes 0, they are the new time, or, if they are no time, M1955
    /// becomes 1 and the clock is as before. The clock does not run.
    pub fn set_clock(&self, clock: Option<Clock>) {
        let mut inner = self.lock();
        inner.clock = clock;
        inner.memory.set_bit(CLOCK_PRESENT, clock.is_some());
        inner.memory.set_bit(CLOCK_SETTABLE, false);
        inner.clock_settable = false;
        inner.show_clock();
    }

    /// The time of the clock; `None` without a clock.
    #[must_use]
    pub fn clock(&self) -> Option<Clock> {
        self.lock().clock
    }
}

impl PlcInner {
    /// Applies the rules of the clock after a request or a write of the process.
    pub(super) fn settle_clock(&mut self) {
        if self.clock.is_none() {
            return;
        }
        self.memory.set_bit(CLOCK_PRESENT, true);
        let settable = self.memory.bit(CLOCK_SETTABLE);
        match (self.clock_settable, settable) {
            (_, true) => {}
            (false, false) => self.show_clock(),
            (true, false) => {
                let mut registers = [0; CLOCK_LEN];
                for (value, register) in registers.iter_mut().zip(clock_registers()) {
                    *value = self.memory.word(register);
                }
                let set = Clock::from_registers(registers);
                self.memory.set_bit(CLOCK_WRONG, set.is_err());
                self.clock = set.ok().or(self.clock);
                self.show_clock();
            }
        }
        self.clock_settable = settable;
    }

    fn show_clock(&mut self) {
        let Some(clock) = self.clock else { return };
        for (register, value) in clock_registers().zip(clock.to_registers()) {
            self.memory.set_word(register, value);
        }
    }
}

fn clock_registers() -> impl Iterator<Item = Register> {
    (0..CLOCK_LEN).filter_map(|n| CLOCK_REGISTERS.nth(n).ok())
}
