//! Random tags, a random PLC and random faults.
//!
//! `FATEK_POLL_SEED=n` replays one seed, `FATEK_POLL_SEEDS=n` sets the number of seeds.

use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

use super::rig::{TestRig, cells, ms, value};
use crate::element::{Element, Symbol};
use crate::plan::{CostModel, Limits, Plan};
use crate::poll::{PollTag, Quality, Reason, Sample, ScanClass, TagId};
use crate::random::Random;
use crate::tag::{Scale, Tag, TagType};
use crate::wire::Framing;

struct TestRandom(Random);

impl TestRandom {
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

struct RandomTest {
    rig: TestRig,
    random: TestRandom,
    tags: BTreeMap<TagId, Tag>,
    groups: Vec<Vec<TagId>>,
    classes: Vec<ScanClass>,
    removed: BTreeSet<TagId>,
    /// The cycle of the last sample of each tag.
    cycles: BTreeMap<TagId, u64>,
}

impl RandomTest {
    fn new(seed: u64) -> Self {
        let mut random = TestRandom(Random::new(seed));
        let mut rig = TestRig::new(seed);
        for _ in 0..random.below(6) {
            rig.plc.refused.insert(random.cell());
        }
        rig.plc.one_shape = random.below(2) == 0;
        rig.plc.mixed = random.below(3) > 0;
        rig.plc.words = random.below(3) > 0;
        rig.plc.max_registers = random.one(&[64, 64, 32, 10]);
        rig.plc.max_points = random.one(&[256, 256, 16]);
        let class = |random: &mut TestRandom| {
            ScanClass::every(ms(random.one(&[200, 1000]))).probe_refused(ms(random.one(&[2000, 10_000])))
        };
        let classes = (0..1 + random.below(3)).map(|_| class(&mut random)).collect();
        let (tags, removed, cycles) = Default::default();
        Self { rig, random, tags, groups: Vec::new(), classes, removed, cycles }
    }

    fn add(&mut self, count: usize) {
        for _ in 0..count {
            let class = self.random.one(&self.classes);
            let together = if self.random.below(10) == 0 { 1 + self.random.below(3) } else { 1 };
            let tags: Vec<Tag> = (0..together).map(|_| self.random.tag()).collect();
            let report = self.random.below(4);
            let polled = tags.iter().map(|tag| match report {
                0 => PollTag::from(*tag).on_change(true),
                1 => PollTag::from(*tag).heartbeat(ms(700)),
                _ => PollTag::from(*tag),
            });
            // A group that does not fit in one request is not added.
            let Ok(ids) = self.rig.try_add(class, polled.collect(), together > 1) else { continue };
            self.tags.extend(ids.iter().copied().zip(tags));
            if together > 1 {
                self.groups.push(ids);
            }
        }
    }

    fn inject_fault(&mut self) {
        match self.random.below(9) {
            0 => self.rig.plc.silent = true,
            1 => self.rig.plc.refuses_all = true,
            8 => self.rig.plc.stray_due = true,
            2 => self.rig.plc.response_time = ms(self.random.one(&[1, 5, 40, 400])),
            3 => {
                let cell = self.random.cell();
                self.rig.plc.ignored = Some(cell);
            }
            4 => self.add(3),
            5 | 6 => {
                let ids: Vec<TagId> = self.tags.keys().copied().collect();
                if !ids.is_empty() {
                    let id = self.random.one(&ids);
                    assert!(self.rig.poller.remove(id, self.rig.now));
                    self.tags.remove(&id);
                    self.removed.insert(id);
                }
            }
            _ => {
                let cell = self.random.cell();
                self.rig.plc.refused.insert(cell);
            }
        }
    }

    fn clear_faults(&mut self) {
        self.rig.plc.silent = false;
        self.rig.plc.refuses_all = false;
        self.rig.plc.ignored = None;
        self.rig.plc.response_time = ms(1);
    }

    /// Checks the invariants of samples, with and without faults.
    fn check_samples(&mut self) {
        for sample in self.rig.new_samples() {
            assert!(!self.removed.contains(&sample.id), "sample of a removed tag: {sample:?}");
            let tag = self.tags[&sample.id];
            let cycle = self.cycles.entry(sample.id).or_default();
            assert!(sample.cycle >= *cycle, "a sample of an earlier cycle than {cycle}: {sample:?}");
            *cycle = sample.cycle;
            match sample.quality {
                Quality::Good | Quality::Stale(_) => self.check_values(&sample, tag),
                Quality::Bad(_) => assert!(sample.values().is_empty(), "{sample:?}"),
            }
        }
    }

    /// Checks that the PLC held the values at the time of the first reply or later.
    fn check_values(&self, sample: &Sample, tag: Tag) {
        let first =
            *self.rig.plc.epochs.get(&sample.at.instant).unwrap_or_else(|| panic!("no reply at that time: {sample:?}"));
        let last = self.rig.plc.epochs.last_key_value().map_or(first, |(_, epoch)| *epoch);
        assert_eq!(sample.values().len(), tag.value_count());
        for (n, (got, single)) in sample.values().iter().zip(tag.singles()).enumerate() {
            let held = |epoch: u64| {
                let raw: Vec<_> = single.elements().map(|element| value(epoch, element)).collect();
                single.decode(&raw).unwrap()[0].to_string() == got.to_string()
            };
            // A single value comes from one reply.
            let last = if tag.value_count() == 1 { first } else { last };
            assert!(
                (first..=last).any(held),
                "value {n} of {tag} is {got}, which the PLC has not held since {first}: {sample:?}"
            );
        }
    }

    /// Checks that all tags have recovered some time after the last fault.
    fn check_recovered(&mut self) {
        let plc = &self.rig.plc;
        let limits = Limits::new().max_registers(plc.max_registers).unwrap().max_points(plc.max_points).unwrap();
        let limits = limits.mixed_reads(plc.mixed).words_of_discretes(plc.words);
        // A run through one of these is refused.
        let limits = plc.refused.iter().fold(limits, |limits, (symbol, address)| {
            let element = Element::new(*symbol, *address).unwrap();
            limits.avoid(element, element).unwrap()
        });
        let is_possible = |tags: &[Tag]| {
            let cost = CostModel::network(Framing::Ascii, ms(5));
            Plan::builder(cost).limits(limits.clone()).one_scan(tags.iter().copied()).build().is_ok()
        };
        let longest = self.classes.iter().map(ScanClass::period).max().unwrap();
        for (id, tag) in &self.tags {
            let sample = self.rig.latest(*id);
            let group = self.groups.iter().find(|group| group.contains(id));
            let refused = match group {
                None => self.rig.plc.refuses(*tag),
                Some(group) => group.iter().filter_map(|id| self.tags.get(id)).any(|tag| self.rig.plc.refuses(*tag)),
            };
            match &sample.quality {
                Quality::Good => {
                    assert!(!refused, "{tag} is good although the PLC refuses it");
                    let age = self.rig.now - sample.at.instant;
                    assert!(age <= longest + ms(1000), "{tag} is {age:?} old");
                }
                Quality::Bad(Reason::Refused(_)) if refused => {}
                // A group or a text may exceed the PLC's limits of one request.
                Quality::Bad(Reason::Refused(_)) => {
                    let in_group = group.map(|group| group.iter().filter_map(|id| self.tags.get(id)).copied());
                    let tags: Vec<Tag> = in_group.map_or_else(|| vec![*tag], Iterator::collect);
                    let one_request = group.is_some() || tag.tag_type().is_text();
                    assert!(one_request && !is_possible(&tags), "{tag} is refused, of {tags:?}: {limits:?}");
                }
                other => panic!("{tag} is {other}, refused: {refused}"),
            }
        }
    }
}

fn run(seed: u64) {
    let mut test = RandomTest::new(seed);
    let count = 1 + test.random.below(60);
    test.add(count);
    for _ in 0..1 + test.random.below(4) {
        for _ in 0..test.random.below(4) {
            test.inject_fault();
        }
        let duration = ms(100 + test.random.below(3000) as u64);
        test.rig.run(duration);
        test.check_samples();
        if test.random.below(2) == 0 {
            test.clear_faults();
        }
    }
    test.clear_faults();
    test.rig.run(Duration::from_secs(25));
    test.check_samples();
    test.check_recovered();
    // Limits learned during faults have expired.
    test.rig.now += Duration::from_secs(600);
    test.rig.run(Duration::from_secs(30));
    test.check_samples();
    test.check_recovered();
}

#[test]
fn samples_are_true_and_all_tags_recover() {
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
fn fake_plc_values_differ_between_requests() {
    let element = Element::new(Symbol::R, 7).unwrap();
    assert_eq!(cells(element), [(Symbol::R, 7)]);
    assert_ne!(value(1, element), value(2, element));
}
