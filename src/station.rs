//! The handles with the commands: [`Station`] for one PLC, [`Broadcast`] for all of them.

mod any_length;
mod backup;
mod broadcast;
mod place;
mod program;

use std::fmt;

use bytes::Bytes;
use tokio::sync::watch;
use tokio::time::Instant;

use crate::command::{
    Answer, BriefStatus, Command, ControlDiscrete, ControlPlc, DetailedStatus, DiscreteControl, InvalidRequest,
    LoopBack, MAX_POINTS, MAX_UNITS, ProgramPage, ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed,
    ReadProgramPage, ReadRegisters, ReadStatus, Request, Value, WriteDiscretes, WriteMixed, WriteProgramPage,
    WriteRegisters, with_command,
};
use crate::element::{Discrete, Element, Register, Register32};
use crate::error::Error;
use crate::link::{CallOptions, Link, StationState, StationStats};

pub use self::broadcast::Broadcast;
pub(crate) use self::place::{BegunWith, OtherStation};

/// One PLC on a [`Link`]. Cheap to clone; every method takes `&self`, so that one handle serves many tasks.
///
/// Each method sends one request and gives its reply; those that read or write consecutive elements send as many as the
/// elements take ([*any length*](#any-length)). All of them fail alike:
///
/// - [`Error::Invalid`] when an argument breaks a rule of the protocol; nothing is sent;
/// - [`Error::Plc`] when the PLC refuses the request;
/// - [`Error::Timeout`], [`Error::BadReply`], [`Error::Disconnected`], [`Error::Connect`], [`Error::Offline`],
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
/// take any number and send full requests, one after the other, and a shorter one at the end. So:
///
/// - Up to the limit of one request, all values are of one scan. Beyond it, **they are not**: what belongs together may
///   change between one request and the next. A value of 32 bits is never split.
/// - Other calls of the link come in between, as their priority says.
/// - Nothing is sent unless all the elements exist.
/// - Each request has its own time, [`CallOptions::call_timeout`], and its own retries. For a limit on the whole, put it
///   in a [`tokio::time::timeout`].
/// - A read fails as a whole, with the error of the first request that fails, and no more are sent. A write ends there,
///   too; if it was not the first request, the error is [`Error::PartlyWritten`], which tells what has been written. So
///   it is when it is dropped: what was sent before is written.
///
/// [`call`](Self::call) sends exactly one request, and a longer one is refused:
///
/// ```
/// # fatek::sim::doctest(|station| async move {
/// use fatek::command::ReadRegisters;
/// use fatek::register;
///
/// assert_eq!(station.read_registers(register!("R0"), 1000).await?.len(), 1000); // 16 requests
/// assert_eq!(station.call(ReadRegisters::new(register!("R0"), 64)?).await?.len(), 64); // one scan for certain
/// assert!(ReadRegisters::new(register!("R0"), 65).is_err());
/// # Ok(()) });
/// ```
#[derive(Clone)]
pub struct Station {
    link: Link,
    number: u8,
    options: CallOptions,
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
        self.link.submit(self.number, request, None, self.options).await.0
    }

    /// As [`call`](Self::call), and tells when the reply came; if none did, when that was known.
    pub(crate) async fn timed_call<C: Command>(&self, request: C) -> (Result<C::Reply, Error>, Instant) {
        let (result, answered_at) = self.link.submit(self.number, request, None, self.options).await;
        (result, answered_at.unwrap_or_else(Instant::now))
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
    pub async fn forward(&self, request: Request) -> Result<Answer, Error> {
        with_command!(request, request => self.answer(request).await)
    }

    async fn answer<C: Command>(&self, request: C) -> Result<Answer, Error> {
        let reply = self.call(request.clone()).await?;
        Ok(Answer::new(request, reply))
    }

    /// 40: reads the brief status: whether it runs, and what is wrong.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.run().await?;
    /// assert!(station.read_status().await?.flags().running());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_status(&self) -> Result<BriefStatus, Error> {
        self.call(ReadStatus).await
    }

    /// 53: reads the detailed status: what it is, and how large its memory is.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let status = station.read_detailed_status().await?;
    /// println!("{} words of ladder, {} registers R", status.ladder_words(), status.r_registers());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_detailed_status(&self) -> Result<DetailedStatus, Error> {
        self.call(ReadDetailedStatus).await
    }

    /// 41: starts the ladder program.
    ///
    /// # Errors
    /// As for every method of this type; the PLC may refuse with [`LadderChecksum`](crate::ErrorCode::LadderChecksum),
    /// [`IdMismatch`](crate::ErrorCode::IdMismatch), [`Syntax`](crate::ErrorCode::Syntax) or
    /// [`NotSupported`](crate::ErrorCode::NotSupported).
    pub async fn run(&self) -> Result<(), Error> {
        self.call(ControlPlc::Run).await
    }

    /// 41: stops the ladder program.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.stop().await?;
    /// assert!(!station.read_status().await?.flags().running());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn stop(&self) -> Result<(), Error> {
        self.call(ControlPlc::Stop).await
    }

    /// 42: disables a discrete: its state no longer follows the program or the input, and stays as it is set or reset.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let sensor = fatek::discrete!("X16");
    /// station.disable(sensor).await?;
    /// station.set(sensor).await?; // forced on
    /// assert_eq!(station.read_disabled(sensor, 1).await?, [true]);
    /// station.enable(sensor).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn disable(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Disable, discrete).await
    }

    /// 42: enables a discrete: its state follows the program or the input again.
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn enable(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Enable, discrete).await
    }

    /// 42: sets a discrete: on.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.set(fatek::discrete!("Y3")).await?;
    /// assert_eq!(station.read_discretes(fatek::discrete!("Y2"), 3).await?, [false, true, false]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn set(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Set, discrete).await
    }

    /// 42: resets a discrete: off.
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn reset(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Reset, discrete).await
    }

    async fn control(&self, control: DiscreteControl, discrete: Discrete) -> Result<(), Error> {
        self.call(ControlDiscrete::new(control, discrete)).await
    }

    /// 43: reads which of `count` consecutive discretes are disabled: `true` is disabled. Each 256 are one request, of
    /// [one scan](#any-length).
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_disabled(&self, first: Discrete, count: usize) -> Result<Vec<bool>, Error> {
        any_length::read(self, first, count, ReadDisabled::new).await
    }

    /// 44: reads the states of `count` consecutive discretes: `true` is on. Each 256 are one request, of
    /// [one scan](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let relays = station.read_discretes(fatek::discrete!("M0"), 256).await?;
    /// assert_eq!(relays.len(), 256);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_discretes(&self, first: Discrete, count: usize) -> Result<Vec<bool>, Error> {
        any_length::read(self, first, count, ReadDiscretes::new).await
    }

    /// 44: reads the states of consecutive discretes, as many as `into` has places: as
    /// [`read_discretes`](Self::read_discretes), without a new `Vec` for each call.
    ///
    /// Of `into`, it can be said after an error, or when the future was dropped, what can be said after an error of
    /// [`read_registers_into`](Self::read_registers_into); a request is 256 discretes.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let mut relays = [false; 24];
    /// station.read_discretes_into(fatek::discrete!("M0"), &mut relays).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_discretes_into(&self, first: Discrete, into: &mut [bool]) -> Result<(), Error> {
        any_length::read_into::<_, _, MAX_POINTS>(self, first, into, ReadDiscretes::new).await
    }

    /// 45: writes the states of consecutive discretes: `true` is on. Each 256 are [one request](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_discretes(fatek::discrete!("Y0"), &[true, false, false, true]).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type, and [`Error::PartlyWritten`].
    pub async fn write_discretes(&self, first: Discrete, states: &[bool]) -> Result<(), Error> {
        any_length::write(self, first, states, |first, states: &[bool]| WriteDiscretes::new(first, states)).await
    }

    /// 46: reads `count` consecutive registers of 16 bits. Each 64 are one request, of [one scan](#any-length).
    ///
    /// Words of discretes count as registers: after `WY8` comes `WY24`.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let values = station.read_registers(fatek::register!("R12"), 3).await?; // R12, R13, R14
    /// assert_eq!(values.len(), 3);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_registers(&self, first: Register, count: usize) -> Result<Vec<u16>, Error> {
        any_length::read(self, first, count, ReadRegisters::new).await
    }

    /// 46: reads consecutive registers of 16 bits, as many as `into` has places: as
    /// [`read_registers`](Self::read_registers), without a new `Vec` for each call. Once the link has made a few calls,
    /// such a call takes no memory from the heap, unless more than 16 calls are under way on the link.
    ///
    /// All of `into` is filled when this succeeds. After an error, or when the future was dropped, the values of each
    /// request that was answered before are in their places, 64 registers each, from the first on; everything behind them
    /// is as it was. So up to 64 registers are all read, or none is.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let mut values = [0; 64];
    /// for _ in 0..10 {
    ///     station.read_registers_into(fatek::register!("R0"), &mut values).await?;
    /// }
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type; [`InvalidRequest::Count`] when `into` is empty.
    pub async fn read_registers_into(&self, first: Register, into: &mut [u16]) -> Result<(), Error> {
        any_length::read_into::<_, _, MAX_UNITS>(self, first, into, ReadRegisters::new).await
    }

    /// 47: writes consecutive registers of 16 bits. Each 64 are [one request](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_registers(fatek::register!("WY8"), &[0xAAAA, 0x5555]).await?; // Y8 to Y39
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type, and [`Error::PartlyWritten`].
    pub async fn write_registers(&self, first: Register, values: &[u16]) -> Result<(), Error> {
        any_length::write(self, first, values, |first, values: &[u16]| WriteRegisters::new(first, values)).await
    }

    /// 46: reads `count` consecutive registers of 32 bits: `DR0`, `DR2`, `DR4` … Each 32 are one request, of
    /// [one scan](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_registers(fatek::register!("R100"), &[0x9680, 0x0098]).await?; // the low word first
    /// assert_eq!(station.read_registers32(fatek::register32!("DR100"), 1).await?, [10_000_000]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_registers32(&self, first: Register32, count: usize) -> Result<Vec<u32>, Error> {
        any_length::read(self, first, count, ReadRegisters::new).await
    }

    /// 47: writes consecutive registers of 32 bits. Each 32 are [one request](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_registers32(fatek::register32!("DR2"), &[(-500.125_f32).to_bits()]).await?;
    /// assert_eq!(station.read_registers(fatek::register!("R2"), 2).await?, [0x1000, 0xC3FA]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type, and [`Error::PartlyWritten`].
    pub async fn write_registers32(&self, first: Register32, values: &[u32]) -> Result<(), Error> {
        any_length::write(self, first, values, |first, values: &[u32]| WriteRegisters::new(first, values)).await
    }

    /// 48: reads any elements in one request, in the order given: up to 64, where one of 32 bits counts two.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::{Value, element};
    ///
    /// let values = station.read_mixed(&[element!("R1"), element!("Y9"), element!("DWM0")]).await?;
    /// assert_eq!(values, [Value::Word(0), Value::Bit(false), Value::Double(0)]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn read_mixed(&self, elements: &[Element]) -> Result<Vec<Value>, Error> {
        self.call(ReadMixed::new(elements)?).await
    }

    /// 49: writes any elements in one request: up to 32, where one of 32 bits counts two.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::element;
    ///
    /// station.write_mixed(&[(element!("Y0"), true.into()), (element!("DR2"), 0xFF_u32.into())]).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn write_mixed(&self, items: &[(Element, Value)]) -> Result<(), Error> {
        self.call(WriteMixed::new(items)?).await
    }

    /// 4E: sends up to 256 characters (ASCII framing) or bytes (binary framing), which the PLC must return as they are.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.loop_back("ABCDEFG").await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type.
    pub async fn loop_back(&self, data: impl Into<Bytes>) -> Result<(), Error> {
        self.call(LoopBack::new(data)?).await
    }

    /// 4F: reads one page of the program; page 0 is the header. ASCII framing only.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let header = station.read_program_page(0).await?;
    /// assert_eq!(header.to_bytes()[0], b'F');
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As for every method of this type; [`InvalidRequest::NotInFraming`] in the binary framing.
    pub async fn read_program_page(&self, page: u16) -> Result<ProgramPage, Error> {
        self.call(ReadProgramPage::new(page)).await
    }

    /// 50: writes one page of the program, as [`read_program_page`](Self::read_program_page) gave it. ASCII framing
    /// only.
    ///
    /// A PLC that runs may refuse with [`IllegalFormat`](crate::ErrorCode::IllegalFormat): stop it first.
    ///
    /// # Errors
    /// As for every method of this type; [`InvalidRequest::NotInFraming`] in the binary framing.
    pub async fn write_program_page(&self, page: u16, content: &ProgramPage) -> Result<(), Error> {
        self.call(WriteProgramPage::new(page, content.clone())).await
    }
}

impl fmt::Debug for Station {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "Station({} on {:?})", self.number, self.link)
    }
}
