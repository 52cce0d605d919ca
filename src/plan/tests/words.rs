//! Discretes that are read as bits of words.
#![allow(clippy::print_stdout, reason = "prints figures")]

use super::enumerate::{Enumeration, smallest, smallest_of};
use super::*;

/// A tag near others: mostly discretes, and words and registers between them.
pub(super) fn random_tag_near_discretes(random: &mut Choices) -> Tag {
    let symbol = match random.below(10) {
        0..5 => Symbol::M,
        5 => random.one(&[Symbol::X, Symbol::S, Symbol::T]),
        6 => Symbol::WM,
        7 => random.one(&[Symbol::DWM, Symbol::WX, Symbol::WT]),
        _ => return random_tag(random),
    };
    let address = match random.below(8) {
        0 => 100 + random.below(300),
        1 => 9960 + random.below(40),
        2..5 => random.below(24),
        _ => random.below(80),
    };
    let address = address / usize::from(symbol.alignment()) * usize::from(symbol.alignment());
    let address = u16::try_from(address).unwrap().min(symbol.last_address_in(Framing::Ascii));
    Tag::from(Element::new(symbol, address).unwrap())
}

pub(super) fn word_limits() -> Vec<Limits> {
    let element = |text: &str| Element::parse(text).unwrap();
    let readable = |limits: Limits, first, last| limits.readable(element(first), element(last)).unwrap();
    vec![
        Limits::new(),
        Limits::new(),
        Limits::new().mixed_reads(false),
        Limits::new().max_mixed(3).unwrap(),
        Limits::new().max_mixed(2).unwrap().max_registers(2).unwrap(),
        Limits::new().max_mixed(5).unwrap().max_registers(3).unwrap().max_points(8).unwrap(),
        Limits::new().words_at_multiples_of_16(true),
        avoiding(),
        readable(readable(Limits::new(), "M0", "M37"), "M42", "M9999"),
        readable(readable(Limits::new().max_mixed(4).unwrap(), "WM0", "WM16"), "WM40", "WM9984"),
        readable(readable(Limits::new(), "WM0", "WM16"), "WM32", "WM9984"),
    ]
}

pub(super) fn tags_are_readable(tags: &[Tag], limits: &Limits) -> bool {
    tags.iter().all(|tag| Cells::of(tag.first(), tag.element_count(), limits).is_some())
}

#[test]
fn no_plan_of_the_enumeration_is_cheaper_for_up_to_8_values() {
    let seeds: u64 = std::env::var("FATEK_PLAN_SEEDS").map_or(60, |n| n.parse().unwrap());
    let (mut compared, mut with_words) = (0, 0);
    for seed in 0..seeds {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()).with_proofs(false), random.below(word_limits().len()));
        let limits = word_limits()[limits].clone();
        let n = if seed % 50 == 49 { 8 } else { 1 + random.below(5) };
        let tags: Vec<Tag> = (0..n).map(|_| random_tag_near_discretes(&mut random)).collect();
        if !tags_are_readable(&tags, &limits) {
            continue;
        }
        let plan = Plan::builder(model).limits(limits.clone()).tags(tags.clone()).build();
        // A text may be longer than a run of the limits.
        let Ok(plan) = plan else { continue };
        let context = format!("seed {seed}, {model:?}, {limits:?}, {tags:?}");
        check(&plan, &model, &limits, &context);
        let mut enumeration = Enumeration { limits: &limits, model: &model, ambiguous: 0 };
        let parts: Vec<_> = tags.iter().map(|tag| smallest(&[*tag])).collect();
        // An enumeration without words at multiples of 8 would be another one.
        let optimum = enumeration.cheapest(&parts);
        if enumeration.ambiguous > 0 || limits == Limits::new().words_at_multiples_of_16(true) {
            assert!(plan.time() >= Duration::from_nanos(optimum), "{context}\n{}", plan.explain());
            continue;
        }
        compared += 1;
        with_words += usize::from(plan.requests().iter().any(PlannedRequest::has_words_of_discretes));
        assert_eq!(plan.time(), Duration::from_nanos(optimum), "{context}\n{}", plan.explain());
    }
    println!("{compared} sets compared with all plans, {with_words} of them read discretes as words");
    assert!(compared * 2 > seeds && with_words * 5 > compared as usize, "{compared}, {with_words}");
}

/// The plan for many values beside the best one, and beside the one without words.
#[test]
fn the_plan_of_many_discretes_is_close_to_the_optimum() {
    let (mut paid, mut optimal, mut worst) = ([0; 3], [0; 3], [0; 3]);
    let (mut optima, mut sets) = ([0; 3], [0; 3]);
    for seed in 0..3000 {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()), random.below(word_limits().len()));
        // Words are left out of lists that are ambiguous in the binary framing.
        let low = if model.framing() == Framing::Binary { 2 } else { usize::from(limits > 1) };
        let limits = word_limits()[limits].clone();
        let n = 1 + random.below(8);
        let tags: Vec<Tag> = (0..n).map(|_| random_tag_near_discretes(&mut random)).collect();
        if !tags_are_readable(&tags, &limits)
            || Plan::builder(model).limits(limits.clone()).tags(tags.clone()).build().is_err()
        {
            continue;
        }
        let values = parts(&tags, &limits).concat();
        // Planned as a group.
        if values.iter().any(|value| value.len > value.area.max_run(&limits)) {
            continue;
        }
        // As in `solve` for more than 8 values.
        let single = solve::single_request(&[], &values, &limits, &model).map(|(draft, _)| draft.cost(&model));
        let large = single.unwrap_or_else(|| solve::solve_large(&[], &values, &limits, &model).price());
        let best = solve::solve_exact(&[], &values, &limits, &model).price();
        assert!(large >= best || model.framing() == Framing::Binary, "seed {seed}, {model:?}, {limits:?}, {tags:?}");
        let large = large.max(best);
        paid[low] += large;
        optimal[low] += best;
        optima[low] += usize::from(large == best);
        sets[low] += 1;
        worst[low] = worst[low].max((large - best) * 1000 / best);
    }
    for (low, name) in
        ["ASCII, limits of the protocol", "ASCII, low limits or ranges", "binary"].into_iter().enumerate()
    {
        println!(
            "{name}: the solver for many values costs {:.2} % more than the optimum, at most {:.1} %; {} of {} sets optimal",
            (paid[low] - optimal[low]) as f64 * 100.0 / optimal[low] as f64,
            worst[low] as f64 / 10.0,
            optima[low],
            sets[low]
        );
    }
    assert!((paid[0] - optimal[0]) * 1000 < optimal[0] * 2, "{} ns instead of {} ns", paid[0], optimal[0]);
    for low in [1, 2] {
        assert!((paid[low] - optimal[low]) * 100 < optimal[low] * 4, "{} ns instead of {} ns", paid[low], optimal[low]);
    }
}

#[test]
fn words_never_cost_more_than_discretes() {
    let (mut cheaper, mut saved, mut all) = (0, 0.0, 0.0);
    for seed in 0..200 {
        let mut random = Choices(Random::new(seed));
        let (model, limits) = (random.one(&models()), random.below(word_limits().len()));
        let limits = word_limits()[limits].clone();
        let n = 1 + random.below(120);
        let mut builder = Plan::builder(model).limits(limits.clone());
        for _ in 0..n {
            let tag = random_tag_near_discretes(&mut random);
            if tags_are_readable(&[tag], &limits) {
                builder = if random.below(15) == 0 { builder.one_scan([tag]) } else { builder.tag(tag) };
            }
        }
        let without = builder.clone().limits(limits.clone().words_of_discretes(false)).build();
        let Ok(without) = without else { continue };
        let plan = builder.build().unwrap();
        let context = format!("seed {seed}, {model:?}, {limits:?}");
        check(&plan, &model, &limits, &context);
        assert!(without.requests().iter().all(|request| !request.has_words_of_discretes()));
        assert!(plan.time() <= without.time(), "{context}\n{}\n{}", plan.explain(), without.explain());
        cheaper += usize::from(plan.time() < without.time());
        saved += (without.time() - plan.time()).as_secs_f64();
        all += without.time().as_secs_f64();
    }
    println!("{cheaper} of 200 plans are cheaper with words, by {:.1} % of the time of all", saved * 100.0 / all);
    assert!(cheaper > 100, "{cheaper}");
}

/// Words have no discretes in them that are to be avoided or not readable, with or without a tag.
#[test]
fn limits_hold_for_each_discrete_of_a_word() {
    let mut words_seen = 0;
    for seed in 0..400 {
        let mut random = Choices(Random::new(seed));
        let limits = word_limits()[7 + random.below(3)].clone();
        let tags: Vec<Tag> = (0..1 + random.below(40)).map(|_| random_tag_near_discretes(&mut random)).collect();
        if !tags_are_readable(&tags, &limits) {
            continue;
        }
        let needed = smallest(&tags);
        let Ok(plan) = Plan::builder(random.one(&models())).limits(limits.clone()).tags(tags).build() else { continue };
        for request in plan.requests() {
            for cell in elements(request.request()).into_iter().flat_map(smallest_of) {
                let discrete = cell.0.area().smallest();
                if needed.contains(&cell) || discrete.width() != Width::Bit || cell.0.width() != Width::Word {
                    continue;
                }
                words_seen += 1;
                for bit in cell.1..cell.1 + 16 {
                    let allowed = limits.segment(discrete, bit).is_some() && !limits.avoids_any(discrete, bit, bit);
                    assert!(allowed, "seed {seed}: {discrete}{bit} in {}", request.request());
                }
            }
        }
    }
    assert!(words_seen > 300, "{words_seen}");
}

fn requests(plan: &Plan) -> Vec<String> {
    plan.requests().iter().map(|planned| planned.request().to_string()).collect()
}

pub(super) fn serial() -> CostModel {
    CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii)
}

#[test]
fn a_range_of_discretes_is_read_by_a_run_of_words() {
    let plan = |limits, tags: &[&str]| {
        let tags = tags.iter().map(|text| tag(text));
        Plan::builder(serial()).limits(limits).tags(tags).build().unwrap()
    };
    assert_eq!(requests(&plan(Limits::new(), &["M0-M255"])), ["46 WM0-WM240"]);
    assert_eq!(requests(&plan(Limits::new().words_of_discretes(false), &["M0-M255"])), ["44 M0-M255"]);
    // A word begins at a multiple of 8, and the last one ends with the last discrete.
    assert_eq!(requests(&plan(Limits::new(), &["M10-M39"])), ["46 WM8-WM24"]);
    assert_eq!(requests(&plan(Limits::new(), &["M18-M47"])), ["46 WM16-WM32"]);
    assert_eq!(requests(&plan(Limits::new().words_at_multiples_of_16(true), &["M10-M39"])), ["46 WM0-WM32"]);
    // No device is known to have words of T and C.
    assert_eq!(requests(&plan(Limits::new(), &["T0-T255"])), ["44 T0-T255"]);
    // The tag reads the word, and M3 is part of it.
    assert_eq!(requests(&plan(Limits::new(), &["M3", "WM0:i16"])), ["46 WM0"]);
    assert_eq!(requests(&plan(Limits::new(), &["M9984-M9999"])), ["46 WM9984"]);
    let element = |text: &str| Element::parse(text).unwrap();
    let readable = Limits::new().readable(element("M0"), element("M2001")).unwrap();
    let all = plan(readable.clone(), &["M1900-M2001"]);
    check(&all, &serial(), &readable, "M1900-M2001");
    assert!(
        elements_read(&all).iter().all(|e| e.symbol() == Symbol::M || e.address() + 15 <= 2001),
        "{}",
        all.explain()
    );
    assert!(all.requests().iter().any(PlannedRequest::has_words_of_discretes), "{}", all.explain());
}

fn elements_read(plan: &Plan) -> Vec<Element> {
    plan.requests().iter().flat_map(|planned| elements(planned.request())).collect()
}

#[test]
fn a_group_has_discretes_as_words_of_one_mixed_read() {
    let tags = [tag("M0-M255"), tag("R0-R38:u16"), tag("M300")];
    let group = |limits| Plan::builder(serial()).limits(limits).one_scan(tags).build();
    let plan = group(Limits::new()).unwrap();
    assert_eq!(plan.requests().len(), 1);
    check(&plan, &serial(), &Limits::new(), "a group");
    let error = group(Limits::new().words_of_discretes(false)).unwrap_err();
    assert_eq!(error, PlanError::OneScan { first: tags[0], tags: 3, units: 296, max: 64 });
}

#[test]
fn a_group_that_does_not_fit_has_its_units_counted_as_words() {
    let error = Plan::builder(serial()).one_scan([tag("M0-M255"), tag("R0-R48")]).build().unwrap_err();
    assert_eq!(error, PlanError::OneScan { first: tag("M0-M255"), tags: 2, units: 65, max: 64 });
}

#[test]
fn neighbours_have_replies_of_different_shapes_if_possible() {
    let shapes = |plan: &Plan| -> Vec<(crate::command::Code, usize)> {
        plan.requests().iter().map(|planned| (planned.request().code(), planned.reply_bytes)).collect()
    };
    let limits = Limits::new().mixed_reads(false);
    for seed in 0..200 {
        let mut random = Choices(Random::new(seed));
        // Runs of one to three lengths, far apart.
        let tags = (0..1 + random.below(12)).map(|n| {
            let first = Register::r(u16::try_from(n * 500).unwrap());
            Tag::new(first, TagType::U16, 1 + random.below(3)).unwrap()
        });
        let tags: Vec<Tag> = tags.collect();
        let plan = Plan::builder(serial()).limits(limits.clone()).tags(tags.clone()).build().unwrap();
        check(&plan, &serial(), &limits, &format!("seed {seed}"));
        let shapes = shapes(&plan);
        let count = |shape| shapes.iter().filter(|other| *other == shape).count();
        let most = shapes.iter().map(count).max().unwrap();
        let equal = shapes.windows(2).filter(|pair| pair[0] == pair[1]).count();
        let own = shapes.iter().any(|shape| count(shape) == 1);
        // One request with a shape of its own is the last, so one place fewer is left for the others.
        let others = shapes.len() - usize::from(own);
        assert!(equal <= (2 * most).saturating_sub(others + 1), "seed {seed}: {shapes:?}");
        assert_eq!(own, count(shapes.last().unwrap()) == 1, "seed {seed}: {shapes:?}");
    }
    let plan =
        Plan::builder(serial()).limits(limits).tags([tag("R0"), tag("R500"), tag("R1000-R1001")]).build().unwrap();
    assert_eq!(requests(&plan).last().unwrap(), "46 R1000-R1001");
}

#[test]
fn costs_of_a_link_have_its_gaps() {
    use crate::endpoint::InStepSettings;
    use crate::link::Link;
    let (line, _) = tokio::io::duplex(64);
    let quiet = Duration::from_millis(700);
    let in_step = InStepSettings::new().with_one_request(true).with_quiet(quiet);
    let gap = Duration::from_millis(9);
    let link = Link::stream_builder(line, Framing::Ascii).frame_gap(gap).in_step(in_step).build();
    assert_eq!(CostModel::of_link(&link).request_time(), Duration::from_millis(5) + gap + quiet);
    let (line, _) = tokio::io::duplex(64);
    let settings = SerialSettings::new(Framing::Ascii);
    let link = Link::stream_builder(line, Framing::Ascii).serial_line(settings).build();
    assert_eq!(CostModel::of_link(&link), CostModel::serial(settings, Framing::Ascii));
}

/// No double word crosses the edge of a range. Before, the cost of one was counted, and a longer request
/// chosen.
#[test]
fn words_at_the_edge_of_a_range_are_not_priced_as_a_pair() {
    let element = |text: &str| Element::parse(text).unwrap();
    let readable = |limits: Limits, first, last| limits.readable(element(first), element(last)).unwrap();
    let limits = readable(readable(Limits::new(), "WM0", "WM16"), "WM32", "WM9984");
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let tags = ["M16", "M20", "M40"].map(|tag| Tag::parse(tag).unwrap());
    let time = |limits| Plan::builder(network).limits(limits).tags(tags).build().unwrap().time();
    assert!(time(limits.clone()) <= time(limits.words_of_discretes(false)));
}

/// Before, a debug assertion failed: there is no word behind the last one.
#[test]
fn the_last_word_of_the_binary_framing_is_planned() {
    let limits = Limits::new().avoid(Element::parse("R5000").unwrap(), Element::parse("R5001").unwrap()).unwrap();
    let network = CostModel::network(Framing::Binary, Duration::from_millis(5));
    let tags = ["M65520-M65535", "R0-R63", "D0-D63"].map(|tag| Tag::parse(tag).unwrap());
    let plan = Plan::builder(network).limits(limits).tags(tags).build().unwrap();
    assert!(plan.requests().iter().any(PlannedRequest::has_words_of_discretes), "{}", plan.explain());
}
