//! The handles with the commands: [`Station`] for one PLC, [`Broadcast`] for all of them.

mod any_length;
mod backup;
mod broadcast;
mod capabilities;
mod clock;
mod job;
mod modify_bits;
mod program;
mod tags;

// Declared last: rustdoc then lists its methods just before those below.
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

/// One method for each command.
impl Station {
    /// Reads the brief status (40): RUN or STOP, and the faults.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.run().await?;
    /// assert!(station.read_status().await?.flags().running());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_status(&self) -> Result<BriefStatus, Error> {
        self.call(ReadStatus).await
    }

    /// Reads the detailed status (53): the model, and the sizes of its memory.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let status = station.read_detailed_status().await?;
    /// println!("{} words of ladder, {} registers R", status.ladder_words(), status.r_registers());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_detailed_status(&self) -> Result<DetailedStatus, Error> {
        self.call(ReadDetailedStatus).await
    }

    /// Starts the ladder program (41).
    ///
    /// # Errors
    /// Those of [every method](Self#errors). The PLC may refuse with
    /// [`LadderChecksum`](crate::ErrorCode::LadderChecksum),
    /// [`IdMismatch`](crate::ErrorCode::IdMismatch), [`Syntax`](crate::ErrorCode::Syntax) or
    /// [`NotSupported`](crate::ErrorCode::NotSupported).
    pub async fn run(&self) -> Result<(), Error> {
        self.call(ControlPlc::Run).await
    }

    /// Stops the ladder program (41).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.stop().await?;
    /// assert!(!station.read_status().await?.flags().running());
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn stop(&self) -> Result<(), Error> {
        self.call(ControlPlc::Stop).await
    }

    /// Disables a discrete (42): it no longer follows the program or the input, and keeps the state
    /// that is set.
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
    /// Those of [every method](Self#errors).
    pub async fn disable(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Disable, discrete).await
    }

    /// Enables a discrete (42): it follows the program or the input again.
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn enable(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Enable, discrete).await
    }

    /// Sets a discrete (42): on.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.set(fatek::discrete!("Y3")).await?;
    /// assert_eq!(station.read_discretes(fatek::discrete!("Y2"), 3).await?, [false, true, false]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn set(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Set, discrete).await
    }

    /// Resets a discrete (42): off.
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn reset(&self, discrete: Discrete) -> Result<(), Error> {
        self.control(DiscreteControl::Reset, discrete).await
    }

    async fn control(&self, control: DiscreteControl, discrete: Discrete) -> Result<(), Error> {
        self.call(ControlDiscrete::new(control, discrete)).await
    }

    /// Reads which of `count` consecutive discretes are disabled (43): `true` is disabled.
    ///
    /// Each 256 are one request, of [one scan](#any-length).
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_disabled(&self, first: Discrete, count: usize) -> Result<Vec<bool>, Error> {
        any_length::read(self, first, count, ReadDisabled::new).await
    }

    /// Reads the states of `count` consecutive discretes (44): `true` is on.
    ///
    /// Each 256 are one request, of [one scan](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let relays = station.read_discretes(fatek::discrete!("M0"), 256).await?;
    /// assert_eq!(relays.len(), 256);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_discretes(&self, first: Discrete, count: usize) -> Result<Vec<bool>, Error> {
        any_length::read(self, first, count, ReadDiscretes::new).await
    }

    /// Reads the states of consecutive discretes (44) into `into`: `true` is on.
    ///
    /// As [`read_discretes`](Self::read_discretes), without a new `Vec` for each call. For the
    /// content of `into` after an error, or if the future is dropped, see
    /// [`read_registers_into`](Self::read_registers_into); one request is 256 discretes.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let mut relays = [false; 24];
    /// station.read_discretes_into(fatek::discrete!("M0"), &mut relays).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_discretes_into(&self, first: Discrete, into: &mut [bool]) -> Result<(), Error> {
        any_length::read_into::<_, _, MAX_POINTS>(self, first, into, ReadDiscretes::new).await
    }

    /// Writes the states of consecutive discretes (45): `true` is on.
    ///
    /// Each 256 are [one request](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_discretes(fatek::discrete!("Y0"), &[true, false, false, true]).await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors), and [`Error::PartlyWritten`].
    pub async fn write_discretes(&self, first: Discrete, states: &[bool]) -> Result<(), Error> {
        any_length::write(self, (first, 1), states, |first, states: &[bool]| WriteDiscretes::new(first, states)).await
    }

    /// Reads `count` consecutive registers of 16 bits (46).
    ///
    /// Each 64 are one request, of [one scan](#any-length). Words of discretes count as registers:
    /// `WY24` comes after `WY8`.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let values = station.read_registers(fatek::register!("R12"), 3).await?; // R12, R13, R14
    /// assert_eq!(values.len(), 3);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_registers(&self, first: Register, count: usize) -> Result<Vec<u16>, Error> {
        any_length::read(self, first, count, ReadRegisters::new).await
    }

    /// Reads consecutive registers of 16 bits (46) into `into`.
    ///
    /// As [`read_registers`](Self::read_registers), without a new `Vec` for each call. After a
    /// link's first calls, such a call allocates no memory, unless more than 16 calls are under way
    /// on the link.
    ///
    /// On success all of `into` is filled. Up to 64 registers are filled completely or not at all.
    /// Of more, a part may have been overwritten after an error, or if the future is dropped: the
    /// values of several requests are good only together.
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
    /// Those of [every method](Self#errors);
    /// [`InvalidRequest::Count`](crate::command::InvalidRequest::Count) if `into` is empty.
    pub async fn read_registers_into(&self, first: Register, into: &mut [u16]) -> Result<(), Error> {
        any_length::read_into::<_, _, MAX_UNITS>(self, first, into, ReadRegisters::new).await
    }

    /// Writes consecutive registers of 16 bits (47).
    ///
    /// Each 64 are [one request](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_registers(fatek::register!("WY8"), &[0xAAAA, 0x5555]).await?; // Y8 to Y39
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors), and [`Error::PartlyWritten`].
    pub async fn write_registers(&self, first: Register, values: &[u16]) -> Result<(), Error> {
        self.write_values((first, 1), values).await
    }

    /// Writes consecutive registers of 16 bits, each `unit` of which is one value that no request splits.
    async fn write_values(&self, (first, unit): (Register, usize), values: &[u16]) -> Result<(), Error> {
        any_length::write(self, (first, unit), values, |first, values: &[u16]| WriteRegisters::new(first, values)).await
    }

    /// Reads `count` consecutive registers of 32 bits (46): `DR0`, `DR2`, `DR4` …
    ///
    /// Each 32 are one request, of [one scan](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_registers(fatek::register!("R100"), &[0x9680, 0x0098]).await?; // the low word first
    /// assert_eq!(station.read_registers32(fatek::register32!("DR100"), 1).await?, [10_000_000]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn read_registers32(&self, first: Register32, count: usize) -> Result<Vec<u32>, Error> {
        any_length::read(self, first, count, ReadRegisters::new).await
    }

    /// Writes consecutive registers of 32 bits (47).
    ///
    /// Each 32 are [one request](#any-length).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_registers32(fatek::register32!("DR2"), &[(-500.125_f32).to_bits()]).await?;
    /// assert_eq!(station.read_registers(fatek::register!("R2"), 2).await?, [0x1000, 0xC3FA]);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors), and [`Error::PartlyWritten`].
    pub async fn write_registers32(&self, first: Register32, values: &[u32]) -> Result<(), Error> {
        self.write_values32((first, 1), values).await
    }

    /// Writes consecutive registers of 32 bits, each `unit` of which is one value that no request splits.
    async fn write_values32(&self, (first, unit): (Register32, usize), values: &[u32]) -> Result<(), Error> {
        any_length::write(self, (first, unit), values, |first, values: &[u32]| WriteRegisters::new(first, values)).await
    }

    /// Reads any elements in one request (48), in the order given: up to 64, where one of 32 bits
    /// counts two.
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
    /// Those of [every method](Self#errors).
    pub async fn read_mixed(&self, elements: &[Element]) -> Result<Vec<Value>, Error> {
        self.call(ReadMixed::new(elements)?).await
    }

    /// Writes any elements in one request (49): up to 32, where one of 32 bits counts two.
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
    /// Those of [every method](Self#errors).
    pub async fn write_mixed(&self, items: &[(Element, Value)]) -> Result<(), Error> {
        self.call(WriteMixed::new(items)?).await
    }

    /// Sends data that the PLC must return unchanged (4E): up to 256 characters in the ASCII
    /// framing, bytes in the binary framing.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.loop_back("ABCDEFG").await?;
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors).
    pub async fn loop_back(&self, data: impl Into<Bytes>) -> Result<(), Error> {
        self.call(LoopBack::new(data)?).await
    }

    /// Reads one page of the program (4F); page 0 is the header. ASCII framing only.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// let header = station.read_program_page(0).await?;
    /// assert_eq!(header.to_bytes()[0], b'F');
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// Those of [every method](Self#errors);
    /// [`InvalidRequest::NotInFraming`](crate::command::InvalidRequest::NotInFraming) in the binary
    /// framing.
    pub async fn read_program_page(&self, page: u16) -> Result<ProgramPage, Error> {
        self.call(ReadProgramPage::new(page)).await
    }

    /// Writes one page of the program (50), as read by
    /// [`read_program_page`](Self::read_program_page). ASCII framing only.
    ///
    /// A PLC in RUN may refuse with [`IllegalFormat`](crate::ErrorCode::IllegalFormat): stop it
    /// first.
    ///
    /// # Errors
    /// Those of [every method](Self#errors);
    /// [`InvalidRequest::NotInFraming`](crate::command::InvalidRequest::NotInFraming) in the binary
    /// framing.
    pub async fn write_program_page(&self, page: u16, content: &ProgramPage) -> Result<(), Error> {
        self.call(WriteProgramPage::new(page, content.clone())).await
    }
}
