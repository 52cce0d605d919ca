//! Backups and restores with one roaming duplicate, at each request in turn.

use fatek::backup::RestoreOptions;
use fatek::command::Value;
use fatek::element::Register;
use fatek::sim::{Bus, Plc};

use crate::bench::tags;
use crate::roaming::RoamingLine;

fn plc() -> Plc {
    let plc = Plc::new();
    for address in 0..640 {
        plc.write(Register::r(address), address ^ 0x5A5A).unwrap();
    }
    plc
}

fn line(plc: &Plc, from: usize) -> RoamingLine {
    RoamingLine::new(Bus::new().with_station(1, plc.clone()).unwrap(), from)
}

/// Without jobs this gave 764 wrong values of 8255.
#[tokio::test(start_paused = true)]
async fn no_value_of_a_backup_is_a_roaming_duplicate() {
    let (mut copies, mut wrong) = (0, 0);
    for from in 1..=13 {
        let line = line(&plc(), from);
        // The last request has 63 registers, like others.
        let backup = line.station.back_up(tags(["R0-R634"])).await.unwrap();
        assert!(backup.is_complete());
        let is_wrong = |&(element, value): &(fatek::Element, Result<Value, _>)| {
            value != Ok(Value::Word(element.address() ^ 0x5A5A))
        };
        wrong += backup.elements().filter(is_wrong).count();
        copies += line.copies();
    }
    assert_eq!(wrong, 0, "with {copies} copies");
    assert!(copies >= 10, "{copies}");
}

/// Without jobs 16 of the 40 restores failed.
#[tokio::test(start_paused = true)]
async fn a_roaming_duplicate_does_not_spoil_a_restore() {
    let backup = line(&plc(), usize::MAX).station.back_up(tags(["R0-R639"])).await.unwrap();
    let (mut copies, mut wrong, mut failed) = (0, 0, 0);
    for from in 1..=40 {
        let plc = plc();
        // Other values in every other hundred.
        for address in (0..640).filter(|address| address / 100 % 2 == 1) {
            plc.write(Register::r(address), address).unwrap();
        }
        plc.run();
        let line = line(&plc, from);
        let options = RestoreOptions::new().stop_first(true).run_again(true);
        match line.station.restore(&backup, options).await {
            Ok(report) => assert!(report.in_doubt.is_empty() && report.remaining.is_empty(), "{report}"),
            Err(error) => {
                println!("from request {from}: {error}");
                failed += 1;
            }
        }
        copies += line.copies();
        let wrong_now = (0..640).filter(|&address| plc.read(Register::r(address)) != Value::Word(address ^ 0x5A5A));
        wrong += usize::from(wrong_now.count() > 0);
        assert!(failed > 0 || plc.is_running(), "from request {from}");
    }
    assert_eq!((wrong, failed), (0, 0), "with {copies} copies");
    assert!(copies >= 30, "{copies}");
}
