use super::{Candidates, Code, Command, InvalidRequest, RequestError, Run, Spelling, blank, limits, sealed, spelling};
use crate::element::Discrete;
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

read_states! {
    /// 43: reads which of consecutive discretes are disabled.
    ///
    /// ```text
    /// request  N (256 as 00) · first discrete
    /// reply    N states: 1 disabled, 0 enabled
    /// ```
    ReadDisabled
}

read_states! {
    /// 44: reads the states of consecutive discretes.
    ///
    /// ```text
    /// request  N (256 as 00) · first discrete
    /// reply    N states: 1 on, 0 off
    /// ```
    ReadDiscretes
}

/// 45: writes the states of consecutive discretes.
///
/// ```text
/// request  N (256 as 00) · first discrete · N states: 1 on, 0 off
/// reply    -
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct WriteDiscretes {
    first: Discrete,
    states: Vec<bool>,
}

impl WriteDiscretes {
    /// A write of these states to `first` and the discretes after it.
    ///
    /// # Errors
    /// [`InvalidRequest::Count`] unless there are 1 to 256; [`InvalidRequest::PastTheEnd`].
    pub fn new(first: Discrete, states: impl Into<Vec<bool>>) -> Result<Self, InvalidRequest> {
        let states = states.into();
        limits::consecutive(Self::CODE, first.into(), states.len())?;
        Ok(Self { first, states })
    }

    /// The first discrete.
    #[must_use]
    pub fn first(&self) -> Discrete {
        self.first
    }

    /// The states: `true` is on.
    #[must_use]
    pub fn states(&self) -> &[bool] {
        &self.states
    }

    fn elements(&self) -> Run {
        Run { first: self.first.into(), count: self.states.len() }
    }
}

impl sealed::Sealed for WriteDiscretes {}

impl Command for WriteDiscretes {
    type Reply = ();
    const CODE: Code = Code::WriteDiscretes;
    const BROADCAST_REPLY: Option<()> = Some(());

    fn write_request<W: FieldWriter>(&self, fields: &mut W) {
        fields.count(self.states.len());
        fields.element(self.first.into());
        fields.bits(&self.states);
    }

    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
        let count = fields.count()?;
        fields.layout(1, count)?;
        let first = fields.element()?.try_into()?;
        let mut states = blank(count);
        fields.bits(&mut states)?;
        Ok(Self::new(first, states)?)
    }

    fn write_reply<W: FieldWriter>(&self, (): &(), _fields: &mut W) {}

    fn read_reply<R: FieldReader>(&self, _fields: &mut R) -> Result<(), FieldError> {
        Ok(())
    }

    fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
        each(self.elements());
    }

    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, self.states.len())
    }

    fn candidates(&self, longer: bool, framing: Framing) -> Candidates {
        self.elements().write_candidates(longer, framing, &self.states)
    }

    fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
        spelling::write_fields(self, self.first.into(), &self.states, spelling, fields);
    }

    fn run(&self) -> Option<Run> {
        Some(self.elements())
    }
}

/// 43 and 44, which differ in code and meaning of the states.
macro_rules! read_states {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        pub struct $name {
            first: Discrete,
            count: usize,
        }

        impl $name {
            /// A read of `count` discretes from `first` on.
            ///
            /// # Errors
            /// [`InvalidRequest::Count`] unless `count` is 1 to 256;
            /// [`InvalidRequest::PastTheEnd`].
            pub fn new(first: Discrete, count: usize) -> Result<Self, InvalidRequest> {
                limits::consecutive(Self::CODE, first.into(), count)?;
                Ok(Self { first, count })
            }

            /// The first discrete.
            #[must_use]
            pub fn first(&self) -> Discrete {
                self.first
            }

            /// The number of discretes.
            #[must_use]
            pub fn count(&self) -> usize {
                self.count
            }

            fn elements(&self) -> Run {
                Run { first: self.first.into(), count: self.count }
            }
        }

        impl sealed::Sealed for $name {}

        impl Command for $name {
            type Reply = Vec<bool>;
            const CODE: Code = Code::$name;

            fn write_request<W: FieldWriter>(&self, fields: &mut W) {
                fields.count(self.count);
                fields.element(self.first.into());
            }

            fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError> {
                let count = fields.count()?;
                fields.layout(1, 0)?;
                let first = fields.element()?.try_into()?;
                Ok(Self::new(first, count)?)
            }

            fn write_reply<W: FieldWriter>(&self, reply: &Vec<bool>, fields: &mut W) {
                fields.bits(reply);
            }

            fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Vec<bool>, FieldError> {
                let mut states = blank(self.count);
                fields.bits(&mut states)?;
                Ok(states)
            }

            fn for_each_run(&self, each: &mut dyn FnMut(Run)) {
                each(self.elements());
            }

            fn plain(&self) -> Spelling {
                Spelling::new(Self::CODE, self.count)
            }

            fn candidates(&self, longer: bool, framing: Framing) -> Candidates {
                self.elements().read_candidates(Self::CODE, longer, framing)
            }

            fn write_spelled<W: FieldWriter>(&self, spelling: Spelling, fields: &mut W) {
                spelling::read_fields(self.first.into(), spelling, fields);
            }

            fn read_spelled<R: FieldReader>(
                &self,
                spelling: Spelling,
                fields: &mut R,
            ) -> Result<Self::Reply, FieldError> {
                let mut states = Self { count: spelling.count.into(), ..*self }.read_reply(fields)?;
                spelling::keep_asked(&mut states, spelling, self.count);
                Ok(states)
            }

            fn reply_size(&self, spelling: Spelling, framing: Framing) -> u32 {
                spelling::values_len(self.elements().first.width(), spelling.count.into(), framing)
            }

            fn run(&self) -> Option<Run> {
                Some(self.elements())
            }
        }
    };
}
use read_states;
