//! Random tags, a random PLC and random trouble. `FATEK_POLL_SEED=n` replays one seed, `FATEK_POLL_SEEDS=n` runs more.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::lab::{Lab, cells, ms, value};
use crate::element::{Element, Symbol};
use crate::poll::{PollTag, Quality, Reason, Sample, ScanClass, TagId};
use crate::random::Random;
use crate::tag::{Scale, Tag, TagType};

struct Dice(Random);

impl Dice {
    fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.0.next() % n as u64).unwrap()
    }

    fn one<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.below(of.len())]
    }

    fn cell(&mut self) -> (Symbol, u16) {
        let symbol = self.one(&[Symbol::R, Symbol::R, Symbol::R, Symbol::D, Symbol::M, Symbol::WM, Symbol::RT]);
        let address = match self.below(3) {
            0 => self.below(20),
            1 => self.below(150),
            _ => 100 * self.below(8),
        };
        let address = address / usize::from(symbol.step()) * usize::from(symbol.step());
        (symbol, u16::try_from(address).unwrap())
    }

    fn tag(&mut self) -> Tag {
        let (symbol, address) = self.cell();
        let wide = match symbol {
            Symbol::R => Symbol::DR,
            Symbol::D => Symbol::DD,
            Symbol::WM => Symbol::DWM,
            other => other,
        };
        let symbol = if self.below(5) == 0 { wide } else { symbol };
        let first = Element::new(symbol, address).unwrap();
        if symbol == Symbol::D && self.below(4) == 0 {
            return Tag::new(first, TagType::U16, 1).unwrap().scaled(Scale::new(0.1, -40.0).unwrap()).unwrap();
        }
        if symbol == Symbol::R && self.below(8) == 0 {
            return Tag::spanning(first, TagType::Text, 1 + self.below(9)).unwrap();
        }
        let float = matches!(symbol, Symbol::R | Symbol::D) && self.below(4) == 0;
        let count = if self.below(6) == 0 { 1 + self.below(90) } else { 1 };
        let tag_type = if float { TagType::F32 } else { TagType::default_for(first.width()) };
        Tag::new(first, tag_type, count.min(if symbol == Symbol::WM || wide == symbol { 5 } else { 90 })).unwrap()
    }
}

struct Trial {
    lab: Lab,
    dice: Dice,
    tags: BTreeMap<TagId, Tag>,
    groups: Vec<Vec<TagId>>,
    classes: Vec<ScanClass>,
    removed: BTreeSet<TagId>,
}

impl Trial {
    fn new(seed: u64) -> Self {
        let mut dice = Dice(Random::new(seed));
        let mut lab = Lab::new(seed);
        for _ in 0..dice.below(6) {
            lab.plc.refused.insert(dice.cell());
        }
        lab.plc.one_shape = dice.below(2) == 0;
        lab.plc.mixed = dice.below(3) > 0;
        lab.plc.max_registers = dice.one(&[64, 64, 32, 10]);
        lab.plc.max_points = dice.one(&[256, 256, 16]);
        let class =
            |dice: &mut Dice| ScanClass::every(ms(dice.one(&[200, 1000]))).probe_refused(ms(dice.one(&[2000, 10_000])));
        let classes = (0..1 + dice.below(3)).map(|_| class(&mut dice)).collect();
        Self { lab, dice, tags: BTreeMap::new(), groups: Vec::new(), classes, removed: BTreeSet::new() }
    }

    fn add(&mut self, count: usize) {
        for _ in 0..count {
            let class = self.dice.one(&self.classes);
            let together = if self.dice.below(10) == 0 { 1 + self.dice.below(3) } else { 1 };
            let tags: Vec<Tag> = (0..together).map(|_| self.dice.tag()).collect();
            let report = self.dice.below(4);
            let polled = tags.iter().map(|tag| match report {
                0 => PollTag::from(*tag).on_change(),
                1 => PollTag::from(*tag).heartbeat(ms(700)),
                _ => PollTag::from(*tag),
            });
            // A group that is too much for one request is refused, and that is that.
            let Ok(ids) = self.lab.try_add(class, polled.collect(), together > 1) else { continue };
            self.tags.extend(ids.iter().copied().zip(tags));
            if together > 1 {
                self.groups.push(ids);
            }
        }
    }

    fn trouble(&mut self) {
        match self.dice.below(9) {
            0 => self.lab.plc.silent = true,
            1 => self.lab.plc.refuses_all = true,
            // A frame comes that no request takes.
            8 => self.lab.plc.left_over = true,
            2 => self.lab.plc.latency = ms(self.dice.one(&[1, 5, 40, 400])),
            3 => {
                let cell = self.dice.cell();
                self.lab.plc.silent_about = Some(cell);
            }
            4 => self.add(3),
            5 | 6 => {
                let ids: Vec<TagId> = self.tags.keys().copied().collect();
                if !ids.is_empty() {
                    let id = self.dice.one(&ids);
                    assert!(self.lab.device.remove(id, self.lab.now));
                    self.tags.remove(&id);
                    self.removed.insert(id);
                }
            }
            _ => {
                let cell = self.dice.cell();
                self.lab.plc.refused.insert(cell);
            }
        }
    }

    fn peace(&mut self) {
        self.lab.plc.silent = false;
        self.lab.plc.refuses_all = false;
        self.lab.plc.silent_about = None;
        self.lab.plc.latency = ms(1);
    }

    /// What must hold of every sample, whatever happens.
    fn check_samples(&mut self) {
        for sample in self.lab.news() {
            assert!(!self.removed.contains(&sample.id), "a sample of a tag that was removed: {sample:?}");
            let tag = self.tags[&sample.id];
            match sample.quality {
                Quality::Good | Quality::Stale(_) => self.check_values(&sample, tag),
                Quality::Bad(_) => assert!(sample.values().is_empty(), "{sample:?}"),
            }
        }
    }

    /// The values are what the PLC held when it answered, from the first of its replies on.
    fn check_values(&self, sample: &Sample, tag: Tag) {
        let first = *self.lab.plc.epochs.get(&sample.at.instant).unwrap_or_else(|| panic!("no reply then: {sample:?}"));
        let last = self.lab.plc.epochs.last_key_value().map_or(first, |(_, epoch)| *epoch);
        assert_eq!(sample.values().len(), tag.value_count());
        for (n, (got, single)) in sample.values().iter().zip(tag.singles()).enumerate() {
            let held = |epoch: u64| {
                let raw: Vec<_> = single.elements().map(|element| value(epoch, element)).collect();
                single.decode(&raw).unwrap()[0].to_string() == got.to_string()
            };
            // A tag of one value has one reply.
            let last = if tag.value_count() == 1 { first } else { last };
            assert!(
                (first..=last).any(held),
                "value {n} of {tag} is {got}, which the PLC did not hold from {first} on: {sample:?}"
            );
        }
    }

    /// What must hold when there has been peace for long.
    fn check_peace(&mut self) {
        let plc = &self.lab.plc;
        let limited = !plc.mixed || plc.max_registers < 64 || plc.max_points < 256;
        let longest = self.classes.iter().map(ScanClass::period).max().unwrap();
        for (id, tag) in &self.tags {
            let sample = self.lab.latest(*id);
            let group = self.groups.iter().find(|group| group.contains(id));
            let refused = match group {
                None => self.lab.plc.refuses(*tag),
                Some(group) => group.iter().filter_map(|id| self.tags.get(id)).any(|tag| self.lab.plc.refuses(*tag)),
            };
            match &sample.quality {
                Quality::Good => {
                    assert!(!refused, "{tag} is good, and the PLC refuses it");
                    let age = self.lab.now - sample.at.instant;
                    assert!(age <= longest + ms(1000), "{tag} is {age:?} old");
                }
                Quality::Bad(Reason::Refused(_)) if refused => {}
                // What must come from one request may be more than the device takes in one.
                Quality::Bad(Reason::Refused(_)) if (group.is_some() || tag.tag_type().is_text()) && limited => {}
                other => panic!("{tag} is {other}, refused: {refused}"),
            }
        }
    }
}

fn run(seed: u64) {
    let mut trial = Trial::new(seed);
    let count = 1 + trial.dice.below(60);
    trial.add(count);
    for _ in 0..1 + trial.dice.below(4) {
        for _ in 0..trial.dice.below(4) {
            trial.trouble();
        }
        let duration = ms(100 + trial.dice.below(3000) as u64);
        trial.lab.run(duration);
        trial.check_samples();
        if trial.dice.below(2) == 0 {
            trial.peace();
        }
    }
    trial.peace();
    trial.lab.run(Duration::from_secs(25));
    trial.check_samples();
    trial.check_peace();
    // What was learned in trouble is forgotten.
    trial.lab.now += Duration::from_secs(600);
    trial.lab.run(Duration::from_secs(30));
    trial.check_samples();
    trial.check_peace();
}

#[test]
fn samples_are_true_and_peace_brings_all_back() {
    let number = |name| std::env::var(name).ok().and_then(|text: String| text.parse::<u64>().ok());
    if let Some(seed) = number("FATEK_POLL_SEED") {
        return run(seed);
    }
    for seed in 0..number("FATEK_POLL_SEEDS").unwrap_or(30) {
        let result = std::panic::catch_unwind(|| run(seed));
        assert!(result.is_ok(), "FATEK_POLL_SEED={seed} replays it");
    }
}

#[test]
fn the_fake_plc_tells_one_memory_from_the_next() {
    let element = Element::new(Symbol::R, 7).unwrap();
    assert_eq!(cells(element), [(Symbol::R, 7)]);
    assert_ne!(value(1, element), value(2, element));
}
