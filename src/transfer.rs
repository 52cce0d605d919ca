//! The transfer engine: what reading and writing programs and backups share.
//!
//! ```text
//! Transfer     decides the next step and handles the reply     no I/O, no clock
//! RunControl   STOP, RUN and status, part of a Transfer        no I/O, no clock
//! Driver       sends the requests of a Transfer                I/O, progress, resume guard
//! ```
//!
//! A [`Transfer`] is a state machine. The [`Driver`] sends what it asks for as one
//! [job](crate::link::job) and passes the replies back. A transfer compares, writes and verifies;
//! [`RunControl`] alone stops, starts and observes the PLC.
//!
//! Invariants:
//! - Replies of reads are held until a check (4E) confirms them: before STOP and RUN, before the
//!   first write after a comparison, and before [`Step::Done`].
//! - After an out-of-order duplicate the transfer goes back to the mark of the first held reply.
//! - A future may be dropped at any await. The transfer then is as if the reply to the last request
//!   had been lost, because it marks a write, STOP or RUN as in doubt before it is sent.
//! - A transfer that left something in a PLC resumes with the same station only ([`resume_guard`]).

#[cfg(all(test, feature = "sim"))]
pub(crate) mod contract;
mod driver;
mod hold_limit;
mod meter;
mod resume_guard;
mod run_control;
mod step;

pub(crate) use self::driver::Driver;
pub(crate) use self::hold_limit::HoldLimit;
pub(crate) use self::resume_guard::OtherStation;
pub use self::run_control::PlcState;
pub(crate) use self::run_control::{RunCause, RunCommand, RunControl, RunEvent, RunFailure};
pub(crate) use self::step::{Position, Reply, Request, Step, Transfer};
