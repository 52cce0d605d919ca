//! Restores that are interrupted at every single request, and resumed.

use std::collections::HashSet;

use fatek::backup::{Backup, Restore, RestoreOptions, RestoreReport};
use fatek::command::Code;
use fatek::sim::{DisconnectAt, Fault, Faults, Rule};
use fatek::tag::Tag;
use fatek::wire::Framing;
use fatek::{Element, Value, element};

use crate::bench::{Bench, FRAMINGS, Rng, tags};

const RANGES: [&str; 3] = ["R0-R150", "DD10-DD20", "M0-M19"];

/// Creates a backup, and a running PLC with other values.
async fn prepare(framing: Framing) -> (Bench, Backup, Vec<(Element, Value)>) {
    let bench = Bench::new(framing, Faults::new(1));
    bench.fill(&mut Rng(5));
    let backup = bench.station().back_up(tags(RANGES)).await.unwrap();
    for (element, value) in backup.elements() {
        let other = match value.unwrap() {
            Value::Bit(on) => Value::Bit(!on),
            Value::Word(word) => Value::Word(!word),
            Value::DWord(double) => Value::DWord(!double),
        };
        bench.plc.write(element, other).unwrap();
    }
    bench.plc.run();
    let before = bench.snapshot();
    bench.clear_log();
    (bench, backup, before)
}

fn options() -> RestoreOptions {
    RestoreOptions::new().stop_first(true).run_again(true)
}

/// Checks that a report is true.
fn check(report: &RestoreReport, bench: &Bench, backup: &Backup, note: &str) {
    let holds = |element: Element| Some(Ok(bench.plc.read(element))) == backup.value(element);
    let all = |ranges: &[Tag], expected: bool| {
        ranges
            .iter()
            .flat_map(Tag::elements)
            .for_each(|element| assert_eq!(holds(element), expected, "{element}, {note}"));
    };
    all(&report.written, true);
    all(&report.unwritten, false);
    let named =
        [&report.written, &report.unwritten, &report.in_doubt].map(|ranges| ranges.iter().flat_map(Tag::elements));
    let named: Vec<_> = named.into_iter().flatten().collect();
    assert_eq!(named.iter().collect::<HashSet<_>>().len(), named.len(), "{note}");
    assert_eq!(named.len(), report.differences.len(), "{note}");
}

fn check_end(bench: &Bench, backup: &Backup, before: &[(Element, Value)], note: &str) {
    let mut restored: HashSet<Element> = tags(["R0-R150", "M0-M19"]).iter().flat_map(Tag::elements).collect();
    restored.extend(tags(["D10-D21"])[0].elements());
    for (element, value) in backup.elements() {
        assert_eq!(Ok(bench.plc.read(element)), value, "{element}, {note}");
    }
    for (element, value) in before.iter().filter(|(element, _)| !restored.contains(element)) {
        assert_eq!(bench.plc.read(*element), *value, "{element}, {note}");
    }
}

/// Number of requests of an undisturbed restore.
async fn requests(framing: Framing) -> u64 {
    let (bench, backup, before) = prepare(framing).await;
    let report = bench.station().restore(&backup, options()).await.unwrap();
    check_end(&bench, &backup, &before, "undisturbed");
    assert!(report.was_stopped && bench.plc.is_running());
    bench.faults.log().arrivals()
}

#[tokio::test(start_paused = true)]
async fn a_restore_interrupted_at_any_request_can_be_resumed() {
    for framing in FRAMINGS {
        let all = requests(framing).await;
        assert!(all > 20, "{all}");
        for fault in [Fault::Ignore, Fault::DropReply, Fault::Disconnect(DisconnectAt::BeforeReply)] {
            for at in 0..all {
                let note = format!("{framing}, {fault:?} at {at}");
                let (bench, backup, before) = prepare(framing).await;
                // The fault decides whether the request is executed. After it the PLC does not
                // answer.
                bench.faults.set_rules([
                    Rule::new(fault.clone()).skip(at).times(1),
                    Rule::new(Fault::Ignore).skip(at + u64::from(fault != Fault::Ignore)),
                ]);
                let mut restore = Restore::new(&backup, options());
                let error = restore.run(&bench.station()).await.unwrap_err();
                check(&error.report, &bench, &backup, &note);
                let written = error.report.written.iter().map(Tag::element_count).sum::<usize>();
                assert!(error.to_string().contains(&format!("{written} written")), "{error}, {note}");
                assert!(!bench.plc.is_running() || written == 0 || written == backup.element_count(), "{note}");

                bench.faults.set_rules([]);
                if at % 2 == 0 {
                    // Another process has not seen the PLC run.
                    let was_running = bench.plc.is_running();
                    bench.station().restore(&backup, options()).await.unwrap();
                    assert_eq!(bench.plc.is_running(), was_running, "{note}");
                } else {
                    let report = restore.run(&bench.station()).await.unwrap();
                    assert!(bench.plc.is_running() && report.plc == fatek::program::PlcState::Running, "{note}");
                }
                check_end(&bench, &backup, &before, &note);
            }
        }
    }
}

#[tokio::test(start_paused = true)]
async fn a_restore_dropped_at_any_request_can_be_resumed() {
    for framing in FRAMINGS {
        for at in 1..=requests(framing).await {
            let note = format!("{framing}, dropped at {at}");
            let (bench, backup, before) = prepare(framing).await;
            let (mut restore, station) = (Restore::new(&backup, options()), bench.station());
            let log = bench.faults.log();
            let dropped = tokio::select! {
                biased;
                () = async { while log.arrivals() < at { tokio::task::yield_now().await } } => true,
                ended = restore.run(&station) => { ended.unwrap(); false },
            };
            assert!(dropped, "{note}");
            // The request in flight is executed, so it is in doubt.
            tokio::time::sleep(std::time::Duration::from_millis(10)).await;
            check(&restore.report(), &bench, &backup, &note);
            restore.run(&station).await.unwrap();
            assert!(bench.plc.is_running(), "{note}");
            check_end(&bench, &backup, &before, &note);
        }
    }
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_write_is_verified_before_it_is_repeated() {
    for framing in FRAMINGS {
        for (fault, sent) in
            [(Fault::DropReply, 1), (Fault::Disconnect(DisconnectAt::BeforeReply), 1), (Fault::Ignore, 2)]
        {
            let (bench, backup, before) = prepare(framing).await;
            bench.faults.set_rules([Rule::new(fault.clone())
                .command(Code::WriteRegisters)
                .elements(element!("R64"), 64)
                .times(1)]);
            let report = bench.station().restore(&backup, RestoreOptions::new()).await.unwrap();
            let writes = bench.writes();
            let repeated = writes.iter().filter(|(first, _)| *first == element!("R64")).count();
            assert_eq!(repeated, sent, "{fault:?}, {writes:?}");
            assert!(bench.faults.log().repeated().is_empty(), "{fault:?}");
            assert_eq!(report.written, tags(["R0-R150", "DD10-DD20", "M0-M19"]));
            check_end(&bench, &backup, &before, "lost once");
        }
        // Attempts are limited.
        let (bench, backup, _) = prepare(framing).await;
        bench.faults.set_rules([Rule::new(Fault::Ignore).command(Code::WriteDiscretes)]);
        let error = bench.station().restore(&backup, RestoreOptions::new().attempts(2)).await.unwrap_err();
        assert!(error.to_string().starts_with("writing M0-M19: station 1 did not answer"), "{error}");
        assert_eq!(error.report.in_doubt, tags(["M0-M19"]));
        assert_eq!(bench.writes().iter().filter(|(first, _)| *first == element!("M0")).count(), 2);
        check(&error.report, &bench, &backup, "given up");
    }
}
