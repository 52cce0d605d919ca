//! The capabilities of a station that a link knows: declared, and learned from refusals.

use std::time::Duration;

use tokio::time::Instant;

use super::{Capabilities, Support, WordSupport};
use crate::command::Code;
use crate::element::Symbol;
use crate::plan::WordAreas;

/// The lifetime of what is learned from a refusal. Then it is tried again: the cause may have passed.
pub(crate) const LEARNED_LIFETIME: Duration = Duration::from_secs(600);

/// A conclusion from a refused request whose values were read by others. Lengths are the longest ones that
/// are not refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Refused {
    /// Words of the discretes of these areas are refused.
    Words(WordAreas),
    /// Mixed reads are refused.
    MixedReads,
    /// Mixed writes are refused.
    MixedWrites,
    /// Longer runs of registers are refused.
    Registers(usize),
    /// Longer runs of discretes are refused.
    Points(usize),
    /// Mixed reads of more units are refused.
    Mixed(usize),
}

/// The capabilities of a station, declared and learned.
#[derive(Debug, Default)]
pub(crate) struct KnownCapabilities {
    declared: Capabilities,
    /// Each once, with the time when it was learned last.
    learned: Vec<(Refused, Instant)>,
}

impl KnownCapabilities {
    pub(crate) fn declared(&self) -> &Capabilities {
        &self.declared
    }

    /// Replaces all by these.
    pub(crate) fn declare(&mut self, capabilities: Capabilities) {
        *self = Self { declared: capabilities, learned: Vec::new() };
    }

    pub(crate) fn learn(&mut self, learned: Refused, now: Instant) {
        // Lengths differ, and a station may be in use for years.
        self.learned.retain(|(known, at)| *known != learned && is_recent(*at, now));
        self.learned.push((learned, now));
    }

    /// The capabilities as of now.
    pub(crate) fn get(&self, now: Instant) -> Capabilities {
        let recent = self.learned.iter().filter(|(_, at)| is_recent(*at, now));
        let lower = |known: Option<usize>, learned: usize| known.map_or(learned, |known| known.min(learned));
        recent.fold(self.declared.clone(), |known, (learned, _)| match *learned {
            // Of several lengths, the shortest counts. A length out of range has no effect.
            Refused::Registers(max) => {
                known.clone().with_max_registers(lower(known.max_registers(), max)).unwrap_or(known)
            }
            Refused::Points(max) => known.clone().with_max_points(lower(known.max_points(), max)).unwrap_or(known),
            Refused::Mixed(max) => known.clone().with_max_mixed(lower(known.max_mixed(), max)).unwrap_or(known),
            Refused::MixedReads => known.with_command(Code::ReadMixed, Support::Refused),
            Refused::MixedWrites => known.with_command(Code::WriteMixed, Support::Refused),
            Refused::Words(areas) => {
                let refused = |known: Capabilities, symbol: &Symbol| {
                    known.clone().with_words_of(*symbol, WordSupport::Refused).unwrap_or(known)
                };
                WordAreas::SYMBOLS.iter().filter(|symbol| areas.contains(**symbol)).fold(known, refused)
            }
        })
    }
}

/// Returns whether what was learned at this time still holds.
fn is_recent(learned: Instant, now: Instant) -> bool {
    now.saturating_duration_since(learned) < LEARNED_LIFETIME
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expired_refusals_are_dropped() {
        let (start, mut known) = (Instant::now(), KnownCapabilities::default());
        for n in 0..100 {
            let now = start + LEARNED_LIFETIME / 4 * n;
            known.learn(Refused::Registers(2 + n as usize % 60), now);
            known.learn(Refused::MixedReads, now);
            assert!(known.learned.len() <= 5, "{}", known.learned.len());
        }
        let now = start + LEARNED_LIFETIME / 4 * 99;
        assert_eq!(known.get(now).max_registers(), Some(2 + 36));
        assert_eq!(known.get(now + LEARNED_LIFETIME), Capabilities::new());
    }
}
