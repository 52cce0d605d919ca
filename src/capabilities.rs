//! Capabilities of a station: commands and limits of a PLC, or of the device in front of it.
//!
//! The protocol documents one list of commands and limits. Gateways and servers of other makers support
//! less: some answer error 4 to 42, 48, 4E and 53, some have shorter requests or no words of discretes.
//! [`Station::probe`] finds out, by reading only; [`Station::set_capabilities`] declares what is known; and
//! a link learns from refusals. Plans, limits and the checks between requests take them from there:
//!
//! ```
//! # fatek::sim::doctest(|station| async move {
//! use fatek::capabilities::Support;
//! use fatek::command::Code;
//!
//! let found = station.probe().await?;
//! assert_eq!(found.command(Code::ReadMixed), Support::Supported);
//! assert_eq!(found.max_registers(), Some(64));
//! // Kept, such as in a file by the feature `serde`, they save the probe of the next process.
//! station.set_capabilities(found);
//! # Ok(()) });
//! ```
//!
//! Source: protocol reference, section 7 (field facts).
//!
//! [`Station::probe`]: crate::Station::probe
//! [`Station::set_capabilities`]: crate::Station::set_capabilities

mod known;
mod probe;

use std::fmt;
use std::time::Duration;

pub(crate) use self::known::{KnownCapabilities, LEARNED_LIFETIME, Refused};
use crate::command::{Code, CommandSet, RequestLengths};
use crate::element::Symbol;
use crate::link::{Declared, LongestReads};
use crate::plan::{Limits, PlanError, WordAreas, check_range};

/// The capabilities of a station: commands, lengths and timing. By default, none is known, and the limits of
/// the protocol hold.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub struct Capabilities {
    /// A command is in one of the three sets at most.
    supported: CommandSet,
    refused: CommandSet,
    unanswered: CommandSet,
    /// By the order of [`WordAreas::SYMBOLS`].
    words: [WordSupport; 4],
    max_registers: Option<usize>,
    max_points: Option<usize>,
    max_mixed: Option<usize>,
    counter_step: Option<u8>,
    answers_broadcasts: Option<bool>,
    response_time: Option<Duration>,
}

/// Support of a command.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Support {
    /// Not known: it is used, and a refusal is handled.
    #[default]
    Unknown,
    /// The command is executed.
    Supported,
    /// The command is refused with an error code.
    Refused,
    /// The command is not answered, though others are.
    Unanswered,
}

/// Support of words of discretes, such as `WM8`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum WordSupport {
    /// Not known: they are used at multiples of 8, and a refusal is handled.
    #[default]
    Unknown,
    /// At addresses that are multiples of 8, as the manuals say.
    MultiplesOf8,
    /// At addresses that are multiples of 16.
    MultiplesOf16,
    /// They are refused or not answered.
    Refused,
}

impl Capabilities {
    /// Nothing is known.
    #[must_use]
    pub fn new() -> Self {
        Self::default()
    }

    /// Returns the support of a command.
    #[must_use]
    pub fn command(&self, code: Code) -> Support {
        if self.supported.contains(code) {
            Support::Supported
        } else if self.refused.contains(code) {
            Support::Refused
        } else if self.unanswered.contains(code) {
            Support::Unanswered
        } else {
            Support::Unknown
        }
    }

    /// Sets the support of a command.
    ///
    /// A link does without mixed reads and writes (48, 49) that are refused or unanswered, where it would
    /// use them by itself. If the loop-back (4E) is unanswered, the status (40 or 53) takes its place: a
    /// station that answers none of the three cannot be used. A call of such a command is sent all the same.
    #[must_use]
    pub fn with_command(mut self, code: Code, support: Support) -> Self {
        for set in [&mut self.supported, &mut self.refused, &mut self.unanswered] {
            set.remove(code);
        }
        match support {
            Support::Unknown => {}
            Support::Supported => self.supported.insert(code),
            Support::Refused => self.refused.insert(code),
            Support::Unanswered => self.unanswered.insert(code),
        }
        self
    }

    /// Returns the support of words of the discretes with this symbol: X, Y, M or S. Unknown for others.
    #[must_use]
    pub fn words_of(&self, discrete: Symbol) -> WordSupport {
        let places = WordAreas::SYMBOLS.iter().zip(&self.words);
        let mut of_symbol = places.filter(|(symbol, _)| **symbol == discrete).map(|(_, support)| *support);
        of_symbol.next().unwrap_or(WordSupport::Unknown)
    }

    /// Sets the support of words of the discretes with this symbol: X, Y, M or S.
    ///
    /// # Errors
    /// [`PlanError::NoWords`] for another symbol: plans do not read its discretes as words.
    pub fn with_words_of(mut self, discrete: Symbol, support: WordSupport) -> Result<Self, PlanError> {
        let at = WordAreas::SYMBOLS.iter().position(|symbol| *symbol == discrete);
        match at.and_then(|at| self.words.get_mut(at)) {
            Some(words) => *words = support,
            None => return Err(PlanError::NoWords { symbol: discrete }),
        }
        Ok(self)
    }

    /// Returns the maximum of 16-bit registers in one request 46 or 47; `None` if it is not known.
    #[must_use]
    pub fn max_registers(&self) -> Option<usize> {
        self.max_registers
    }

    /// Sets the maximum of 16-bit registers in one request 46 or 47, where 32 bits count two.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 2 to 64.
    pub fn with_max_registers(self, units: usize) -> Result<Self, PlanError> {
        Limits::new().max_registers(units)?;
        Ok(Self { max_registers: Some(units), ..self })
    }

    /// Returns the maximum of discretes in one request 44 or 45; `None` if it is not known.
    #[must_use]
    pub fn max_points(&self) -> Option<usize> {
        self.max_points
    }

    /// Sets the maximum of discretes in one request 44 or 45.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 to 256.
    pub fn with_max_points(self, points: usize) -> Result<Self, PlanError> {
        Limits::new().max_points(points)?;
        Ok(Self { max_points: Some(points), ..self })
    }

    /// Returns the maximum of units in one request 48; `None` if it is not known.
    #[must_use]
    pub fn max_mixed(&self) -> Option<usize> {
        self.max_mixed
    }

    /// Sets the maximum of units in one request 48, where 32 bits count two.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 to 64.
    pub fn with_max_mixed(self, units: usize) -> Result<Self, PlanError> {
        Limits::new().max_mixed(units)?;
        Ok(Self { max_mixed: Some(units), ..self })
    }

    /// Returns the distance between two counters of 32 bits in a run: 1 for `DRC200 DRC201`, 2 for `DRC200
    /// DRC202`; `None` if it is not known.
    ///
    /// For information: this crate reads and writes these counters one by one.
    #[must_use]
    pub fn counter_step(&self) -> Option<u8> {
        self.counter_step
    }

    /// Sets the distance between two counters of 32 bits in a run.
    ///
    /// # Errors
    /// [`PlanError::Limit`] unless it is 1 or 2.
    pub fn with_counter_step(self, step: u8) -> Result<Self, PlanError> {
        check_range("counter_step", step.into(), 1, 2)?;
        Ok(Self { counter_step: Some(step), ..self })
    }

    /// Returns whether it answers broadcasts; `None` if it is not known. A slave should not.
    #[must_use]
    pub fn answers_broadcasts(&self) -> Option<bool> {
        self.answers_broadcasts
    }

    /// Sets whether it answers broadcasts.
    #[must_use]
    pub fn with_answers_broadcasts(self, answers: bool) -> Self {
        Self { answers_broadcasts: Some(answers), ..self }
    }

    /// Returns the time from the end of a short request to the beginning of its reply; `None` if it is not
    /// known.
    #[must_use]
    pub fn response_time(&self) -> Option<Duration> {
        self.response_time
    }

    /// Sets the time from the end of a short request to the beginning of its reply. Plans count it.
    #[must_use]
    pub fn with_response_time(self, time: Duration) -> Self {
        Self { response_time: Some(time), ..self }
    }

    /// Returns whether this command is not to be used.
    pub(crate) fn lacks(&self, code: Code) -> bool {
        self.refused.and(self.unanswered).contains(code)
    }

    /// The longest requests for consecutive elements.
    pub(crate) fn request_lengths(&self) -> RequestLengths {
        RequestLengths::PROTOCOL.within(self.max_points, self.max_registers)
    }

    /// The part of them that a link applies to its own requests.
    pub(crate) fn declared(&self) -> Declared {
        let most = |units: Option<usize>| units.and_then(|units| u16::try_from(units).ok()).unwrap_or(u16::MAX);
        let longest = LongestReads {
            registers: most(self.max_registers),
            points: most(self.max_points),
            mixed: most(self.max_mixed),
        };
        Declared { refused: self.refused, unanswered: self.unanswered, longest }
    }

    /// The areas whose discretes are not read as words.
    pub(crate) fn refused_words(&self) -> WordAreas {
        let refused = WordAreas::SYMBOLS.iter().zip(self.words).filter(|(_, words)| *words == WordSupport::Refused);
        refused.fold(WordAreas::default(), |areas, (symbol, _)| areas.and(WordAreas::of(*symbol)))
    }

    /// Returns whether words of discretes are read at multiples of 16 only.
    pub(crate) fn has_words_at_16(&self) -> bool {
        self.words.contains(&WordSupport::MultiplesOf16)
    }
}

impl fmt::Display for Support {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Unknown => "unknown",
            Self::Supported => "supported",
            Self::Refused => "refused",
            Self::Unanswered => "unanswered",
        })
    }
}

impl fmt::Display for WordSupport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Unknown => "unknown",
            Self::MultiplesOf8 => "multiples_of_8",
            Self::MultiplesOf16 => "multiples_of_16",
            Self::Refused => "refused",
        })
    }
}
