//! The handle to one PLC.

use std::fmt;

use tokio::sync::watch;

use crate::command::{Command, ForwardedReply, InvalidRequest, Request, with_command};
use crate::error::Error;
use crate::link::{CallOptions, CallOutcome, Link, Purpose, StationState, StationStats};

/// One PLC on a [`Link`]. Cheap to clone; every method takes `&self`, so one handle serves many
/// tasks.
///
/// Each method sends one request and returns its reply. Methods for consecutive elements send as
/// many requests as needed ([*any length*](#any-length)).
///
/// # Errors
///
/// All methods fail alike:
///
/// - [`Error::Invalid`] if an argument breaks a rule of the protocol; nothing is sent.
/// - [`Error::Plc`] if the PLC refuses the request; [`Error::RefusedTags`] if that is one of a call for several tags.
///   [`Error::error_code`] is for both.
/// - [`Error::Timeout`], [`Error::BadReply`], [`Error::OutOfStep`], [`Error::Disconnected`],
///   [`Error::Connect`], [`Error::Offline`], [`Error::QueueFull`], [`Error::GateClosed`] and
///   [`Error::Closed`] if there is no usable reply. Reads were retried by then, as
///   [`CallOptions::with_retries`] says; writes and control commands only with
///   [`CallOptions::with_retry_writes`]. [`Error::may_have_executed`] tells whether the PLC may
///   have executed the request.
///
/// # Cancel safety
///
/// A call can be dropped at any time. A request that has not been sent is then never sent. One that
/// has been sent may be executed by the PLC; its reply is discarded.
///
/// # Special elements
///
/// Writes are sent to any element that the protocol has. R3840 to R4167 and M1912 to M2001 can cause
/// system or I/O errors when written: [`special_range`](crate::memory_map::special_range) tells them.
/// A [`MemoryMap`](crate::MemoryMap) tells the elements that a model has.
///
/// # Any length
///
/// One request is answered from one scan of the PLC; two requests are not. One request takes 256
/// discretes, 64 registers of 16 bits or 32 of 32 bits. [`read_registers`](Self::read_registers)
/// and the other methods for consecutive elements take any number and send several requests, one
/// after the other. So:
///
/// - Up to the limit of one request, all values are of one scan. The limit is lower if the
///   [declared capabilities](Self::set_capabilities) say so. Beyond it, **they are not**:
///   values that belong together may change between two requests. A value of 32 bits is never
///   split.
/// - The requests have full length and one element less in turn, so that two replies in a row
///   differ in size. On a network, writes are 47 with 64 registers and 49 with 32 in turn. A check
///   confirms them at the end.
/// - Other calls of the link come in between, by priority.
/// - Nothing is sent unless all the elements exist.
/// - Each request has its own [`CallOptions::with_call_timeout`] and its own retries. For a limit
///   on the whole, use a [`tokio::time::timeout`].
/// - A read fails as a whole, with the error of the first request that fails. A write ends there,
///   too; if it was not the first request, the error is [`Error::PartlyWritten`], which says how
///   much was written. If the future is dropped, all that was sent before stays written.
/// - If a duplicate of a reply comes out of order, a read repeats the requests since the last
///   check, and a write ends with [`Error::Duplicates`]: its result is unknown.
///
/// [`call`](Self::call) sends exactly one request, and a longer one is an error:
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

    /// Returns a handle to the same station with options of its own.
    ///
    /// ```
    /// # use std::time::Duration;
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::CallOptions;
    ///
    /// let options = CallOptions::new().with_response_timeout(Duration::from_millis(100));
    /// let hasty = station.with_options(options.with_retries(0));
    /// hasty.loop_back("ping").await?;
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn with_options(&self, options: CallOptions) -> Self {
        Self { options, ..self.clone() }
    }

    /// The station number, 1 to 254.
    #[must_use]
    pub fn number(&self) -> u8 {
        self.number
    }

    /// The link of the station.
    #[must_use]
    pub fn link(&self) -> &Link {
        &self.link
    }

    /// Returns the counters of the station, over all handles of the link: a snapshot.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.loop_back("x").await?;
    /// assert!(station.stats().round_trip.is_some());
    /// # Ok(()) });
    /// ```
    #[must_use]
    pub fn stats(&self) -> StationStats {
        self.link.shared_stats().station_stats(self.number)
    }

    /// Watches whether the station is online.
    #[must_use]
    pub fn watch_state(&self) -> watch::Receiver<StationState> {
        self.link.shared_stats().watch_state(self.number)
    }

    /// The options of its calls.
    #[must_use]
    pub fn options(&self) -> CallOptions {
        self.options
    }

    /// Sends any [`Command`] and returns its reply. The methods named after commands use it.
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
    /// Those of [every method](Self#errors).
    pub async fn call<C: Command>(&self, request: C) -> Result<C::Reply, Error> {
        self.call_with(request, Option::take).await
    }

    /// As [`call`](Self::call); `take` takes the reply, where it was decoded.
    pub(crate) async fn call_with<C: Command, T>(
        &self,
        request: C,
        take: impl FnOnce(&mut Option<C::Reply>) -> Option<T>,
    ) -> Result<T, Error> {
        self.link.call(self.number, request, &self.options, take).await
    }

    /// Makes a call for this purpose, and returns its result and proof.
    pub(crate) fn submit<C: Command>(
        &self,
        request: C,
        purpose: Purpose,
    ) -> impl Future<Output = CallOutcome<C::Reply>> {
        self.link.submit(self.number, request, purpose, &self.options)
    }

    /// Forwards a request, such as one that a gateway has decoded, and returns its reply for
    /// forwarding.
    ///
    /// It is a [`call`](Self::call) like any other: the reply must answer this very request, reads
    /// are retried, and writes are not.
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
    /// Those of [every method](Self#errors). A refusal of the PLC is [`Error::Plc`]:
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
