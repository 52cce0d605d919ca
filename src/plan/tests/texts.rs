use super::*;

fn network() -> CostModel {
    CostModel::network(Framing::Ascii, Duration::from_millis(5))
}

#[test]
fn a_text_is_read_by_one_request_with_all_tags_in_it() {
    let tags = ["R60-R69:text", "R0-R63", "R62:f32", "R69", "R64-R66:text-hi"].map(tag);
    let plan = Plan::builder(network()).limits(Limits::new().mixed_reads(false)).tags(tags).build().unwrap();
    check(&plan, &network(), &Limits::new(), "five tags");
    let mut reads: Vec<String> = plan.requests().iter().map(|planned| planned.request.to_string()).collect();
    reads.sort();
    assert_eq!(reads, ["46 R0-R59", "46 R60-R69"]);
}

/// The texts are longer than a run, and fit in a mixed read.
#[test]
fn no_partition_is_cheaper_where_texts_are_too_long_for_runs() {
    for seed in 0..200 {
        let mut random = Choices(Random::new(seed));
        let model = random.one(&models()).with_proofs(false);
        let limits = Limits::new().max_registers(4).unwrap().max_mixed(12 + random.below(53)).unwrap();
        let n = 1 + random.below(6);
        let of = |random: &mut Choices| match random.below(2) {
            0 => text(Register::r(u16::try_from(random.below(40)).unwrap()).into(), 3 + random.below(10)),
            _ => random_tag(random),
        };
        let tags: Vec<Tag> = (0..n).map(|_| of(&mut random)).filter(|tag| tag.element_count() <= 12).collect();
        // No request can read a text that is ambiguous in the binary framing.
        let Ok(plan) = Plan::builder(model).limits(limits.clone()).tags(tags.clone()).build() else { continue };
        let context = format!("seed {seed}, {model:?}, {limits:?}, {tags:?}");
        check(&plan, &model, &limits, &context);
        let optimum = brute_force(&parts(&tags, &limits), &limits, &model);
        assert_eq!(plan.time(), Duration::from_nanos(optimum), "{context}\n{}", plan.explain());
    }
}

#[test]
fn many_texts_are_read_if_longer_than_a_run_or_not() {
    for seed in 0..40 {
        let mut random = Choices(Random::new(seed));
        let model = random.one(&models());
        let limits = Limits::new().max_registers(if seed % 2 == 0 { 64 } else { 4 }).unwrap();
        let mut tags = Vec::new();
        for _ in 0..20 + random.below(200) {
            let first = Register::r(u16::try_from(random.below(2000)).unwrap());
            tags.push(match random.below(3) {
                0 => text(first.into(), 1 + random.below(64)),
                1 => Tag::new(first, TagType::F32, 1).unwrap(),
                _ => Tag::from(Element::from(first)),
            });
        }
        let plan = Plan::builder(model).limits(limits.clone()).tags(tags).build().unwrap();
        check(&plan, &model, &limits, &format!("seed {seed}, {model:?}, {limits:?}"));
    }
}

#[test]
fn the_same_text_twice_is_read_once() {
    let limits = Limits::new().max_registers(4).unwrap().max_mixed(10).unwrap();
    let tags: Vec<Tag> = (0..20).map(|n| text(Register::r(n / 2 * 100).into(), 10)).collect();
    let plan = Plan::builder(network()).limits(limits).tags(tags).build().unwrap();
    assert_eq!(plan.requests().len(), 10);
}

#[test]
fn a_text_longer_than_any_request_is_refused() {
    let limits = Limits::new().max_registers(9).unwrap();
    let build = |limits: Limits| Plan::builder(network()).limits(limits).tags([tag("R7"), tag("R0-R9:text")]).build();
    assert_eq!(build(limits.clone()).unwrap().requests().len(), 1);
    let error = build(limits.clone().mixed_reads(false)).unwrap_err();
    assert_eq!(error, PlanError::OneScan { first: tag("R0-R9:text"), tags: 1, units: 10, max: 0 });
    let error = build(limits.max_mixed(9).unwrap()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "R0-R9:text must come from one scan, but no single request can read that: 10 units exceed the 9 of a mixed read, \
         and one run would be too long, of several kinds, or across unreadable or avoided elements"
    );
    let limits = Limits::new().readable(crate::element!("R0"), crate::element!("R8")).unwrap();
    assert!(matches!(build(limits), Err(PlanError::NotReadable { .. })));
}
