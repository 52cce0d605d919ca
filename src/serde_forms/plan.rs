//! Limits of a PLC, and the cost of requests.

use std::convert::Infallible;
use std::fmt;

use serde::de::{self, Visitor};
use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::{DurationText, check_kept, through_forms};
use crate::element::{Element, Symbol, Width};
use crate::plan::{CostModel, Limits, WordAreas};
use crate::wire::Framing;

through_forms! {
    CostModel => CostModelForm;
    Limits => LimitsForm;
}

/// The form of [`CostModel`].
#[derive(Serialize, Deserialize)]
#[serde(rename = "CostModel", deny_unknown_fields)]
struct CostModelForm {
    framing: Framing,
    response_time: DurationText,
    #[serde(default)]
    byte_time: Option<DurationText>,
    #[serde(default)]
    frame_gap: Option<DurationText>,
    #[serde(default)]
    overhead: Option<DurationText>,
    #[serde(default)]
    proofs: Option<bool>,
}

impl CostModelForm {
    fn of(cost: &CostModel) -> Result<Self, Infallible> {
        Ok(Self {
            framing: cost.framing(),
            response_time: DurationText(cost.response_time()),
            byte_time: Some(DurationText(cost.byte_time())),
            frame_gap: Some(DurationText(cost.frame_gap())),
            overhead: Some(DurationText(cost.overhead())),
            proofs: Some(cost.proofs()),
        })
    }

    fn make(self) -> Result<CostModel, String> {
        let response_time = self.response_time;
        let mut cost = CostModel::network(self.framing, response_time.0).with_response_time(response_time.0);
        check_kept("response_time", response_time, DurationText(cost.response_time()))?;
        if let Some(time) = self.byte_time {
            cost = cost.with_byte_time(time.0);
            check_kept("byte_time", time, DurationText(cost.byte_time()))?;
        }
        if let Some(time) = self.frame_gap {
            cost = cost.with_frame_gap(time.0);
            check_kept("frame_gap", time, DurationText(cost.frame_gap()))?;
        }
        if let Some(time) = self.overhead {
            cost = cost.with_overhead(time.0);
            check_kept("overhead", time, DurationText(cost.overhead()))?;
        }
        if let Some(proofs) = self.proofs {
            cost = cost.with_proofs(proofs);
        }
        Ok(cost)
    }
}

/// The form of [`Limits`]. Split points are left out: only the poller learns them, for itself.
#[derive(Serialize, Deserialize)]
#[serde(rename = "Limits", deny_unknown_fields, default)]
struct LimitsForm {
    max_registers: usize,
    max_points: usize,
    mixed_reads: bool,
    /// `None` without mixed reads; else the default is the limit of the protocol.
    max_mixed: Option<usize>,
    /// The areas whose discretes are read as words.
    words_of_discretes: Vec<Symbol>,
    words_at_multiples_of_16: bool,
    readable: Vec<RangeText>,
    avoid: Vec<RangeText>,
}

impl LimitsForm {
    fn of(limits: &Limits) -> Result<Self, Infallible> {
        Ok(Self::with(limits))
    }

    fn with(limits: &Limits) -> Self {
        let [max_registers, max_points, max_mixed] = limits.maxima();
        let texts = |cells: Vec<(Symbol, u16, u16)>| cells.into_iter().flat_map(RangeText::of).collect();
        let [readable, avoid] = limits.ranges().map(texts);
        let mixed_reads = max_mixed > 0;
        let max_mixed = mixed_reads.then_some(max_mixed);
        let (areas, words_at_multiples_of_16) = limits.words();
        let words_of_discretes = WordAreas::SYMBOLS.into_iter().filter(|symbol| areas.contains(*symbol)).collect();
        Self {
            max_registers,
            max_points,
            mixed_reads,
            max_mixed,
            words_of_discretes,
            words_at_multiples_of_16,
            readable,
            avoid,
        }
    }

    fn make(self) -> Result<Limits, String> {
        let rule = |error: crate::plan::PlanError| error.to_string();
        let mut limits =
            Limits::new().max_registers(self.max_registers).and_then(|limits| limits.max_points(self.max_points));
        limits = match (self.mixed_reads, self.max_mixed) {
            (true, Some(units)) => limits.and_then(|limits| limits.max_mixed(units)),
            (mixed_reads, None) => limits.map(|limits| limits.mixed_reads(mixed_reads)),
            (false, Some(units)) => {
                return Err(format!("`max_mixed` is {units}, and `mixed_reads` is false: one of them is wrong"));
            }
        };
        let mut areas = WordAreas::default();
        for symbol in self.words_of_discretes {
            let area = WordAreas::of(symbol);
            if area.is_empty() {
                return Err(rule(crate::plan::PlanError::NoWords { symbol }));
            }
            areas = areas.and(area);
        }
        let mut limits = limits
            .map_err(rule)?
            .without_words(WordAreas::all().without(areas))
            .words_at_multiples_of_16(self.words_at_multiples_of_16);
        for RangeText { first, last } in self.readable {
            limits = limits.readable(first, last).map_err(rule)?;
        }
        for RangeText { first, last } in self.avoid {
            limits = limits.avoid(first, last).map_err(rule)?;
        }
        Ok(limits)
    }
}

impl Default for LimitsForm {
    fn default() -> Self {
        let usual = Self::with(&Limits::new());
        // The default maximum of a mixed read follows from `mixed_reads`.
        Self { max_mixed: None, ..usual }
    }
}

/// A range of elements as text: `R0-R3839`, or `R5` alone.
#[derive(Clone, Copy)]
struct RangeText {
    first: Element,
    last: Element,
}

impl RangeText {
    /// The ranges of these addresses. Counters of 32 bits among those of 16 bits are a range of
    /// their own.
    fn of((symbol, first, last): (Symbol, u16, u16)) -> impl Iterator<Item = Self> {
        let [counter, last_counter] = symbol.counters();
        let is_split = symbol.width() == Width::Word && counter <= last_counter;
        let parts = if is_split {
            [
                (symbol, first, counter.checked_sub(1).map(|end| end.min(last))),
                (symbol.area().dword(), first.max(counter), Some(last.min(last_counter))),
                (symbol, first.max(last_counter.saturating_add(1)), Some(last)),
            ]
        } else {
            [(symbol, first, Some(last)), (symbol, first, None), (symbol, first, None)]
        };
        parts.into_iter().filter_map(|(symbol, first, last)| {
            let last = last.filter(|&last| first <= last)?;
            Some(Self { first: Element::new(symbol, first).ok()?, last: Element::new(symbol, last).ok()? })
        })
    }
}

impl Serialize for RangeText {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if self.first == self.last {
            serializer.collect_str(&self.first)
        } else {
            serializer.collect_str(&format_args!("{}-{}", self.first, self.last))
        }
    }
}

impl<'de> Deserialize<'de> for RangeText {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Text;

        impl Visitor<'_> for Text {
            type Value = RangeText;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("a range of elements, such as \"R0-R3839\"")
            }

            fn visit_str<E: de::Error>(self, text: &str) -> Result<RangeText, E> {
                let (first, last) = text.split_once('-').unwrap_or((text, text));
                Ok(RangeText { first: first.parse().map_err(E::custom)?, last: last.parse().map_err(E::custom)? })
            }
        }

        deserializer.deserialize_str(Text)
    }
}
