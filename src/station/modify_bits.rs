//! Changes of bits of a register: a read, and a write of the whole register.
//!
//! Invariants:
//! - Nothing is written unless the read was good, within the deadline of the call.
//! - Calls for one station over one link take turns, from the read to the end of the write.

use tokio::runtime::Handle;
use tokio::time::{Instant, timeout_at};

use super::Station;
use crate::command::Code;
use crate::element::{Element, Value};
use crate::error::{Error, Seen};
use crate::link::later;
use crate::tag::{IntoTag, TagAccessError};

impl Station {
    /// Changes bits of a register, such as `R5.3` or `R5.0-R5.7`: reads it, changes these bits, and
    /// writes it.
    ///
    /// The protocol writes whole registers only. Calls of `modify_bits` for a station over one
    /// [`Link`](crate::Link) take turns. A change of the other bits between the read and the write by
    /// anything else is undone: the program of the PLC, another master, another link, or another write
    /// of the same program such as [`write`](Self::write). So `write` refuses these tags. A discrete, also
    /// a bit of a word of discretes such as `WM16.3`, has no such trouble, and is written by `write`.
    ///
    /// If the bits are as they should be, nothing is written. The deadline of a call covers the wait
    /// for its turn, the read and the write.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write("R5", 0x00F0).await?;
    /// station.modify_bits("R5.0-R5.3", [true, false, true, true]).await?;
    /// assert_eq!(station.read::<u16, _>("R5").await?, 0x00FD);
    /// assert!(station.read::<bool, _>("R5.2").await?);
    ///
    /// let error = station.write("R5.2", false).await.unwrap_err();
    /// assert!(error.to_string().starts_with("R5.2 is a part of R5, and a write replaces all bits of R5"));
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`Error::Tag`] for a text that is not a tag, a tag that is no bits of a register, or another
    /// number of states than bits. [`Error::ReadBeforeWrite`] if the read failed, or its turn did not
    /// come: nothing was written. Those of [every method](Self#errors) for the write.
    ///
    /// Cancel safety: as of [every method](Self#cancel-safety).
    pub async fn modify_bits(&self, tag: impl IntoTag, states: impl AsRef<[bool]>) -> Result<(), Error> {
        let (tag, states) = (tag.into_tag()?, states.as_ref());
        if !tag.is_bits_of_register() {
            return Err(TagAccessError::NotBitsOfRegister { tag }.into());
        }
        if states.len() != tag.value_count() {
            return Err(TagAccessError::misfit_of(&tag, states.len()).into());
        }
        let began = Instant::now();
        let deadline = later(began, self.options().call_timeout());
        let turns = self.link().turns_to_modify(self.number());
        // Without a runtime there is no timer, and the calls below fail.
        let turn = match turns.try_lock() {
            Ok(turn) => Some(turn),
            Err(_) if Handle::try_current().is_err() => Some(turns.lock().await),
            Err(_) => timeout_at(deadline, turns.lock()).await.ok(),
        };
        let Some(_turn) = turn else {
            let (station, after) = (self.number(), began.elapsed());
            let code = Code::ReadRegisters;
            let seen = Seen::default();
            let waited = Error::Timeout { station, code, after, sent: false, attempts: 0, checked: false, seen };
            return Err(Error::ReadBeforeWrite { source: waited.into() });
        };
        // A new handle for each request, since its deadline is the rest of that of the call.
        let rest = || {
            let left = deadline.saturating_duration_since(Instant::now());
            self.with_options(self.options().with_call_timeout(left))
        };
        let not_read = |error: Error| Error::ReadBeforeWrite { source: error.into() };
        let modified = |register: Value| {
            let modified = tag.modified(register, states);
            debug_assert!(modified.is_some(), "number and kind of the bits were checked");
            modified.filter(|&modified| modified != register)
        };
        match tag.first() {
            Element::Register(register) => {
                let now = rest().read_registers(register, 1).await.map_err(not_read)?;
                match now.first().and_then(|&now| modified(now.into())) {
                    Some(Value::Word(word)) => rest().write_registers(register, &[word]).await,
                    Some(Value::Bit(_) | Value::DWord(_)) | None => Ok(()),
                }
            }
            Element::Register32(register) => {
                let now = rest().read_registers32(register, 1).await.map_err(not_read)?;
                match now.first().and_then(|&now| modified(now.into())) {
                    Some(Value::DWord(double)) => rest().write_registers32(register, &[double]).await,
                    Some(Value::Bit(_) | Value::Word(_)) | None => Ok(()),
                }
            }
            Element::Discrete(_) => Err(TagAccessError::NotBitsOfRegister { tag }.into()),
        }
    }
}
