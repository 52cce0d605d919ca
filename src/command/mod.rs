//! The commands: what can be asked of a PLC.
//!
//! Each command is one type. It knows its code and limits, is checked when it is made, and writes and reads both its
//! request and its reply through [`FieldWriter`] and [`FieldReader`], so that it does not know the framing. Client and
//! simulator share these types, and nothing else.
//!
//! Most programs never name them: [`Station`](crate::Station) has a method for each.
//!
//! Source: protocol reference, section 5 (manuals 000 and 002 section 4.2, 001 section 2.5).

mod answer;
mod code;
mod control;
mod discrete;
mod envelope;
mod in_place;
mod limits;
mod loopback;
mod mixed;
mod program;
mod register;
mod request;
mod spelling;
mod status;

use std::fmt;

pub use answer::Answer;
pub use code::{Class, Code, ErrorField};
pub use control::{ControlDiscrete, ControlPlc, DiscreteControl};
pub use discrete::{ReadDisabled, ReadDiscretes, WriteDiscretes};
pub use envelope::{ReplyError, decode_reply, encode_refusal, encode_reply, encode_request};
pub(crate) use envelope::{decode_spelled, encode_spelled};
pub(crate) use in_place::{Consecutive, InPlace};
pub use limits::{InvalidRequest, MAX_LOOP_BACK, MAX_MIXED_READ_UNITS, MAX_MIXED_WRITE_UNITS, MAX_POINTS, MAX_UNITS};
pub(crate) use limits::{check_range, most_in_one_request};
pub use loopback::LoopBack;
pub use mixed::{ReadMixed, Value, WriteMixed};
pub use program::{PAGE_WORDS, ProgramPage, ReadProgramPage, WriteProgramPage};
pub use register::{ReadRegisters, RegisterElement, WriteRegisters};
pub use request::Request;
pub(crate) use request::with_command;
pub(crate) use spelling::{Candidate, Candidates, NONE as NO_CANDIDATES, Run, Spelling};
pub use status::{
    BriefStatus, DetailedStatus, MainUnit, ProgramCapacity, ReadDetailedStatus, ReadStatus, Series, StatusFlags,
};

use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

/// A command: one request, and the reply that belongs to it.
///
/// A value of such a type has passed the command's limits. The four methods are the two directions of request and
/// reply; the error digit that most replies begin with is not theirs (see [`ErrorField`]).
///
/// The protocol has these fourteen and no others, so the trait cannot be implemented elsewhere.
pub trait Command: Clone + fmt::Debug + Send + Sync + sealed::Sealed + 'static {
    /// What the PLC answers, once the error code has said that all went well.
    type Reply: Clone + fmt::Debug + PartialEq + Send + Sync + 'static;

    /// Which command it is.
    const CODE: Code;

    /// Puts the request's fields behind the command code.
    fn write_request<W: FieldWriter>(&self, fields: &mut W);

    /// Takes the request's fields; the caller checks that nothing follows.
    ///
    /// # Errors
    /// [`FieldError`] for anything that no such request would hold.
    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, FieldError>;

    /// Puts the reply's fields behind the error code.
    fn write_reply<W: FieldWriter>(&self, reply: &Self::Reply, fields: &mut W);

    /// Takes the reply's fields, which must be those that this very request asks for; the caller checks that nothing
    /// follows.
    ///
    /// # Errors
    /// [`FieldError`] for anything that is no reply to this request.
    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Self::Reply, FieldError>;

    /// Checks what depends on the framing. Encoding a request does it first.
    ///
    /// # Errors
    /// [`InvalidRequest::NotInFraming`], and what the command itself adds.
    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(Self::CODE, framing)
    }

    /// The spelling that is this request itself.
    #[doc(hidden)]
    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, 0)
    }

    /// The other spellings; `longer`: the request is a part of a longer read or write, and may leave elements to the next one.
    #[doc(hidden)]
    fn candidates(&self, _longer: bool, _framing: Framing) -> Candidates {
        spelling::NONE
    }

    /// Puts the request's fields behind the code of a spelling.
    #[doc(hidden)]
    fn write_spelled<W: FieldWriter>(&self, _spelling: Spelling, fields: &mut W) {
        self.write_request(fields);
    }

    /// Takes the fields of a reply to a spelling: the values that the request asks for, or the first of them.
    #[doc(hidden)]
    fn read_spelled<R: FieldReader>(&self, _spelling: Spelling, fields: &mut R) -> Result<Self::Reply, FieldError> {
        self.read_reply(fields)
    }

    /// What the size of a positive reply is, as far as it decides whether the reply fits another request of its command: equal
    /// numbers for replies that fit each other's requests.
    #[doc(hidden)]
    fn reply_size(&self, _spelling: Spelling, _framing: Framing) -> u32 {
        0
    }

    /// Whether a refusal of an earlier request of this command could pass for its positive reply.
    #[doc(hidden)]
    fn is_like_a_refusal(&self) -> bool {
        false
    }

    /// The consecutive elements that are read or written.
    #[doc(hidden)]
    fn run(&self) -> Option<Run> {
        None
    }
}

/// So many values, for others to be read into. Not with `vec!`, for memory that comes zeroed takes allocators longer.
fn blank<T: Clone + Default>(count: usize) -> Vec<T> {
    let mut values = Vec::with_capacity(count);
    values.resize(count, T::default());
    values
}

mod sealed {
    use super::*;

    pub trait Sealed {}

    impl Sealed for ReadStatus {}
    impl Sealed for ControlPlc {}
    impl Sealed for ControlDiscrete {}
    impl Sealed for ReadDisabled {}
    impl Sealed for ReadDiscretes {}
    impl Sealed for WriteDiscretes {}
    impl<E: RegisterElement> Sealed for ReadRegisters<E> {}
    impl<E: RegisterElement> Sealed for WriteRegisters<E> {}
    impl Sealed for ReadMixed {}
    impl Sealed for WriteMixed {}
    impl Sealed for LoopBack {}
    impl Sealed for ReadProgramPage {}
    impl Sealed for WriteProgramPage {}
    impl Sealed for ReadDetailedStatus {}
}
