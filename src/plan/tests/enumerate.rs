//! All requests and plans by plain enumeration, independent of the planner's code for requests.

use std::collections::BTreeSet;

use super::*;
use crate::command::{ReadDiscretes, ReadMixed, ReadRegisters};
use crate::element::{Discrete, Register32};

const BITS: u16 = 16;

/// The smallest elements of a part: discretes, 16-bit elements, and counters of 32 bits.
pub(super) type Smallest = BTreeSet<(Symbol, u16)>;

/// The limits and costs of an enumeration.
pub(super) struct Enumeration<'a> {
    pub(super) limits: &'a Limits,
    pub(super) model: &'a CostModel,
    /// The number of lists that were left out because they are ambiguous in the binary framing.
    pub(super) ambiguous: usize,
}

pub(super) fn smallest(tags: &[Tag]) -> Smallest {
    tags.iter().flat_map(Tag::elements).flat_map(smallest_of).collect()
}

pub(super) fn smallest_of(element: Element) -> Vec<(Symbol, u16)> {
    match element {
        Element::Register32(e) if !element.is_counter_of_32_bits() => {
            let low = e.symbol().halved();
            vec![(low, e.address()), (low, e.address() + low.step())]
        }
        other => vec![(other.symbol(), other.address())],
    }
}

/// The elements of each set of parts; set `n` has the parts of the bits of `n`.
pub(super) fn blocks(parts: &[Smallest]) -> impl Iterator<Item = Smallest> {
    (0..1_usize << parts.len()).map(|set| {
        let members = parts.iter().enumerate().filter(move |(n, _)| set >> n & 1 == 1);
        members.flat_map(|(_, part)| part.iter().copied()).collect()
    })
}

impl Enumeration<'_> {
    /// Returns the cost of the cheapest partition of the parts, without proofs.
    pub(super) fn cheapest(&mut self, parts: &[Smallest]) -> u64 {
        let prices: Vec<Option<u64>> = blocks(parts).map(|block| self.price(&block)).collect();
        partition(parts.len(), 0, &mut Vec::new(), &prices)
    }

    /// Returns the cost of the cheapest request for all of these elements.
    fn price(&mut self, block: &Smallest) -> Option<u64> {
        if block.is_empty() {
            return Some(0);
        }
        self.requests(block).iter().map(|request| self.model.cost(frames(request, self.model.framing()))).min()
    }

    /// Returns all requests for all of these elements.
    pub(super) fn requests(&mut self, block: &Smallest) -> Vec<ReadRequest> {
        let mut requests: Vec<ReadRequest> = Vec::new();
        requests.extend(self.run(block));
        for residue in [0, 8] {
            let words: Option<Smallest> = block.iter().map(|cell| self.in_words(block, *cell, residue)).collect();
            requests.extend(words.and_then(|words| self.run(&words)));
        }
        let is_read_by_words = |cell: &(Symbol, u16)| has_words(cell.0) && self.limits.has_words_of(cell.0);
        let discretes: Vec<(Symbol, u16)> = block.iter().copied().filter(is_read_by_words).collect();
        let mut seen = BTreeSet::new();
        for choice in 0..3_usize.pow(u32::try_from(discretes.len()).unwrap()) {
            let mut items = block.clone();
            let mut rest = choice;
            let mut valid = true;
            for cell in &discretes {
                let word = match rest % 3 {
                    0 => None,
                    n => Some(self.in_words(block, *cell, 8 * (u16::try_from(n).unwrap() - 1))),
                };
                rest /= 3;
                match word {
                    Some(Some(word)) => _ = items.insert(word),
                    Some(None) => valid = false,
                    None => {}
                }
            }
            if valid && seen.insert(items.clone()) {
                requests.extend(self.mixed(items));
            }
        }
        requests
    }

    /// Returns the word that a discrete may be read by; other cells are their own.
    fn in_words(&self, block: &Smallest, (symbol, address): (Symbol, u16), residue: u16) -> Option<(Symbol, u16)> {
        if !has_words(symbol) {
            return Some((symbol, address));
        }
        if !self.limits.has_words_of(symbol) {
            return None;
        }
        let first = address.checked_sub(residue)? / BITS * BITS + residue;
        let word = symbol.area().word();
        // The word of a tag is read in any case.
        let of_tag = block.range((word, address.saturating_sub(BITS - 1))..=(word, address));
        if let Some(cell) = of_tag.into_iter().find(|cell| cell.1 % BITS == residue) {
            return Some(*cell);
        }
        let bits = first..=first.checked_add(BITS - 1)?;
        let segments: BTreeSet<_> = bits.clone().map(|bit| self.limits.segment(symbol, bit)).collect();
        let overlapping = first.saturating_sub(BITS - 1)..=first.saturating_add(BITS - 1);
        let allowed = first <= word.last_address_in(self.model.framing())
            && segments.len() == 1
            && !segments.contains(&None)
            && self.limits.segment(word, first).is_some()
            && !bits.into_iter().any(|bit| self.limits.avoids_any(symbol, bit, bit))
            && !overlapping.into_iter().any(|other| self.limits.avoids_any(word, other, other));
        allowed.then_some((word, first))
    }

    /// Returns the run from the first to the last of these cells, if there is one.
    fn run(&self, cells: &Smallest) -> Option<ReadRequest> {
        let (symbol, first) = *cells.first()?;
        let (_, last) = *cells.last()?;
        let counter = symbol.width() == Width::DWord;
        let step = if counter { 1 } else { symbol.step() };
        let limits = self.limits;
        let fits = |(other, address): &(Symbol, u16)| *other == symbol && (address - first).is_multiple_of(step);
        if !cells.iter().all(fits) || counter && cells.len() > 1 {
            return None;
        }
        let mut count = 0;
        for address in (first..=last).step_by(step.into()) {
            count += 1;
            if limits.segment(symbol, address)? != limits.segment(symbol, first)? || is_counter(symbol, address) {
                return None;
            }
            if cells.contains(&(symbol, address)) {
                continue;
            }
            // A gap.
            let gap = address..=address + (step - 1);
            if gap.clone().any(|address| limits.avoids_any(symbol, address, address)) {
                return None;
            }
            let discrete = symbol.area().smallest();
            if discrete.width() == Width::Bit && symbol.width() == Width::Word {
                let next = cells.range((symbol, address)..).next()?.1;
                let before = cells.range(..(symbol, address)).next_back()?.1 + step;
                let segment = limits.segment(discrete, before)?;
                let mut bits = before..=next - 1;
                if bits
                    .any(|bit| limits.avoids_any(discrete, bit, bit) || limits.segment(discrete, bit) != Some(segment))
                {
                    return None;
                }
            }
        }
        if count > limits.units(symbol.width()) as usize {
            return None;
        }
        let element = Element::new(symbol, first).unwrap();
        Some(match symbol.width() {
            Width::Bit => {
                ReadRequest::Discretes(ReadDiscretes::new(Discrete::try_from(element).unwrap(), count).unwrap())
            }
            Width::Word => {
                ReadRequest::Registers(ReadRegisters::new(Register::try_from(element).unwrap(), count).unwrap())
            }
            Width::DWord => {
                ReadRequest::Registers32(ReadRegisters::new(Register32::try_from(element).unwrap(), count).unwrap())
            }
        })
    }

    /// Returns the mixed read of these cells, the first or the last stretch of neighbours first.
    /// Discretes in one of the words are left out.
    fn mixed(&mut self, mut cells: Smallest) -> Option<ReadRequest> {
        let words: Vec<(Symbol, u16)> = cells.iter().copied().filter(|(s, _)| s.width() == Width::Word).collect();
        cells.retain(|(symbol, address)| {
            let word = |(other, first): &(Symbol, u16)| {
                *other == symbol.area().word() && (*first..=first.saturating_add(BITS - 1)).contains(address)
            };
            !(has_words(*symbol) && words.iter().any(word))
        });
        let units: usize = cells.iter().map(|(symbol, _)| symbol.width().units()).sum();
        if units > self.limits.mixed_units() as usize {
            return None;
        }
        let mut stretches: Vec<Vec<Element>> = Vec::new();
        let mut end = None;
        let key = |cell: &(Symbol, u16)| (cell.0, cell.1 % cell.0.step(), is_past_counters(cell), cell.1);
        let mut sorted: Vec<(Symbol, u16)> = cells.into_iter().collect();
        sorted.sort_by_key(key);
        let mut rest = sorted.as_slice();
        while let [(symbol, address), others @ ..] = rest {
            let pair = others.first().is_some_and(|next| {
                let next_address = address.checked_add(symbol.step());
                next.0 == *symbol
                    && Some(next.1) == next_address
                    && symbol.width() == Width::Word
                    && self.limits.segment(*symbol, next.1) == self.limits.segment(*symbol, *address)
            });
            let segment = self.limits.segment(*symbol, *address);
            let begin = (*symbol, Some(*address), segment, is_past_counters(&(*symbol, *address)));
            if end != Some(begin) {
                stretches.push(Vec::new());
            }
            let last = if pair { others[0].1 } else { *address };
            end = Some((*symbol, last.checked_add(symbol.step()), segment, begin.3));
            let (symbol, others) = if pair { (symbol.area().dword(), &others[1..]) } else { (*symbol, others) };
            stretches.last_mut().unwrap().push(Element::new(symbol, *address).unwrap());
            rest = others;
        }
        let reversed = stretches.iter().rev().cloned().collect::<Vec<_>>();
        let requests = [stretches, reversed].map(|list| ReadRequest::Mixed(ReadMixed::new(list.concat()).unwrap()));
        let request = requests.into_iter().find(|request| request.check(self.model.framing()).is_ok());
        self.ambiguous += usize::from(request.is_none());
        request
    }
}

fn partition(parts: usize, part: usize, blocks: &mut Vec<usize>, prices: &[Option<u64>]) -> u64 {
    if part == parts {
        return blocks.iter().map(|block| prices[*block]).sum::<Option<u64>>().unwrap_or(u64::MAX);
    }
    let mut best = u64::MAX;
    for n in 0..blocks.len() {
        blocks[n] |= 1 << part;
        best = best.min(partition(parts, part + 1, blocks, prices));
        blocks[n] &= !(1 << part);
    }
    blocks.push(1 << part);
    best = best.min(partition(parts, part + 1, blocks, prices));
    blocks.pop();
    best
}

fn has_words(symbol: Symbol) -> bool {
    matches!(symbol, Symbol::X | Symbol::Y | Symbol::M | Symbol::S)
}

fn is_counter(symbol: Symbol, address: u16) -> bool {
    symbol == Symbol::RC && (200..256).contains(&address)
}

fn is_past_counters(cell: &(Symbol, u16)) -> bool {
    cell.0 == Symbol::RC && cell.1 > 255
}
