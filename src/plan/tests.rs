use std::convert::Infallible;
use std::time::Duration;

use bytes::BytesMut;

use super::layout::{Cells, Draft};
use super::*;
use crate::command::{Command, Value, encode_reply, encode_request};
use crate::element::{Element, Register, Symbol, Width};
use crate::endpoint::SerialSettings;
use crate::random::Random;
use crate::tag::TagType;
use crate::wire::Framing;

mod addresses;
mod decoded;
mod enumerate;
mod proofs;
mod texts;
mod words;

/// Random choices. Failed tests print the seed.
struct Choices(Random);

impl Choices {
    fn below(&mut self, n: usize) -> usize {
        usize::try_from(self.0.next() % n as u64).unwrap()
    }

    fn one<T: Copy>(&mut self, of: &[T]) -> T {
        of[self.below(of.len())]
    }
}

fn models() -> Vec<CostModel> {
    let fast = SerialSettings::new(Framing::Ascii).with_baud(115_200).unwrap();
    vec![
        CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii),
        CostModel::serial(SerialSettings::new(Framing::Binary), Framing::Binary),
        CostModel::serial(fast, Framing::Ascii),
        CostModel::network(Framing::Ascii, Duration::from_millis(5)),
        CostModel::network(Framing::Binary, Duration::from_micros(20)),
        CostModel::network(Framing::Ascii, Duration::ZERO),
    ]
}

fn limits() -> Vec<Limits> {
    vec![
        Limits::new(),
        Limits::new().mixed_reads(false),
        Limits::new().max_registers(8).unwrap().max_mixed(4).unwrap().max_points(16).unwrap(),
        Limits::new().max_mixed(3).unwrap(),
        avoiding().mixed_reads(false),
        avoiding(),
    ]
}

/// Limits that avoid elements among and between those of `random_tag`.
fn avoiding() -> Limits {
    let ranges =
        ["R2", "R7", "R30", "D5", "D40", "M3", "M9", "RT4", "WM32", "X8"].map(|text| Element::parse(text).unwrap());
    ranges.into_iter().fold(Limits::new(), |limits, first| limits.avoid(first, first.nth(2).unwrap()).unwrap())
}

fn tag(text: &str) -> Tag {
    text.parse().unwrap()
}

/// A tag of one value: near others, far away, or ambiguous in the binary framing.
fn random_tag(random: &mut Choices) -> Tag {
    let symbol = random.one(&[
        Symbol::R,
        Symbol::R,
        Symbol::R,
        Symbol::DR,
        Symbol::D,
        Symbol::RT,
        Symbol::RC,
        Symbol::DRC,
        Symbol::WM,
        Symbol::DWM,
        Symbol::M,
        Symbol::X,
    ]);
    let address = match random.below(4) {
        0 => random.below(12),
        1 => random.below(90),
        2 => random.below(5000),
        _ if symbol.digits() == 5 => 21_504 + random.below(90),
        _ => 68 + random.below(3),
    };
    let address = address / usize::from(symbol.alignment()) * usize::from(symbol.alignment());
    // Some counters have 32 bits and are no `RC`.
    let Ok(first) = Element::new(symbol, u16::try_from(address).unwrap()) else { return random_tag(random) };
    match (first.width(), random.below(6)) {
        (Width::Word, 0) => Tag::new(first, TagType::F32, 1).unwrap_or(first.into()),
        (Width::Word | Width::DWord, 1) => Tag::new(first, TagType::I64, 1).unwrap_or(first.into()),
        // No longer than a run of any of `limits`.
        (Width::Word, 2) => text(first, 1 + random.below(8)),
        _ => Tag::from(first),
    }
}

/// A text of this number of registers, or fewer at the end of the area.
fn text(first: Element, registers: usize) -> Tag {
    (1..=registers).rev().find_map(|registers| Tag::spanning(first, TagType::Text, registers).ok()).unwrap()
}

/// A word of the simulated memory. Words of discretes consist of these.
fn word(symbol: Symbol, address: u16) -> u16 {
    let smallest = symbol.area().smallest();
    if smallest.width() == Width::Bit && symbol != smallest {
        return (0..16).map(|bit| (word(smallest, address + bit) & 1) << bit).sum();
    }
    let mut random = Choices(Random::new(u64::from(address) << 8 | symbol as u64));
    u16::try_from(random.below(65_536)).unwrap()
}

fn value(element: Element) -> Value {
    match element {
        Element::Discrete(e) => Value::Bit(word(e.symbol(), e.address()) & 1 == 1),
        Element::Register(e) => Value::Word(word(e.symbol(), e.address())),
        Element::Register32(e) => {
            let (low, step) = (e.symbol().halved(), e.symbol().step() / 2);
            let high = word(low, e.address() + step);
            Value::DWord(u32::from(high) << 16 | u32::from(word(low, e.address())))
        }
    }
}

fn elements(request: &ReadRequest) -> Vec<Element> {
    let run = |first: Element, count: usize| (0..count).map(|n| first.nth(n).unwrap()).collect();
    match request {
        ReadRequest::Discretes(r) => run(r.first().into(), r.count()),
        ReadRequest::Registers(r) => run(r.first().into(), r.count()),
        ReadRequest::Registers32(r) => run(r.first().into(), r.count()),
        ReadRequest::Mixed(r) => r.elements().to_vec(),
    }
}

fn answer(request: &ReadRequest) -> Reply {
    let values: Vec<Value> = elements(request).into_iter().map(value).collect();
    let bits = |value: &Value| if let Value::Bit(on) = value { *on } else { panic!("{value:?}") };
    let words = |value: &Value| if let Value::Word(word) = value { *word } else { panic!("{value:?}") };
    let dwords = |value: &Value| if let Value::DWord(double) = value { *double } else { panic!("{value:?}") };
    match request {
        ReadRequest::Discretes(_) => Reply::Bits(values.iter().map(bits).collect()),
        ReadRequest::Registers(_) => Reply::Words(values.iter().map(words).collect()),
        ReadRequest::Registers32(_) => Reply::DWords(values.iter().map(dwords).collect()),
        ReadRequest::Mixed(_) => Reply::Mixed(values),
    }
}

/// Returns the length of request and reply as encoded by the codec.
fn frames(request: &ReadRequest, framing: Framing) -> usize {
    fn both<C: Command>(request: &C, reply: C::Reply, framing: Framing) -> usize {
        let mut bytes = BytesMut::new();
        encode_request(request, framing, 1, &mut bytes).unwrap();
        encode_reply(request, Ok(&reply), framing, 1, &mut bytes);
        bytes.len()
    }
    match (request, answer(request)) {
        (ReadRequest::Discretes(r), Reply::Bits(reply)) => both(r, reply, framing),
        (ReadRequest::Registers(r), Reply::Words(reply)) => both(r, reply, framing),
        (ReadRequest::Registers32(r), Reply::DWords(reply)) => both(r, reply, framing),
        (ReadRequest::Mixed(r), Reply::Mixed(reply)) => both(r, reply, framing),
        other => panic!("{other:?}"),
    }
}

/// Checks the invariants of any plan.
fn check(plan: &Plan, model: &CostModel, limits: &Limits, context: &str) {
    for planned in plan.requests() {
        planned.request.check(model.framing()).unwrap();
        assert_eq!(planned.bytes(), frames(&planned.request, model.framing()), "{context}: {}", planned.request);
        assert!(planned.value_count() > 0, "{context}: {}", planned.request);
        let read = elements(&planned.request);
        let units: usize = read.iter().map(|e| e.width().units()).sum();
        let max = match &planned.request {
            ReadRequest::Mixed(_) => limits.mixed_units(),
            _ => limits.units(read[0].width()),
        };
        assert!(units <= max as usize, "{context}: {units} units of {max} in {}", planned.request);
        for element in read {
            let low = element.symbol().halved();
            assert!(limits.segment(low, element.address()).is_some(), "{context}: {element} is not readable");
        }
    }
    let replies = plan.requests().iter().map(|planned| Ok::<_, Infallible>(answer(&planned.request)));
    let readings = plan.scatter(replies).unwrap();
    for (tag, values) in readings.iter() {
        let raw: Vec<Value> = tag.elements().map(value).collect();
        let (values, expected) = (values.unwrap(), tag.decode(&raw).unwrap());
        let same = values.iter().map(|v| format!("{v:?}")).eq(expected.iter().map(|v| format!("{v:?}")));
        assert!(same, "{context}: {tag} is {expected:?}, and {values:?} was read");
    }
}

/// Returns the cost of the cheapest partition by plain enumeration.
fn brute_force(parts: &[Vec<Cells>], limits: &Limits, model: &CostModel) -> u64 {
    fn price(block: &[&Vec<Cells>], limits: &Limits, model: &CostModel) -> Option<u64> {
        let mut cells: Vec<Cells> = block.iter().flat_map(|part| part.iter().copied()).collect();
        cells.sort_by_key(|cells| cells.key());
        let drafts = [Draft::run(&cells, limits), Draft::mixed(&cells, limits, model)];
        let bytes = drafts.into_iter().flatten().map(|draft| frames(&draft.request().unwrap(), model.framing()));
        bytes.map(|bytes| model.cost(bytes)).min()
    }
    fn go<'a>(rest: &'a [Vec<Cells>], blocks: &mut Vec<Vec<&'a Vec<Cells>>>, of: (&Limits, &CostModel)) -> u64 {
        let Some((part, rest)) = rest.split_first() else {
            return blocks.iter().map(|block| price(block, of.0, of.1)).sum::<Option<u64>>().unwrap_or(u64::MAX);
        };
        let mut best = u64::MAX;
        for n in 0..blocks.len() {
            blocks[n].push(part);
            best = best.min(go(rest, blocks, of));
            blocks[n].pop();
        }
        blocks.push(vec![part]);
        best = best.min(go(rest, blocks, of));
        blocks.pop();
        best
    }
    go(parts, &mut Vec::new(), (limits, model))
}

fn words_are_read(cells: &Cells, limits: &Limits) -> bool {
    super::words::has_words(cells, limits)
}

/// Returns the parts of single values, as the module defines them, by comparing all pairs.
fn parts(tags: &[Tag], limits: &Limits) -> Vec<Vec<Cells>> {
    let cells: Vec<Cells> =
        tags.iter().map(|tag| Cells::of(tag.first(), tag.element_count(), limits).unwrap()).collect();
    let mut kept: Vec<Cells> = Vec::new();
    for (n, one) in cells.iter().enumerate() {
        let in_word = |other: &Cells| words_are_read(one, limits) && other.find_bit(*one).is_some();
        let held = |(m, other): (usize, &Cells)| other.contains(*one) && (other != one || m < n) || in_word(other);
        if !cells.iter().enumerate().any(held) {
            kept.push(*one);
        }
    }
    kept.sort_by_key(|cells| cells.key());
    kept.into_iter().map(|cells| vec![cells]).collect()
}

#[test]
fn no_partition_is_cheaper_than_the_plan_for_up_to_8_tags() {
    for seed in 0..300 {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()).with_proofs(false), limits()[random.below(4)].clone());
        // `words` compares plans with words of discretes.
        let limits = limits.words_of_discretes(false);
        // 8 tags have 4140 partitions (a Bell number), which is slow in a debug build.
        let n = if seed % 30 == 0 { 8 } else { 1 + random.below(6) };
        let tags: Vec<Tag> = (0..n).map(|_| random_tag(&mut random)).collect();
        let plan = Plan::builder(model).limits(limits.clone()).tags(tags.clone()).build().unwrap();
        let context = format!("seed {seed}, {model:?}, {limits:?}, {tags:?}");
        check(&plan, &model, &limits, &context);
        let optimum = brute_force(&parts(&tags, &limits), &limits, &model);
        assert_eq!(plan.time(), Duration::from_nanos(optimum), "{context}\n{}", plan.explain());
    }
}

#[test]
fn no_partition_is_cheaper_than_the_plan_for_one_scan_groups() {
    for seed in 0..100 {
        let mut random = Choices(Random::new(seed));
        let model = random.one(&models()).with_proofs(false);
        let tags: Vec<Tag> = (0..6).map(|_| random_tag(&mut random)).collect();
        let groups: Vec<&[Tag]> = vec![&tags[..2], &tags[2..4], &tags[4..5], &tags[5..]];
        let limits = Limits::new();
        let mut builder = Plan::builder(model);
        let mut all = Vec::new();
        for group in groups {
            builder = builder.one_scan(group.iter().copied());
            let mut cells: Vec<Cells> = parts(group, &limits).concat();
            cells.sort_by_key(|cells| cells.key());
            all.push(cells);
        }
        // No request can read two cells that are ambiguous in the binary framing.
        let Ok(plan) = builder.build() else { continue };
        let context = format!("seed {seed}, {model:?}, {tags:?}");
        check(&plan, &model, &limits, &context);
        assert_eq!(plan.time(), Duration::from_nanos(brute_force(&all, &limits, &model)), "{context}");
        for pair in [0, 2] {
            assert_eq!(plan.slots(pair).unwrap()[0].request, plan.slots(pair + 1).unwrap()[0].request, "{context}");
        }
    }
}

/// Runs the solver for many parts on few parts, to measure its loss against the optimum.
#[test]
fn the_solver_for_many_values_is_optimal_where_documented() {
    let (mut paid, mut optimal) = (0, 0);
    for seed in 0..2000 {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()).with_proofs(false), limits()[random.below(4)].clone());
        let limits = limits.words_of_discretes(false);
        let n = 1 + random.below(8);
        let tags: Vec<Tag> = (0..n).map(|_| random_tag(&mut random)).collect();
        let values = parts(&tags, &limits).concat();
        let large = solve::solve_large(&[], &values, &limits, &model).price();
        let best = solve::solve_exact(&[], &values, &limits, &model).price();
        let context = format!("seed {seed}, {model:?}, {limits:?}, {tags:?}");
        assert!(large >= best, "{context}");
        // Optimal without ambiguity if one mixed read of 64 units, or none, is allowed.
        let one_mixed = limits.mixed_units() == 64 || limits.mixed_units() == 0;
        if one_mixed && model.framing() == Framing::Ascii {
            assert_eq!(large, best, "{context}");
        }
        paid += large;
        optimal += best;
    }
    // The loss is due to packing where mixed reads hold 3 or 4 units only.
    assert!(paid * 100 <= optimal * 105, "{paid} ns instead of {optimal} ns");
}

/// The solver counts the cost of a mixed read cell by cell, the draft by its elements.
#[test]
fn cells_added_to_a_mixed_read_cost_as_much_as_its_elements() {
    for model in models() {
        for first in ["R0", "WM0", "RC0", "DRC0", "DRC200", "M0"].map(|first| first.parse().unwrap()) {
            let one = Cells::of(first, 1, &Limits::new()).unwrap();
            let item = layout::ItemCost::new(one.area, &model);
            let mixed = |len| Draft::mixed_of(&[Cells { len, ..one }], &Limits::new(), &model).unwrap().cost(&model);
            for (before, more) in (1..16).flat_map(|before| (1..16).map(move |more| (before, more))) {
                let cost = mixed(before) + item.cost(more, before % 2 == 1);
                assert_eq!(cost, mixed(before + more), "{first}, {before} and {more}, {model:?}");
            }
        }
    }
}

#[test]
fn any_number_of_tags_costs_no_more_than_by_runs_alone() {
    for seed in 0..60 {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()), limits()[random.below(4)].clone());
        let n = 20 + random.below(400);
        let mut builder = Plan::builder(model).limits(limits.clone());
        for _ in 0..n {
            builder = match random.below(20) {
                0 => builder.one_scan([random_tag(&mut random)]),
                1 => builder.tag(tag("R100-R299:f32")),
                2 => builder.tag(tag("M0-M999")),
                3 => builder.one_scan([tag("R0-R1"), tag("R4-R5:f32")]),
                _ => builder.tag(random_tag(&mut random)),
            };
        }
        let plan = builder.clone().build().unwrap();
        check(&plan, &model, &limits, &format!("seed {seed}, {model:?}, {limits:?}"));
        let runs = builder.limits(limits.mixed_reads(false)).build().unwrap();
        assert!(plan.time() <= runs.time(), "seed {seed}: {:?} and {:?}", plan.time(), runs.time());
    }
}

#[test]
fn scattered_tags_fill_all_mixed_reads_but_the_last() {
    let model = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let tags = (0..1000).map(|n| Tag::from(Element::from(Register::r(n * 65))));
    let plan = Plan::builder(model).tags(tags).build().unwrap();
    assert_eq!(plan.requests().len(), 1000_usize.div_ceil(64));
}

#[test]
fn a_gap_is_read_through_where_it_is_cheaper_than_a_request() {
    let slow = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
    let limits = Limits::new().mixed_reads(false);
    let requests = |model: CostModel, far: u16| {
        let tags = [Register::r(0), Register::r(far)].map(|r| Tag::from(Element::from(r)));
        Plan::builder(model).limits(limits.clone()).tags(tags).build().unwrap().requests().len()
    };
    assert_eq!((requests(slow.with_proofs(false), 8), requests(slow.with_proofs(false), 20)), (1, 2));
    // A second request of the same shape needs a check before it, and one at the end.
    assert_eq!((requests(slow, 20), requests(slow, 40)), (1, 2));
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    assert_eq!((requests(network, 63), requests(network, 64)), (1, 2));
}

#[test]
fn avoided_elements_are_read_for_their_own_tags_only() {
    for seed in 0..60 {
        let mut random = Choices(Random::new(seed));
        let count = 1 + random.below(40);
        let tags: Vec<Tag> = (0..count).map(|_| random_tag(&mut random)).collect();
        let cells = |element: Element| match element {
            Element::Register32(e) if !element.is_counter_of_32_bits() => {
                let low = e.symbol().halved();
                vec![(low, e.address()), (low, e.address() + low.step())]
            }
            other => vec![(other.symbol(), other.address())],
        };
        let avoided = |cell: (Symbol, u16)| {
            let ranges = ["R2", "R7", "R30", "D5", "D40", "M3", "M9", "RT4", "WM32", "X8"];
            ranges
                .map(|text| Element::parse(text).unwrap())
                .into_iter()
                .any(|first| (0..=2).any(|n| first.nth(n).is_ok_and(|e| (e.symbol(), e.address()) == cell)))
        };
        let needed: Vec<_> = tags.iter().flat_map(Tag::elements).flat_map(cells).collect();
        let plan = Plan::builder(models()[3]).limits(avoiding()).tags(tags.clone()).build().unwrap();
        for request in plan.requests() {
            for cell in elements(request.request()).into_iter().flat_map(cells) {
                assert!(!avoided(cell) || needed.contains(&cell), "seed {seed}: {cell:?} in {}", request.request());
            }
        }
    }
}

#[test]
fn no_request_reads_outside_of_the_readable_ranges() {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let limits = Limits::new().mixed_reads(false);
    let limits = limits.readable(crate::element!("R0"), crate::element!("R9")).unwrap();
    let limits = limits.readable(crate::element!("R20"), crate::element!("R29")).unwrap();
    let plan = Plan::builder(network).limits(limits.clone()).tags([tag("R9"), tag("R20")]).build().unwrap();
    assert_eq!(plan.requests().len(), 2);
    for (text, first) in [("R10", "R10"), ("R9:f32", "R10"), ("R8-R11", "R10"), ("DR29", "DR29")] {
        let error = Plan::builder(network).limits(limits.clone()).tag(tag(text)).build().unwrap_err();
        assert_eq!(error, PlanError::NotReadable { tag: tag(text), element: first.parse().unwrap() });
    }
    // Adjacent ranges are merged.
    let limits = limits.readable(crate::element!("R10"), crate::element!("R19")).unwrap();
    let plan = Plan::builder(network).limits(limits).tags([tag("R9:f32"), tag("R20")]).build().unwrap();
    assert_eq!(plan.requests().len(), 1);
}

#[test]
fn tags_that_do_not_fit_in_one_request_are_refused() {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let limits = Limits::new().mixed_reads(false);
    let error = Plan::builder(network).limits(limits).one_scan([tag("R0"), tag("M0")]).build().unwrap_err();
    assert_eq!(error, PlanError::OneScan { first: tag("R0"), tags: 2, units: 2, max: 0 });
    let tags = "the 2 tags from R0 on must come from one scan, but no single request can read that";
    let run = "one run would be too long, of several kinds, or across unreadable or avoided elements";
    assert_eq!(error.to_string(), format!("{tags}: there are no mixed reads, and {run}"));
    // A register of two values counts once.
    let error = Plan::builder(network).one_scan([tag("R0-R63"), tag("R5:f32"), tag("M0")]).build().unwrap_err();
    assert_eq!(error, PlanError::OneScan { first: tag("R0-R63"), tags: 3, units: 65, max: 64 });
    assert!(error.to_string().contains(": 65 units exceed the 64 of a mixed read, and one run"));
    // 44 44 00 44 46 00 44: `D` at 4400h and `DF` at 44h, or `DD` at 44h and `F` at 44h. In the other
    // order: 44 46 00 44 44 44 00, `DF` at 44h and `D` at 4400h, or `D` at 4600h and `DD` at 4400h.
    let binary = CostModel::network(Framing::Binary, Duration::from_millis(5));
    let error = Plan::builder(binary).one_scan([tag("D17408"), tag("DF68")]).build().unwrap_err();
    assert!(error.to_string().contains(": a mixed read would be ambiguous in the binary framing, and"));
    assert!(Plan::builder(network).one_scan([tag("D17408"), tag("DF68")]).build().is_ok());
    // 44 44 00 44 46 00 00: `D` at 4400h and `DF` at 0, or `DD` at 44h and `F` at 0.
    let reversed = Plan::builder(binary).one_scan([tag("D17408"), tag("DF0")]).build().unwrap();
    assert_eq!(reversed.requests()[0].request().to_string(), "48 DF0 D17408");
    assert!(Plan::builder(network).one_scan([tag("R0-R63")]).build().is_ok());
    assert!(Plan::builder(network).one_scan([tag("R0-R64")]).build().is_err());
    assert!(Plan::builder(network).tag(tag("R0-R64")).build().is_ok());
}

#[test]
fn a_failed_request_affects_its_own_tags_only() {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let limits = Limits::new().mixed_reads(false);
    let tags = ["R0", "M0", "R1-R2", "R3:f32"].map(tag);
    let plan = Plan::builder(network).limits(limits).tags(tags).build().unwrap();
    let replies = plan.requests().iter().map(|planned| match &planned.request {
        ReadRequest::Discretes(_) => Err("refused"),
        request => Ok(answer(request)),
    });
    let readings = plan.scatter(replies).unwrap();
    assert_eq!([0, 1, 2, 3].map(|n| readings.tag(n).unwrap().is_ok()), [true, false, true, true]);
    assert_eq!(readings.errors().map(|(_, error)| *error).collect::<Vec<_>>(), ["refused"]);
}

#[test]
fn a_reply_to_another_request_is_refused() {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let plan = Plan::builder(network).tag(tag("R0-R3")).build().unwrap();
    let scatter = |replies: Vec<Reply>| plan.scatter(replies.into_iter().map(Ok::<_, Infallible>)).map(|_| ());
    assert_eq!(scatter(vec![Reply::Words(vec![0; 4])]), Ok(()));
    assert_eq!(scatter(vec![Reply::Words(vec![0; 3])]), Err(PlanError::Reply { request: 0 }));
    assert_eq!(scatter(vec![Reply::Bits(vec![false; 4])]), Err(PlanError::Reply { request: 0 }));
    assert_eq!(scatter(vec![]), Err(PlanError::Reply { request: 0 }));
    assert_eq!(scatter(vec![Reply::Words(vec![0; 4]); 2]), Err(PlanError::Reply { request: 1 }));
}

#[test]
fn a_plan_without_tags_has_no_requests() {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let plan = Plan::builder(network).one_scan([]).build().unwrap();
    assert_eq!((plan.requests().len(), plan.time()), (0, Duration::ZERO));
    let whole = vec![tag("R0-R65535"); 17];
    assert_eq!(Plan::builder(network).tags(whole).build().unwrap_err(), PlanError::TooManyValues { max: MAX_VALUES });
}
