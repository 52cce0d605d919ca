//! The commands of the protocol: one type each, with request and reply.
//!
//! A value of such a type has passed the limits of its command. It writes and reads the fields of
//! its request and of its reply through [`FieldWriter`] and [`FieldReader`], in either framing.
//! Client and simulator share these types.
//!
//! [`Frame::request`] and [`Frame::reply`] make frames of them for a codec, [`Request::decode`] and
//! [`Frame::decode_reply`] decode received ones. Requests and replies have a text of one line for
//! logs (`Display`), such as `read registers (46h) R12 to R14`.
//!
//! [`Frame::request`]: crate::wire::Frame::request
//! [`Frame::reply`]: crate::wire::Frame::reply
//! [`Frame::decode_reply`]: crate::wire::Frame::decode_reply
//!
//! Most programs use the methods of [`Station`](crate::Station) instead.
//!
//! Source: protocol reference, section 5 (manuals 000 and 002 section 4.2, 001 section 2.5).

#[macro_use]
mod table;

mod code;
mod consecutive;
mod control;
mod discrete;
mod forwarded_reply;
mod frame;
mod framing;
mod limits;
mod loopback;
mod mixed;
mod program;
mod register;
mod request;
mod set;
mod spelling;
mod stack_reply;
mod status;
mod text;

use std::fmt;

pub use code::{Class, ErrorField};
pub use consecutive::ConsecutiveElement;
pub use control::DiscreteControl;
pub use forwarded_reply::ForwardedReply;
pub use framing::{ReplyError, decode_reply, encode_refusal, encode_reply, encode_request};
pub(crate) use framing::{decode_spelled_into, encode_spelled, refusal_in};
pub use limits::{InvalidRequest, MAX_LOOP_BACK, MAX_MIXED_READ_UNITS, MAX_MIXED_WRITE_UNITS, MAX_POINTS, MAX_UNITS};
pub(crate) use limits::{RequestLengths, check_range, most_in_one_request};
pub use program::{PAGE_WORDS, ProgramPage};
pub use register::RegisterElement;
pub use request::RequestError;
pub(crate) use set::CommandSet;
pub(crate) use spelling::{Candidate, Candidates, NONE as NO_CANDIDATES, Run, Spelling};
pub(crate) use stack_reply::{ArrayVec, Consecutive, StackReply, ValueOf};
pub use status::{BriefStatus, DetailedStatus, MainUnit, ProgramCapacity, Series, StatusFlags};
#[cfg(feature = "sim")]
pub(crate) use text::Data;

pub use crate::element::Value;
use crate::element::{Register, Register32};
use crate::wire::{FieldError, FieldReader, FieldWriter, Framing};

// The command table, as in the manuals. It makes `Code`, `Request` and `with_command!`.
//
// - file:    the module with the type of the command
// - class:   the effect on the PLC
// - framing: the framings that have the command
// - error:   the place of the error code in the reply
commands! {
    // code  file      command            name                    class    framing    error
    0x40  status    ReadStatus          "read brief status"     Read     Both       Leading;
    0x41  control   ControlPlc          "control RUN/STOP"      Control  Both       Leading;
    0x42  control   ControlDiscrete     "control one discrete"  Control  Both       Leading;
    0x43  discrete  ReadDisabled        "read enable/disable"   Read     Both       Leading;
    0x44  discrete  ReadDiscretes       "read discretes"        Read     Both       Leading;
    0x45  discrete  WriteDiscretes      "write discretes"       Write    Both       Leading;
    0x46  register  ReadRegisters<Register> or ReadRegisters32<Register32>
                                        "read registers"        Read     Both       Leading;
    0x47  register  WriteRegisters<Register> or WriteRegisters32<Register32>
                                        "write registers"       Write    Both       Leading;
    0x48  mixed     ReadMixed           "mixed read"            Read     Both       Leading;
    0x49  mixed     WriteMixed          "mixed write"           Write    Both       Leading;
    0x4E  loopback  LoopBack            "loop back"             Read     Both       Absent;
    0x4F  program   ReadProgramPage     "read program page"     Read     AsciiOnly  ByLength;
    0x50  program   WriteProgramPage    "write program page"    Write    AsciiOnly  Leading;
    0x53  status    ReadDetailedStatus  "read detailed status"  Read     Both       Leading;
}

/// A command: a request, and the reply to it.
///
/// `Display` is the request as a text for logs, as of [`Request`].
///
/// The error code before most replies is not part of `Reply` (see [`ErrorField`]).
///
/// The protocol has no other commands, so the trait cannot be implemented outside of this crate.
pub trait Command: Clone + fmt::Debug + fmt::Display + Send + Sync + sealed::Sealed + 'static {
    /// The data of a reply that is not a refusal.
    type Reply: Clone + fmt::Debug + PartialEq + Send + Sync + 'static;

    /// The code of the command.
    const CODE: Code;

    /// The result of a request that ends without a reply: of a broadcast, which no PLC answers, and of a
    /// check that confirms earlier results. `None` for commands that read values.
    #[doc(hidden)]
    const IMPLIED_REPLY: Option<Self::Reply> = None;

    /// Writes the fields of the request, which follow the command code.
    fn write_request<W: FieldWriter>(&self, fields: &mut W);

    /// Reads the fields of a request. The caller checks that no bytes follow.
    ///
    /// # Errors
    /// [`RequestError`] for fields that no such request has.
    fn read_request<R: FieldReader>(fields: &mut R) -> Result<Self, RequestError>;

    /// Writes the fields of the reply, which follow the error code.
    fn write_reply<W: FieldWriter>(&self, reply: &Self::Reply, fields: &mut W);

    /// Reads the fields of the reply to this request. The caller checks that no bytes follow.
    ///
    /// # Errors
    /// [`FieldError`] for fields that no reply to this request has.
    fn read_reply<R: FieldReader>(&self, fields: &mut R) -> Result<Self::Reply, FieldError>;

    /// Writes the reply as a text of bounded length, on one line.
    #[doc(hidden)]
    fn fmt_reply(reply: &Self::Reply, f: &mut fmt::Formatter<'_>) -> fmt::Result;

    /// Checks the rules that depend on the framing. [`encode_request`] calls it.
    ///
    /// # Errors
    /// [`InvalidRequest::NotInFraming`];
    /// [`ElementError::PastFraming`](crate::element::ElementError) in [`InvalidRequest::Element`];
    /// and errors of the command itself.
    fn check(&self, framing: Framing) -> Result<(), InvalidRequest> {
        limits::in_framing(self, framing)
    }

    /// Calls `each` with all elements that the request names, as runs of consecutive ones.
    #[doc(hidden)]
    fn for_each_run(&self, each: &mut dyn FnMut(Run));

    /// The spelling of the request itself.
    #[doc(hidden)]
    fn plain(&self) -> Spelling {
        Spelling::new(Self::CODE, 0)
    }

    /// The other spellings of the request.
    ///
    /// `longer`: the request is a part of a longer read or write, so a spelling may leave elements
    /// to the next request.
    #[doc(hidden)]
    fn candidates(&self, _longer: bool, _framing: Framing) -> Candidates {
        spelling::NONE
    }

    /// Writes the fields of a spelling, which follow the code of the spelling.
    #[doc(hidden)]
    fn write_spelled<W: FieldWriter>(&self, _spelling: Spelling, fields: &mut W) {
        self.write_request(fields);
    }

    /// Reads the fields of the reply to a spelling: the values that the request asks for, or the
    /// first of them.
    #[doc(hidden)]
    fn read_spelled<R: FieldReader>(&self, _spelling: Spelling, fields: &mut R) -> Result<Self::Reply, FieldError> {
        self.read_reply(fields)
    }

    /// As `read_spelled`, with a place for the reply, which may have an earlier one: a large reply need
    /// not be moved. The place is not to be used after an error.
    #[doc(hidden)]
    fn read_spelled_into<R: FieldReader>(
        &self,
        spelling: Spelling,
        fields: &mut R,
        reply: &mut Option<Self::Reply>,
    ) -> Result<(), FieldError> {
        *reply = Some(self.read_spelled(spelling, fields)?);
        Ok(())
    }

    /// A number for the shape of the positive reply: equal for requests of one command that take
    /// each other's replies.
    #[doc(hidden)]
    fn reply_size(&self, _spelling: Spelling, _framing: Framing) -> u32 {
        0
    }

    /// Returns whether a refusal of an earlier request of this command fits as its positive reply.
    #[doc(hidden)]
    fn is_like_a_refusal(&self) -> bool {
        false
    }

    /// The consecutive elements that are read or written, for spellings with one element more.
    #[doc(hidden)]
    fn run(&self) -> Option<Run> {
        None
    }
}

/// Default values to read into. Not made with `vec!`, because allocators take longer for zeroed
/// memory.
fn blank<T: Clone + Default>(count: usize) -> Vec<T> {
    let mut values = Vec::with_capacity(count);
    values.resize(count, T::default());
    values
}

mod sealed {
    /// Implemented beside each command.
    pub trait Sealed {}
}
