//! Declared lengths: a device that takes shorter requests than the protocol gets no longer ones.

use fatek::backup::{Missing, MissingRange, RestoreOptions};
use fatek::command::Code;
use fatek::sim::{Fault, Faults, Rule};
use fatek::{Capabilities, Element, ErrorCode, Station, discrete, element};

use crate::bench::{Bench, FRAMINGS, Rng, tags};

const MAX_POINTS: usize = 20;
const MAX_REGISTERS: usize = 10;

/// Refuses every longer request, and counts them. A length of 49 cannot be declared.
fn limit(bench: &Bench) {
    let refuse = |code, most| Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(code).longer_than(most);
    bench.faults.set_rules([
        refuse(Code::ReadDisabled, MAX_POINTS),
        refuse(Code::ReadDiscretes, MAX_POINTS),
        refuse(Code::WriteDiscretes, MAX_POINTS),
        refuse(Code::ReadRegisters, MAX_REGISTERS),
        refuse(Code::WriteRegisters, MAX_REGISTERS),
        refuse(Code::ReadMixed, MAX_REGISTERS),
    ]);
}

fn refused(bench: &Bench) -> u64 {
    bench.faults.rules().iter().map(Rule::times_applied).sum()
}

/// A station that is declared to take no longer requests.
fn declared(bench: &Bench) -> Station {
    let station = bench.station();
    let lengths = Capabilities::new().with_max_points(MAX_POINTS).unwrap();
    let lengths = lengths.with_max_registers(MAX_REGISTERS).unwrap().with_max_mixed(MAX_REGISTERS).unwrap();
    station.set_capabilities(lengths);
    station
}

/// Before, a backup and a restore sent 64 registers and 256 discretes, of which each request was refused
/// and halved.
#[tokio::test(start_paused = true)]
async fn a_backup_and_a_restore_keep_to_declared_lengths() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        bench.fill(&mut Rng(1));
        limit(&bench);
        let station = declared(&bench);
        // Registers, values of two and four of them, double words, discretes, and words of discretes.
        let ranges = tags(["R0-R99", "R201-R260:f32", "D1-D64:f64", "DR300-DR398", "M0-M99", "WM160-WM320", "Y0-Y9"]);
        let backup = station.back_up(ranges).await.unwrap();
        assert_eq!((refused(&bench), backup.is_complete()), (0, true), "{framing}");
        for (element, cell) in backup.elements() {
            assert_eq!(cell, Ok(bench.plc.read(element)), "{element}");
        }
        bench.fill(&mut Rng(2));
        station.disable(discrete!("M200")).await.unwrap();
        let report = station.restore(&backup, RestoreOptions::new().bridge(64)).await.unwrap();
        assert_eq!(refused(&bench), 0, "{framing}: {report}");
        assert_eq!(report.forced, tags(["WM192"]));
        for (element, cell) in backup.elements().filter(|(element, _)| *element != element!("WM192")) {
            assert_eq!(cell, Ok(bench.plc.read(element)), "{element}");
        }
        // Without the declaration each long request is refused and halved.
        let other = bench.station().back_up(tags(["R0-R99"])).await.unwrap();
        assert!(refused(&bench) > 0 && other.is_complete(), "{framing}");
    }
}

/// A value is never split: one that is longer than a request is asked for whole, and missing.
#[tokio::test(start_paused = true)]
async fn a_value_longer_than_declared_is_missing() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, Faults::new(1));
        let refuse = |code| Rule::new(Fault::Error(ErrorCode::IllegalValue)).command(code).longer_than(2);
        bench.faults.set_rules([refuse(Code::ReadRegisters), refuse(Code::ReadMixed)]);
        let station = bench.station();
        station.set_capabilities(Capabilities::new().with_max_registers(2).unwrap().with_max_mixed(2).unwrap());
        let backup = station.back_up(tags(["R0-R11:f64", "D0-D11:f32"])).await.unwrap();
        let reason = Missing::Refused(ErrorCode::IllegalValue);
        let missing: Vec<_> =
            backup.missing().iter().map(|MissingRange { range, reason, .. }| (*range, *reason)).collect();
        assert_eq!(missing, [("R0-R11".parse().unwrap(), reason)], "{framing}");
        let is_long = |element: Element| element.symbol() == element!("R0").symbol();
        assert!(backup.elements().all(|(element, cell)| cell.is_err() == is_long(element)));
    }
}
