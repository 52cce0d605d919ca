//! The handle to one PLC.

use std::fmt;

use tokio::sync::watch;

use crate::command::{Command, ForwardedReply, InvalidRequest, Request, with_command};
use crate::error::Error;
use crate::link::{Answered, CallOptions, Link, Purpose, StationState, StationStats};

/// One PLC on a [`Link`]. Cheap to clone; every method takes `&self`, so that one handle serves many tasks.
///
/// Each method sends one request and gives its reply; those that read or write consecutive elements send as many as the
/// elements take ([*any length*](#any-length)). All of them fail alike:
///
/// - [`Error::Invalid`] when an argument breaks a rule of the protocol; nothing is sent;
/// - [`Error::Plc`] when the PLC refuses the request;
/// - [`Error::Timeout`], [`Error::BadReply`], [`Error::OutOfStep`], [`Error::Disconnected`], [`Error::Connect`], [`Error::Offline`],
///   [`Error::QueueFull`] and [`Error::Closed`] when there is no usable answer. Reads have been repeated by then, as
///   [`CallOptions::retries`] says; writes and control have not, unless [`CallOptions::retry_writes`] says so.
///   [`Error::may_have_executed`] tells whether the PLC may have done what was asked.
///
/// A call can be dropped at any time. A request that has not been sent is then not sent any more; one that has been
/// sent is executed by the PLC, and its reply is given to nobody.
///
/// # Any length
///
/// One request is answered from one scan of the PLC; two requests are not. One request takes 256 discretes, 64 registers
/// of 16 bits or 32 of 32 bits. [`read_registers`](Self::read_registers) and the other methods for consecutive elements
/// take any number and send several requests, one after the other. So:
///
/// - Up to the limit of one request, all values are of one scan. Beyond it, **they are not**: what belongs together may
///   change between one request and the next. A value of 32 bits is never split.
/// - Several requests are full ones and ones with an element less in turn, so that the replies to two in a row differ in size; on
///   a network, writes are 47 of 64 registers and 49 of 32 in turn. A check confirms them at the end.
/// - Other calls of the link come in between, as their priority says.
/// - Nothing is sent unless all the elements exist.
/// - Each request has its own time, [`CallOptions::call_timeout`], and its own retries. For a limit on the whole, put it
///   in a [`tokio::time::timeout`].
/// - A read fails as a whole, with the error of the first request that fails, and no more are sent. A write ends there,
///   too; if it was not the first request, the error is [`Error::PartlyWritten`], which tells what has been written. So
///   it is when it is dropped: what was sent before is written.
/// - If a duplicate of a reply comes out of order in between, a read asks again for the values since the last check, and
///   a write ends with [`Error::Duplicates`]: its result is unknown.
///
/// [`call`](Self::call) sends exactly one request, and a longer one is refused:
///
/// ```
/// # fatek::sim::doctest(|station| async move {
/// use fatek::command::ReadRegisters;
/// use fatek::register;
///
/// assert_eq!(station.read_registers(register!("R0"), 1000).await?.len(), 1000); // 16 requests and a check
/// assert_eq!(station.call(ReadRegisters::new(register!("R0"), 64)?).await?.len(), 64); // one scan for certain
/// assert!(ReadRegisters::new(register!("R0"), 65).is_err());
/// # Ok(()) });
/// ```
#[derive(Clone)]
pub struct Station {
    pub(super) link: Link,
    pub(super) number: u8,
    pub(super) options: CallOptions,
}

impl Station {
    pub(crate) fn new(link: Link, number: u8, options: CallOptions) -> Result<Self, InvalidRequest> {
        Self::check_number(number)?;
        Ok(Self { link, number, options })
    }

    pub(crate) fn check_number(number: u8) -> Result<(), InvalidRequest> {
        match number {
            1..=254 => Ok(()),
            _ => Err(InvalidRequest::Station { station: number }),
        }
    }

    /// The same station, with options of its own.
    ///
    /// ```
    /// # use std::time::Duration;
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::CallOptions;
    ///
    /// let hasty = station.with_options(CallOptions::new().response_timeout(Duration::from_millis(100)).retries(0));
    /// hasty.loop_back("ping").await?;
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn with_options(&self, options: CallOptions) -> Self {
        Self { options, ..self.clone() }
    }

    /// Its station number, 1 to 254.
    #[must_use]
    pub fn number(&self) -> u8 {
        self.number
    }

    /// The link it is on.
    #[must_use]
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// What it has been asked and has answered so far, by all handles of the link: a snapshot.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.loop_back("x").await?;
    /// assert!(station.stats().round_trip.is_some());
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn stats(&self) -> StationStats {
        self.link.board().station(self.number)
    }

    /// Whether it answers, to be watched.
    #[must_use]
    pub fn watch_state(&self) -> watch::Receiver<StationState> {
        self.link.board().watch(self.number)
    }

    /// The options of its calls.
    #[must_use]
    pub fn options(&self) -> CallOptions {
        self.options
    }

    /// Sends any [`Command`] and gives its reply. The methods below are this, by name.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::command::ReadRegisters;
    ///
    /// let request = ReadRegisters::new(fatek::register!("D0"), 2)?; // checked here, to be sent as often as needed
    /// assert_eq!(station.call(request).await?, [0, 0]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn call<C: Command>(&self, request: C) -> Result<C::Reply, Error> {
        self.submit(request, Purpose::Whole).await.result
    }

    /// Sends a request for this purpose, and tells what its answer proves.
    pub(crate) async fn submit<C: Command>(&self, request: C, purpose: Purpose<C>) -> Answered<C::Reply> {
        self.link.submit(self.number, request, purpose, self.options).await
    }

    /// Sends a request that was made elsewhere, such as one that a gateway has decoded, and gives its reply so that it can
    /// be sent on.
    ///
    /// It is a [`call`](Self::call) like any other: the reply must be one to this very request, reads are repeated, and
    /// writes are not.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use bytes::BytesMut;
    /// use fatek::command::Request;
    /// use fatek::wire::{Frame, Framing};
    ///
    /// let asked = Frame { station: 1, command: 0x46, data: "02R00000".into() }; // by a client of the gateway
    /// let answer = station.forward(Request::decode(&asked, Framing::Ascii)?).await?;
    /// let mut reply = BytesMut::new();
    /// answer.encode(Framing::Ascii, asked.station, &mut reply);
    /// assert_eq!(&reply[..], b"\x0201460000000007D\x03");
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type. What the PLC refuses is [`Error::Plc`]:
    /// [`encode_refusal`](crate::command::encode_refusal) makes a frame of its error code.
    pub async fn forward(&self, request: Request) -> Result<ForwardedReply, Error> {
        with_command!(request, request => self.answer(request).await)
    }

    async fn answer<C: Command>(&self, request: C) -> Result<ForwardedReply, Error> {
        let reply = self.call(request.clone()).await?;
        Ok(ForwardedReply::new(request, reply))
    }
}

impl fmt::Debug for Station {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Station({} on {:?})", self.number, self.link)
    }
}
