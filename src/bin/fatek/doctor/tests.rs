//! Examinations of simulated PLCs: each contradiction is found by its check, and by no other.
//!
//! In memory and with a paused clock: timeouts take no time, and no test depends on the machine's speed.

mod contradictions;
mod ends;
mod lines;
mod rig;
mod udp;

use fatek::wire::Framing;

use self::rig::{Rig, contradicted};
use super::check::Verdict;

#[tokio::test(start_paused = true)]
async fn a_simulated_plc_contradicts_nothing() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let examined = Rig::new(framing).examine().await;
        assert_eq!(contradicted(&examined), [""; 0], "{framing}: {examined:#?}");
        let holds = examined.iter().filter(|(_, finding)| finding.verdict == Verdict::Holds).count();
        assert!(holds > 55, "{framing}: {holds} of {}: {examined:#?}", examined.len());
    }
}

#[tokio::test(start_paused = true)]
async fn a_plc_whose_memory_is_all_zeros_contradicts_nothing() {
    let rig = Rig::with_plc(Framing::Ascii, fatek::sim::Plc::new());
    let examined = rig.examine().await;
    assert_eq!(contradicted(&examined), [""; 0]);
    // Equal values show no order.
    for name in ["bits-of-words", "mixed-order", "dword-order", "drc-run", "drc-mixed"] {
        let (_, finding) = examined.iter().find(|(check, _)| check == name).unwrap();
        assert_eq!(finding.verdict, Verdict::Open, "{name}: {finding:?}");
    }
}

#[tokio::test(start_paused = true)]
async fn no_check_asks_more_than_it_states_nor_anything_that_writes() {
    let rig = Rig::new(Framing::Ascii);
    let examined = rig.examine().await;
    assert!(examined.len() > 70, "{}", examined.len());
    let log = rig.faults.log();
    assert_eq!(log.writes(), 0);
    assert!(log.changes(1).is_empty(), "{:?}", log.changes(1));
    // The requests that the estimate has, the loop-backs behind silences, and the first status.
    let stated: usize = rig.checks().iter().map(|check| check.usual + 2 * check.silences).sum();
    assert!(log.entries().len() <= stated + 40, "{} of {stated}", log.entries().len());
}
