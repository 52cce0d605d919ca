//! The handles with the commands: [`Station`] for one PLC, [`Broadcast`] for all of them.

mod any_length;
mod backup;
mod broadcast;
mod job;
mod program;

// The last one: the documentation has its methods just before those below.
mod handle;

use bytes::Bytes;

use crate::command::{
    BriefStatus, ControlDiscrete, ControlPlc, DetailedStatus, DiscreteControl, LoopBack, MAX_POINTS, MAX_UNITS,
    ProgramPage, ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed, ReadProgramPage, ReadRegisters,
    ReadStatus, Value, WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use crate::element::{Discrete, Element, Register, Register32};
use crate::error::Error;

pub use self::broadcast::Broadcast;
pub use self::handle::Station;
pub(crate) use self::job::{JobReply, Outcome, StationJob};

/// The commands, by name.
impl Station {
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
    /// After an error, or when the future was dropped, `into` is as after one of
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
    /// All of `into` is filled when this succeeds. Up to 64 registers are all read, or none is. Of more, a part may have been
    /// overwritten after an error, or when the future was dropped: the values of several requests are good only together.
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
    /// As for every method of this type; [`InvalidRequest::Count`](crate::command::InvalidRequest::Count) when `into` is
    /// empty.
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
    /// assert_eq!(values, [Value::Word(0), Value::Bit(false), Value::DWord(0)]);
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
    /// As for every method of this type;
    /// [`InvalidRequest::NotInFraming`](crate::command::InvalidRequest::NotInFraming) in the binary framing.
    pub async fn read_program_page(&self, page: u16) -> Result<ProgramPage, Error> {
        self.call(ReadProgramPage::new(page)).await
    }

    /// 50: writes one page of the program, as [`read_program_page`](Self::read_program_page) gave it. ASCII framing
    /// only.
    ///
    /// A PLC that runs may refuse with [`IllegalFormat`](crate::ErrorCode::IllegalFormat): stop it first.
    ///
    /// # Errors
    /// As for every method of this type;
    /// [`InvalidRequest::NotInFraming`](crate::command::InvalidRequest::NotInFraming) in the binary framing.
    pub async fn write_program_page(&self, page: u16, content: &ProgramPage) -> Result<(), Error> {
        self.call(WriteProgramPage::new(page, content.clone())).await
    }
}
