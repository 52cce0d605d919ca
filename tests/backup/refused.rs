//! Refusals: elements that a PLC refuses to read are missing and never zero; refused writes are
//! reported.

use fatek::backup::{Backup, Missing, Restore, RestoreFailure, RestoreOptions};
use fatek::command::Code;
use fatek::sim::{Fault, Faults, Rule};
use fatek::tag::Tag;
use fatek::{Element, Error, ErrorCode, Value, element};

use crate::bench::{Bench, FRAMINGS, Rng, model, tags};

const ILLEGAL: Missing = Missing::Refused(ErrorCode::IllegalAddress);

/// Asserts that no write named any of these elements.
fn assert_untouched(bench: &Bench, ranges: &[Tag]) {
    let missing: Vec<Element> = ranges.iter().flat_map(Tag::elements).collect();
    for (first, count) in bench.writes() {
        for n in 0..count {
            assert!(!missing.contains(&first.nth(n).unwrap()), "{first} {count}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn refused_elements_are_missing_and_not_restored() {
    for framing in FRAMINGS {
        let small = model().last(element!("R100")).last(element!("DD21"));
        let bench = Bench::with_model(framing, Faults::new(1), small);
        for address in 0..=100 {
            bench.plc.write(fatek::Register::r(address), 1000 + address).unwrap();
        }
        let refuse = |first, count| Rule::new(Fault::Error(ErrorCode::IllegalAddress)).elements(first, count);
        bench.faults.set_rules([
            refuse(element!("M50"), 3),
            refuse(element!("M99"), 1),
            Rule::new(Fault::Error(ErrorCode::IllegalValue)).element(element!("R7")),
        ]);
        let ranges = tags(["R1-R130:i32", "DD10-DD30", "M0-M99", "WM96-WM128", "RT0-RT9"]);
        let refused = tags(["R7-R8", "R101-R130", "DD22-DD30", "M50-M52", "M99", "WM96"]);
        let error = Backup::of(ranges).unwrap_err().to_string();
        assert_eq!(error, "M0-M99 and WM96-WM128 share memory");
        let ranges = tags(["R1-R130:i32", "DD10-DD30", "M0-M95", "WM96-WM128", "RT0-RT9"]);
        let backup = bench.station().back_up(ranges).await.unwrap();

        let missing: Vec<_> = backup.missing().iter().map(|missing| (missing.range, missing.reason)).collect();
        let value = Missing::Refused(ErrorCode::IllegalValue);
        let reasons = [value, ILLEGAL, ILLEGAL, ILLEGAL, ILLEGAL];
        let expected = tags(["R7-R8", "R101-R130", "DD22-DD30", "M50-M52", "WM96"]);
        assert_eq!(missing, expected.into_iter().zip(reasons).collect::<Vec<_>>());
        for (element, cell) in backup.elements() {
            let is_refused = refused.iter().flat_map(Tag::elements).any(|refused| refused == element);
            assert_eq!(cell.is_err(), is_refused, "{element}");
            if !is_refused {
                assert_eq!(cell, Ok(bench.plc.read(element)), "{element}");
            }
        }
        assert_eq!((backup.value(element!("R8")), backup.value(element!("R0"))), (Some(Err(value)), None));
        assert_eq!((backup.is_complete(), backup.value_count()), (false, backup.element_count() - 41));
        assert_eq!(Backup::from_file(backup.to_file().as_bytes()), Ok(backup.clone()));

        // Restore to a PLC that has all elements.
        let large = Bench::new(framing, Faults::new(1));
        large.fill(&mut Rng(9));
        let before = large.snapshot();
        let report = large.station().restore(&backup, RestoreOptions::new()).await.unwrap();
        assert_eq!(report.missing, backup.missing());
        assert!(report.to_string().ends_with(" written, 41 missing in the backup"), "{report}");
        assert_untouched(&large, &refused);
        let held = |element: Element| before.iter().find(|(known, _)| *known == element).map(|(_, value)| *value);
        for element in tags(["R7-R8", "R101-R130", "D22-D31", "M50-M52", "M96-M111"]).iter().flat_map(Tag::elements) {
            assert_eq!(Some(large.plc.read(element)), held(element), "{element}");
        }
        assert_eq!(large.plc.read(element!("R6")), 1006_u16.into());
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_lacks_elements_is_not_written_at_all() {
    for framing in FRAMINGS {
        let large = Bench::new(framing, Faults::new(1));
        large.fill(&mut Rng(2));
        let backup = large.station().back_up(tags(["R0-R199", "M0-M9"])).await.unwrap();
        let small = Bench::with_model(framing, Faults::new(1), model().last(element!("R150")));
        let error = small.station().restore(&backup, RestoreOptions::new()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::NotThere { count: 49, .. }), "{error}");
        let refused: Vec<_> = error.report.refused.iter().map(|refused| (refused.range, refused.error)).collect();
        assert_eq!(refused, [("R151-R199".parse().unwrap(), ErrorCode::IllegalAddress)]);
        assert_eq!((small.faults.log().writes(), error.report.written.len()), (0, 0));
        // The elements that it has can be restored.
        let part = backup.select(tags(["R0-R150", "M0-M9"])).unwrap();
        small.station().restore(&part, RestoreOptions::new()).await.unwrap();
        assert_eq!(small.plc.read(element!("R150")), large.plc.read(element!("R150")));
    }
}

#[tokio::test(start_paused = true)]
async fn elements_that_refuse_writes_are_reported() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let backup = bench.station().back_up(tags(["R0-R99", "M0-M9"])).await.unwrap();
        bench.fill(&mut Rng(2));
        bench.plc.write(element!("R50"), 5_u16).unwrap();
        let rule = Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(Code::WriteRegisters);
        // A write of up to 32 registers may be a 49, too.
        let mixed = Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(Code::WriteMixed);
        bench.faults.set_rules([rule.elements(element!("R49"), 2), mixed.elements(element!("R49"), 2)]);
        let error = bench.station().restore(&backup, RestoreOptions::new()).await.unwrap_err();
        assert!(matches!(error.source, RestoreFailure::Differs { count: 2, .. }), "{error}");
        let report = error.report;
        let refused: Vec<_> = report.refused.iter().map(|refused| refused.range).collect();
        assert_eq!(refused, tags(["R49-R50"]));
        let remaining: Vec<_> = report.remaining.iter().map(|left| (left.element, left.expected)).collect();
        assert_eq!(remaining, [element!("R49"), element!("R50")].map(|element| (element, Value::Word(0))));
        assert_eq!(report.remaining[1].found, Some(Value::Word(5)));
        for element in tags(["R0-R48", "R51-R99", "M0-M9"]).iter().flat_map(Tag::elements) {
            assert_eq!(Ok(bench.plc.read(element)), backup.value(element).unwrap(), "{element}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_32_bit_value_with_a_refused_half_is_left_alone() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let backup = bench.station().back_up(tags(["R200-R209:f32"])).await.unwrap();
        bench.fill(&mut Rng(2));
        let before = bench.plc.read(element!("R202"));
        let rule = Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(Code::WriteRegisters);
        let mixed = Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(Code::WriteMixed);
        bench.faults.set_rules([rule.element(element!("R203")), mixed.element(element!("R203"))]);
        let error = bench.station().restore(&backup, RestoreOptions::new()).await.unwrap_err();
        let refused: Vec<_> = error.report.refused.iter().map(|refused| refused.range).collect();
        assert_eq!(
            (refused, error.report.written),
            (tags(["R202-R203"]).to_vec(), tags(["R200-R201", "R204-R209"]).to_vec())
        );
        assert_eq!((bench.plc.read(element!("R202")), bench.plc.read(element!("R204"))), (before, Value::Word(0)));
    }
}

#[tokio::test(start_paused = true)]
async fn write_protection_ends_a_restore_at_the_first_write() {
    let bench = Bench::new(FRAMINGS[0], Faults::new(1));
    let backup = bench.station().back_up(tags(["R0-R199"])).await.unwrap();
    bench.fill(&mut Rng(2));
    let rule = Rule::new(Fault::Error(ErrorCode::WriteProhibited)).command(Code::WriteRegisters);
    bench.faults.set_rules([rule]);
    let mut restore = Restore::new(&backup, RestoreOptions::new());
    let error = restore.run(&bench.station()).await.unwrap_err();
    let RestoreFailure::Call { source: Error::Plc { error: code, .. }, .. } = &error.source else { panic!("{error}") };
    assert_eq!((*code, bench.writes().len()), (ErrorCode::WriteProhibited, 1));
    assert_eq!(error.report.unwritten, tags(["R0-R199"]));
    assert!(error.to_string().ends_with("200 elements compared, 200 differed, 0 written, 200 not written"), "{error}");
}
