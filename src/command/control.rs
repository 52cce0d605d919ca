use std::fmt;

use super::{Code, Command, RequestError, Run, sealed, text};
use crate::element::Discrete;
use crate::wire::{FieldError, FieldReader, FieldWriter};

/// 41: starts or stops the PLC.
///
/// ```text
/// request  control: 0 stop, 1 run
/// reply    -
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ControlPlc {
    /// Stops the ladder program.
    Stop,
    /// Starts the ladder program.
    Run,
}

impl sealed::Sealed for ControlPlc {}

impl fmt::Display for ControlPlc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let control = match self {
            Self::Stop => "stop",
            Self::Run => "run",
        };
        text::command(f, Self::CODE, control)
    }
}

impl Command for ControlPlc {
    type Reply = ();
    const CODE: Code = Code::ControlPlc;
    const IMPLIED_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.bit(*self == Self::Run);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        match fields.code()? {
            0 => Ok(Self::Stop),
            1 => Ok(Self::Run),
            other => Err(FieldError::UnknownCode(other).into()),
        }
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

    fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
        Ok(())
    }

    fn fmt_reply((): &(), f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("done")
    }

    fn for_each_run(&self, _each: &mut dyn FnMut(Run)) {}
}

/// The effect of 42 on a discrete.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
#[repr(u8)]
pub enum DiscreteControl {
    /// Forced: the state no longer follows the program or the input.
    Disable = 1,
    /// Not forced: the state follows the program or the input.
    Enable = 2,
    /// On.
    Set = 3,
    /// Off.
    Reset = 4,
}

impl fmt::Display for DiscreteControl {
    /// The name in the manuals: `disable`, `enable`, `set` or `reset`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Disable => "disable",
            Self::Enable => "enable",
            Self::Set => "set",
            Self::Reset => "reset",
        })
    }
}

/// 42: controls one discrete.
///
/// ```text
/// request  code: 1 disable, 2 enable, 3 set, 4 reset · element
/// reply    -
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct ControlDiscrete {
    /// The effect.
    pub control: DiscreteControl,
    /// The discrete.
    pub discrete: Discrete,
}

impl ControlDiscrete {
    /// A request with this effect on a discrete.
    #[must_use]
    pub fn new(control: DiscreteControl, discrete: Discrete) -> Self {
        Self { control, discrete }
    }
}

impl sealed::Sealed for ControlDiscrete {}

impl fmt::Display for ControlDiscrete {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { control, discrete } = self;
        text::command(f, Self::CODE, format_args!("{control} {discrete}"))
    }
}

impl Command for ControlDiscrete {
    type Reply = ();
    const CODE: Code = Code::ControlDiscrete;
    const IMPLIED_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.code(self.control as u8);
        fields.element(self.discrete.into());
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        let control = match fields.code()? {
            1 => DiscreteControl::Disable,
            2 => DiscreteControl::Enable,
            3 => DiscreteControl::Set,
            4 => DiscreteControl::Reset,
            other => return Err(FieldError::UnknownCode(other).into()),
        };
        fields.layout(1, 0)?;
        Ok(Self { control, discrete: fields.element()?.try_into()? })
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

    fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
        Ok(())
    }

    fn fmt_reply((): &(), f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("done")
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        each(Run { first: self.discrete.into(), count: 1 });
    }
}
