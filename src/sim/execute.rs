//! Execution of commands by a simulated PLC: one `impl` per command, in the order of the codes.

use super::fault::Change;
use super::plc::PlcInner;
use crate::ErrorCode;
use crate::command::{
    BriefStatus, Command, ControlDiscrete, ControlPlc, DetailedStatus, DiscreteControl, LoopBack, ProgramPage,
    ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed, ReadProgramPage, ReadRegisters, ReadStatus, Value,
    WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use crate::element::{Element, Register, Register32};

/// A command that a simulated PLC executes: every [`Command`] of this crate.
///
/// Sealed: it cannot be implemented outside of this crate.
pub trait Execute: Command {
    #[doc(hidden)]
    fn execute(&self, plc: &mut PlcInner) -> Result<Self::Reply, ErrorCode>;

    /// The changes of a PLC that has executed this.
    #[doc(hidden)]
    fn changes(&self) -> Vec<Change>;
}

impl Execute for ReadStatus {
    fn execute(&self, plc: &mut PlcInner) -> Result<BriefStatus, ErrorCode> {
        Ok(plc.model.brief_status(plc.flags))
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl Execute for ControlPlc {
    fn execute(&self, plc: &mut PlcInner) -> Result<(), ErrorCode> {
        match (self, plc.refuse_run) {
            (Self::Run, Some(error)) => return Err(error),
            (Self::Run, None) => plc.set_running(true),
            (Self::Stop, _) => plc.set_running(false),
        }
        Ok(())
    }

    fn changes(&self) -> Vec<Change> {
        match self {
            Self::Stop => vec![Change::Stop],
            Self::Run => vec![Change::Run],
        }
    }
}

impl Execute for ControlDiscrete {
    fn execute(&self, plc: &mut PlcInner) -> Result<(), ErrorCode> {
        plc.check_elements([self.discrete.into()])?;
        match self.control {
            DiscreteControl::Disable => plc.disable(self.discrete),
            DiscreteControl::Enable => plc.enable(self.discrete),
            DiscreteControl::Set => plc.memory.set_bit(self.discrete, true),
            DiscreteControl::Reset => plc.memory.set_bit(self.discrete, false),
        }
        Ok(())
    }

    fn changes(&self) -> Vec<Change> {
        vec![match self.control {
            DiscreteControl::Disable => Change::Disabled(self.discrete),
            DiscreteControl::Enable => Change::Enabled(self.discrete),
            DiscreteControl::Set => Change::value(self.discrete, true),
            DiscreteControl::Reset => Change::value(self.discrete, false),
        }]
    }
}

impl Execute for ReadDisabled {
    fn execute(&self, plc: &mut PlcInner) -> Result<Vec<bool>, ErrorCode> {
        let discretes = plc.consecutive(self.first(), self.count())?;
        Ok(discretes.into_iter().map(|discrete| plc.is_disabled(discrete)).collect())
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl Execute for ReadDiscretes {
    fn execute(&self, plc: &mut PlcInner) -> Result<Vec<bool>, ErrorCode> {
        let discretes = plc.consecutive(self.first(), self.count())?;
        Ok(discretes.into_iter().map(|discrete| plc.memory.bit(discrete)).collect())
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl Execute for WriteDiscretes {
    fn execute(&self, plc: &mut PlcInner) -> Result<(), ErrorCode> {
        let discretes = plc.consecutive(self.first(), self.states().len())?;
        discretes.into_iter().zip(self.states()).for_each(|(discrete, &on)| plc.memory.set_bit(discrete, on));
        Ok(())
    }

    fn changes(&self) -> Vec<Change> {
        Change::values(self.first(), self.states())
    }
}

registers!(Register, word, set_word);
registers!(Register32, dword, set_dword);

impl Execute for ReadMixed {
    fn execute(&self, plc: &mut PlcInner) -> Result<Vec<Value>, ErrorCode> {
        plc.check_elements(self.elements().iter().copied())?;
        Ok(self.elements().iter().map(|&element| plc.memory.read(element)).collect())
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl Execute for WriteMixed {
    fn execute(&self, plc: &mut PlcInner) -> Result<(), ErrorCode> {
        plc.check_elements(self.items().iter().map(|&(element, _)| element))?;
        let mut items = self.items().iter();
        // Unreachable error: the request has checked the widths.
        items.try_for_each(|&(element, value)| plc.memory.write(element, value)).map_err(|_| ErrorCode::IllegalFormat)
    }

    fn changes(&self) -> Vec<Change> {
        self.items().iter().map(|&(element, value)| Change::Value(element, value)).collect()
    }
}

impl Execute for LoopBack {
    fn execute(&self, _plc: &mut PlcInner) -> Result<(), ErrorCode> {
        Ok(())
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl Execute for ReadProgramPage {
    fn execute(&self, plc: &mut PlcInner) -> Result<ProgramPage, ErrorCode> {
        plc.page(self.page).ok_or(ErrorCode::IllegalAddress)
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl Execute for WriteProgramPage {
    fn execute(&self, plc: &mut PlcInner) -> Result<(), ErrorCode> {
        if plc.flags.memory_card() {
            return Err(ErrorCode::WriteProhibited);
        }
        if plc.flags.running() && !plc.model.accepts_pages_while_running() {
            return Err(ErrorCode::IllegalFormat);
        }
        plc.set_page(self.page, self.content.clone()).map_err(|_| ErrorCode::IllegalAddress)
    }

    fn changes(&self) -> Vec<Change> {
        vec![Change::Page(self.page, self.content.clone())]
    }
}

impl Execute for ReadDetailedStatus {
    fn execute(&self, plc: &mut PlcInner) -> Result<DetailedStatus, ErrorCode> {
        Ok(plc.model.detailed_status(plc.flags))
    }

    fn changes(&self) -> Vec<Change> {
        Vec::new()
    }
}

impl PlcInner {
    /// Checks that the model has all of these elements.
    ///
    /// Called before the first write, since a PLC never executes a command in part.
    fn check_elements(&self, elements: impl IntoIterator<Item = Element>) -> Result<(), ErrorCode> {
        let within = elements.into_iter().all(|element| self.model.has(element));
        within.then_some(()).ok_or(ErrorCode::IllegalAddress)
    }

    /// `count` elements from `first` on.
    ///
    /// Error A unless the model has all of them. Several counters of 32 bits are refused, too: the
    /// manuals do not say whether a run of them counts addresses by one or by two.
    fn consecutive<E>(&self, first: E, count: usize) -> Result<Vec<E>, ErrorCode>
    where
        E: Copy + Into<Element> + TryFrom<Element>,
    {
        let is_run_of_counters = count > 1 && first.into().is_counter_of_32_bits();
        let nth = |n| {
            let element = first.into().nth(n).ok().filter(|&element| self.model.has(element))?;
            E::try_from(element).ok()
        };
        let elements = (0..count).map(nth).collect::<Option<_>>();
        elements.filter(|_| !is_run_of_counters).ok_or(ErrorCode::IllegalAddress)
    }
}

/// Commands 46 and 47 for registers of one width.
macro_rules! registers {
    ($element:ty, $read:ident, $write:ident) => {
        impl Execute for ReadRegisters<$element> {
            fn execute(&self, plc: &mut PlcInner) -> Result<Self::Reply, ErrorCode> {
                let registers = plc.consecutive(self.first(), self.count())?;
                Ok(registers.into_iter().map(|register| plc.memory.$read(register)).collect())
            }

            fn changes(&self) -> Vec<Change> {
                Vec::new()
            }
        }

        impl Execute for WriteRegisters<$element> {
            fn execute(&self, plc: &mut PlcInner) -> Result<(), ErrorCode> {
                let registers = plc.consecutive(self.first(), self.values().len())?;
                registers.into_iter().zip(self.values()).for_each(|(register, &value)| {
                    plc.memory.$write(register, value);
                });
                Ok(())
            }

            fn changes(&self) -> Vec<Change> {
                Change::values(self.first(), self.values())
            }
        }
    };
}
use registers;
