//! The handle to all PLCs at once.

use std::fmt;

use crate::command::{
    Class, Command, ControlDiscrete, ControlPlc, DiscreteControl, InvalidRequest, Request, Value, WriteDiscretes,
    WriteMixed, WriteRegisters, with_command,
};
use crate::element::{Discrete, Element, Register, Register32};
use crate::error::Error;
use crate::link::{CallOptions, Link};

/// All PLCs of a [`Link`] at once: station 0. Cheap to clone.
///
/// Every PLC executes a broadcast and none answers. So there are only commands that need no reply,
/// and `Ok` means that the request was sent, not that it was executed. Broadcasts are never
/// retried. A PLC that answers all the same, under its number or under 0, is counted
/// ([`StationStats::broadcast_answers`](crate::StationStats::broadcast_answers)); its answer is
/// never taken for a reply to a later request.
#[derive(Clone)]
pub struct Broadcast {
    link: Link,
    options: CallOptions,
}

impl Broadcast {
    pub(crate) fn new(link: Link, options: CallOptions) -> Self {
        Self { link, options }
    }

    /// Returns a handle with options of its own; only the timeout of the whole call matters here.
    #[must_use]
    pub fn with_options(&self, options: CallOptions) -> Self {
        Self { options, ..self.clone() }
    }

    /// Starts the ladder programs (41).
    ///
    /// # Errors
    /// Those of [`Station`](crate::Station#errors), except for those of replies.
    pub async fn run(&self) -> Result<(), Error> {
        self.cast(ControlPlc::Run).await
    }

    /// Stops the ladder programs (41).
    ///
    /// # Errors
    /// Those of [`run`](Self::run).
    pub async fn stop(&self) -> Result<(), Error> {
        self.cast(ControlPlc::Stop).await
    }

    /// Disables, enables, sets or resets a discrete (42).
    ///
    /// # Errors
    /// Those of [`run`](Self::run).
    pub async fn control(&self, control: DiscreteControl, discrete: Discrete) -> Result<(), Error> {
        self.cast(ControlDiscrete::new(control, discrete)).await
    }

    /// Writes the states of 1 to 256 consecutive discretes (45): `true` is on.
    ///
    /// # Errors
    /// Those of [`run`](Self::run).
    pub async fn write_discretes(&self, first: Discrete, states: &[bool]) -> Result<(), Error> {
        self.cast(WriteDiscretes::new(first, states)?).await
    }

    /// Writes 1 to 64 consecutive registers of 16 bits (47).
    ///
    /// # Errors
    /// Those of [`run`](Self::run).
    pub async fn write_registers(&self, first: Register, values: &[u16]) -> Result<(), Error> {
        self.cast(WriteRegisters::new(first, values)?).await
    }

    /// Writes 1 to 32 consecutive registers of 32 bits (47).
    ///
    /// # Errors
    /// Those of [`run`](Self::run).
    pub async fn write_registers32(&self, first: Register32, values: &[u32]) -> Result<(), Error> {
        self.cast(WriteRegisters::new(first, values)?).await
    }

    /// Writes any elements in one request (49): up to 32, where one of 32 bits counts two.
    ///
    /// # Errors
    /// Those of [`run`](Self::run).
    pub async fn write_mixed(&self, items: &[(Element, Value)]) -> Result<(), Error> {
        self.cast(WriteMixed::new(items)?).await
    }

    /// Forwards a request, such as one that a gateway has decoded.
    ///
    /// # Errors
    /// Those of [`run`](Self::run); [`InvalidRequest::NoBroadcast`] for a request that only reads.
    pub async fn forward(&self, request: Request) -> Result<(), Error> {
        with_command!(request, request => self.cast(request).await.map(drop))
    }

    async fn cast<C: Command>(&self, request: C) -> Result<C::Reply, Error> {
        if C::CODE.class() == Class::Read {
            return Err(InvalidRequest::NoBroadcast { code: C::CODE }.into());
        }
        self.link.call(0, request, &self.options.with_retries(0), Option::take).await
    }
}

impl fmt::Debug for Broadcast {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Broadcast(on {:?})", self.link)
    }
}
