//! The handle to all PLCs at once.

use std::fmt;

use crate::command::{
    Command, ControlDiscrete, ControlPlc, DiscreteControl, InvalidRequest, Request, Value, WriteDiscretes, WriteMixed,
    WriteRegisters, with_command,
};
use crate::element::{Discrete, Element, Register, Register32};
use crate::error::Error;
use crate::link::{CallOptions, Link, Purpose};

/// All PLCs of a [`Link`] at once: station 0. Cheap to clone.
///
/// Every PLC obeys and none answers, so there are only the commands that make sense without an answer, and their `Ok`
/// says that the request was sent, not that it was executed. They are never repeated. A PLC that answers all the same, under its
/// number or under 0, is counted ([`StationStats::broadcast_answers`](crate::StationStats::broadcast_answers)); its answer is never
/// the reply to what follows.
#[derive(Clone)]
pub struct Broadcast {
    link: Link,
    options: CallOptions,
}

impl Broadcast {
    pub(crate) fn new(link: Link, options: CallOptions) -> Self {
        Self { link, options }
    }

    /// The same, with options of its own: of these, only how long the whole call may take matters here.
    #[must_use]
    pub fn with_options(&self, options: CallOptions) -> Self {
        Self { options, ..self.clone() }
    }

    /// 41: starts the ladder programs.
    ///
    /// # Errors
    /// As for every method of [`Station`](crate::Station), except that there are no answers to go wrong.
    pub async fn run(&self) -> Result<(), Error> {
        self.cast(ControlPlc::Run).await
    }

    /// 41: stops the ladder programs.
    ///
    /// # Errors
    /// As for [`run`](Self::run).
    pub async fn stop(&self) -> Result<(), Error> {
        self.cast(ControlPlc::Stop).await
    }

    /// 42: disables, enables, sets or resets a discrete.
    ///
    /// # Errors
    /// As for [`run`](Self::run).
    pub async fn control(&self, control: DiscreteControl, discrete: Discrete) -> Result<(), Error> {
        self.cast(ControlDiscrete::new(control, discrete)).await
    }

    /// 45: writes the states of 1 to 256 consecutive discretes: `true` is on.
    ///
    /// # Errors
    /// As for [`run`](Self::run).
    pub async fn write_discretes(&self, first: Discrete, states: &[bool]) -> Result<(), Error> {
        self.cast(WriteDiscretes::new(first, states)?).await
    }

    /// 47: writes 1 to 64 consecutive registers of 16 bits.
    ///
    /// # Errors
    /// As for [`run`](Self::run).
    pub async fn write_registers(&self, first: Register, values: &[u16]) -> Result<(), Error> {
        self.cast(WriteRegisters::new(first, values)?).await
    }

    /// 47: writes 1 to 32 consecutive registers of 32 bits.
    ///
    /// # Errors
    /// As for [`run`](Self::run).
    pub async fn write_registers32(&self, first: Register32, values: &[u32]) -> Result<(), Error> {
        self.cast(WriteRegisters::new(first, values)?).await
    }

    /// 49: writes any elements in one request: up to 32, where one of 32 bits counts two.
    ///
    /// # Errors
    /// As for [`run`](Self::run).
    pub async fn write_mixed(&self, items: &[(Element, Value)]) -> Result<(), Error> {
        self.cast(WriteMixed::new(items)?).await
    }

    /// Sends a request that was made elsewhere, such as one that a gateway has decoded.
    ///
    /// # Errors
    /// As for [`run`](Self::run); [`InvalidRequest::NoBroadcast`] for a request that only reads.
    pub async fn forward(&self, request: Request) -> Result<(), Error> {
        with_command!(request, request => self.cast(request).await.map(drop))
    }

    async fn cast<C: Command>(&self, request: C) -> Result<C::Reply, Error> {
        let Some(reply) = C::BROADCAST_REPLY else { return Err(InvalidRequest::NoBroadcast { code: C::CODE }.into()) };
        self.link.submit(0, request, Purpose::Broadcast(reply), self.options.retries(0)).await.result
    }
}

impl fmt::Debug for Broadcast {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Broadcast(on {:?})", self.link)
    }
}
