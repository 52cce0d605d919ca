//! Elements that are not consecutive, or not in every framing.

use super::*;

/// Before: a run of `RC` read through counters of 32 bits, and counters were read as a run.
#[test]
fn counters_of_32_bits_are_planned_one_by_one() {
    for model in models() {
        // Without proofs, for which RC198 and RC199 would be two requests.
        let model = model.with_proofs(false);
        let plan = |limits: Limits, tags: &[&str]| {
            let tags = tags.iter().map(|text| tag(text));
            let plan = Plan::builder(model).limits(limits).tags(tags).build().unwrap();
            check(&plan, &model, &Limits::new(), "counters");
            let mut requests: Vec<_> = plan.requests().iter().map(|planned| planned.request().to_string()).collect();
            requests.sort();
            requests
        };
        let mixed = plan(Limits::new(), &["RC199", "DRC200-DRC205", "RC256"]);
        assert_eq!(mixed, ["48 RC199 RC256 DRC200 DRC201 DRC202 DRC203 DRC204 DRC205"]);
        let single = plan(Limits::new().mixed_reads(false), &["RC198-RC199", "DRC200-DRC202", "RC256"]);
        assert_eq!(single, ["46 DRC200", "46 DRC201", "46 DRC202", "46 RC198-RC199", "46 RC256"]);
        let pairs = plan(Limits::new().mixed_reads(false), &["DRC196-DRC198", "DRC256"]);
        assert_eq!(pairs, ["46 RC196-RC199", "46 RC256-RC257"]);
    }
    let model = models()[0];
    let build = |limits| Plan::builder(model).limits(limits).tag(tag("DRC200-DRC255")).build();
    let counters = Limits::new().readable(Element::parse("RC0").unwrap(), Element::parse("RC199").unwrap()).unwrap();
    assert!(matches!(build(counters.clone()), Err(PlanError::NotReadable { .. })));
    let range = ["DRC200", "DRC255"].map(|text| Element::parse(text).unwrap());
    assert!(build(counters.readable(range[0], range[1]).unwrap()).is_ok());
}

/// Before: no tag had such an address.
#[test]
fn a_plan_has_addresses_of_its_framing_only() {
    let plan = |framing, text| {
        let network = CostModel::network(framing, Duration::from_millis(5));
        Plan::builder(network).tag(tag(text)).build()
    };
    for text in ["M10000", "M9990-M10000", "WM9992", "DRT9999", "RC9999:f32"] {
        assert!(plan(Framing::Binary, text).is_ok(), "{text}");
        let error = plan(Framing::Ascii, text).unwrap_err().to_string();
        assert!(error.contains("past the last address of the ascii framing"), "{text}: {error}");
    }
    assert!(plan(Framing::Ascii, "M9990-M9999").is_ok());
}
