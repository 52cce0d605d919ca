//! Each value of a plan is that of a read by itself, for sets of tags that overlap, adjoin and lie across
//! the ends of the longest requests.
#![allow(clippy::print_stdout, reason = "prints figures")]

use super::words::{tags_are_readable, word_limits};
use super::*;

/// Tags of one place: their addresses are near multiples of 64, where the longest runs end.
fn random_tags(random: &mut Choices, tags: &mut Vec<Tag>) {
    let joint = 64 * random.below(9);
    let near = (joint + random.below(5)).saturating_sub(2);
    let mut add = |symbol: Symbol, address: usize, tag_type: Option<TagType>, elements: usize| {
        let aligned = address / usize::from(symbol.alignment()) * usize::from(symbol.alignment());
        let Ok(first) = Element::new(symbol, u16::try_from(aligned).unwrap()) else { return };
        let tag_type = tag_type.unwrap_or(TagType::default_for(first.width()));
        tags.extend(Tag::spanning(first, tag_type, elements));
    };
    let register = random.one(&[Symbol::R, Symbol::R, Symbol::R, Symbol::D, Symbol::RT]);
    match random.below(12) {
        0 => add(register, joint, Some(TagType::F64), 4 * (1 + random.below(40))),
        1 => {
            // Runs of one length, and values across their joints.
            add(register, joint, Some(TagType::F64), 4 * (17 + random.below(60)));
            for n in 1..4 {
                add(register, joint + 64 * n - 1, Some(TagType::F32), 2);
            }
        }
        2 => add(register, near, Some(TagType::F64Hi), 4 * (1 + random.below(20))),
        3 | 4 => add(register, near, Some(TagType::F32), 2),
        5 => add(register, near, Some(TagType::I32), 2 * (1 + random.below(70))),
        6 => add(register, joint / 2, Some(TagType::Text), 1 + random.below(64)),
        7 => add(register, near, None, 1 + random.below(150)),
        8 => {
            let symbol = random.one(&[Symbol::M, Symbol::X, Symbol::S, Symbol::T]);
            add(symbol, near, None, 1 + random.below(300));
        }
        9 => add(random.one(&[Symbol::WM, Symbol::WX, Symbol::DWM]), 4 * near, None, 1 + random.below(9)),
        10 => add(random.one(&[Symbol::DR, Symbol::DD, Symbol::RC, Symbol::DRC]), near, None, 1 + random.below(9)),
        _ => {
            let symbol = random.one(&[Symbol::R, Symbol::D, Symbol::M, Symbol::WM]);
            for _ in 0..random.below(40) {
                add(symbol, random.below(3000), None, 1);
            }
        }
    }
}

#[test]
fn every_value_of_a_plan_is_that_of_a_single_read() {
    let seeds = super::proofs::seeds(600);
    let (mut plans, mut many) = (0, 0);
    for seed in 0..seeds {
        let mut random = Choices(Random::new(seed));
        let all_limits = [limits(), word_limits()].concat();
        let model = random.one(&models()).with_proofs(random.below(4) > 0);
        // Mostly those of the protocol: the others exclude more.
        let limits =
            if random.below(2) == 0 { Limits::new() } else { all_limits[random.below(all_limits.len())].clone() };
        let limits = limits.words_of_discretes(random.below(3) > 0);
        let mut builder = Plan::builder(model).limits(limits.clone());
        let mut all = Vec::new();
        for _ in 0..1 + random.below(8) {
            let mut tags = Vec::new();
            random_tags(&mut random, &mut tags);
            tags.retain(|tag| tags_are_readable(std::slice::from_ref(tag), &limits));
            let is_group = random.below(8) == 0
                && Plan::builder(model).limits(limits.clone()).one_scan(tags.iter().copied()).build().is_ok();
            all.extend(tags.iter().copied());
            builder = if is_group { builder.one_scan(tags) } else { builder.tags(tags) };
        }
        // A text may be longer than any request of these limits.
        let Ok(plan) = builder.build() else { continue };
        let context = format!("seed {seed}, {model:?}, {limits:?}, {all:?}");
        check(&plan, &model, &limits, &context);
        plans += 1;
        many += usize::from(plan.slots.len() > solve::MAX_EXACT_PARTS);
    }
    println!("{plans} plans, {many} of more than eight values");
    assert!(plans * 10 > seeds * 8 && many * 10 > plans as usize * 7, "{plans}, {many}");
}

/// A value that lies across the joint of two runs of equal length, and is read by a mixed read, is not one of
/// the runs. Before, their last value had no request: a debug assertion failed, and without assertions the
/// tag was `Ok` without values.
#[test]
fn a_value_across_the_joint_of_two_runs_does_not_displace_another() {
    let sets: [&[&str]; 4] = [
        &["R0-R127:f64", "R63:f32"],
        &["R0-R255:f64", "R63:f32", "R191:f32", "D500", "M70"],
        &["R0-R31:text", "R32-R63:text", "R64-R95:text", "R96-R127:text", "R63:f32", "R900", "R1900", "D5", "D700"],
        &["D0-D255:f64", "D62-D65:text", "D127:i32-hi", "R0-R255:f64", "R127-R130:text"],
    ];
    for model in models().into_iter().flat_map(|model| [model, model.with_proofs(false)]) {
        for tags in sets {
            let tags = tags.iter().map(|text| tag(text));
            let plan = Plan::builder(model).tags(tags).build().unwrap();
            check(&plan, &model, &Limits::new(), &format!("{model:?}\n{}", plan.explain()));
        }
    }
}
