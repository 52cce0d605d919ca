//! Lines with losses and duplicates, values that change, and modules with few connections: they contradict no
//! assumption but their own.

use std::time::Duration;

use fatek::command::Code;
use fatek::sim::{Fault, Line, Rule, Timing};
use fatek::wire::Framing;
use fatek::{Value, register};

use super::rig::{Rig, contradicted};
use crate::doctor::check::{Finding, Verdict};

const fn ms(ms: u64) -> Duration {
    Duration::from_millis(ms)
}

fn finding<'f>(findings: &'f [(String, Finding)], name: &str) -> &'f Finding {
    findings.iter().find(|(check, _)| check == name).map(|(_, finding)| finding).unwrap()
}

/// A PLC of which R3000 is 77 and may be written.
fn writable() -> Rig {
    let mut rig = Rig::new(Framing::Ascii);
    rig.choice.write = true;
    rig.plc.write(register!("R3000"), 77_u16).unwrap();
    rig
}

/// Before, the restore was sent once: R3000 stayed 23272, and nothing was reported.
#[tokio::test(start_paused = true)]
async fn a_restore_that_is_lost_is_repeated() {
    let rig = writable();
    rig.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteRegisters).skip(1).times(1));
    let findings = rig.examine().await;
    assert_eq!(rig.plc.read(register!("R3000")), Value::Word(77));
    assert_eq!(contradicted(&findings), [""; 0]);
    assert_eq!(finding(&findings, "write-49").verdict, Verdict::Holds);
}

/// Before, the undo had nothing to restore, and the next check took 23272 as the value to restore.
#[tokio::test(start_paused = true)]
async fn an_element_that_is_not_restored_is_reported() {
    let rig = writable();
    rig.faults.add_rule(Rule::new(Fault::Ignore).command(Code::WriteRegisters).skip(1));
    let other = rig.checks().iter().position(|check| check.name == "write-49").unwrap();
    rig.with_runner(async |runner, plc| {
        assert!(runner.run(|_, _| {}).await.is_ok());
        let finding = &runner.examined[other].as_ref().unwrap().finding;
        assert_eq!(*finding, Finding::open("not examined: the element was not restored"));
        assert_eq!(plc.read(register!("R3000")), Value::Word(77 ^ 0x5AA5));
        let undo = runner.undo().await.unwrap_err();
        assert_eq!(undo.assignment, "R3000=77");
    })
    .await;
}

/// Before, the copy of a reply was taken as the next reply: 20 checks were contradicted, such as own-command, gap-r
/// and end-words.
#[tokio::test(start_paused = true)]
async fn duplicates_on_a_slow_line_contradict_their_checks_alone() {
    let rig = Rig::new(Framing::Ascii);
    rig.faults.set_line(Line::new(0).response_time(ms(60), ms(60)));
    rig.faults.add_rule(Rule::new(Fault::Duplicate(Timing::After { min: ms(5), max: ms(5) })));
    assert_eq!(contradicted(&rig.examine().await), ["once", "without-pause"]);
}

/// Before, drc-mixed was contradicted with the first seed.
#[tokio::test(start_paused = true)]
async fn changing_values_contradict_nothing() {
    for seed in 0..8 {
        let rig = Rig::new(Framing::Ascii);
        for (tag, movement) in [
            ("DRC201", "random(0..100000,20ms)"),
            ("M0", "square(0..1,130ms)"),
            ("R0", "random(0..3,70ms)"),
            ("Y9", "square(0..1,110ms)"),
        ] {
            let movement: fatek::sim::Movement = movement.parse().unwrap();
            rig.plc.set_movement(tag.parse().unwrap(), movement.with_seed(seed)).unwrap();
        }
        assert_eq!(contradicted(&rig.examine().await), [""; 0], "{seed}");
    }
}

/// Before, each connection was asked as soon as it was open: several held, and stays-open was contradicted later.
#[tokio::test(start_paused = true)]
async fn a_connection_that_closes_the_one_before_contradicts_several() {
    let mut rig = Rig::new(Framing::Ascii);
    rig.has_one_connection = true;
    let findings = rig.examine().await;
    assert_eq!(contradicted(&findings), ["several"]);
    assert_eq!(finding(&findings, "several").text, "1 of 3 are answered, 2 refused or closed");
}

/// Before, several was contradicted when its first reply was lost, and idle when its only one was.
#[tokio::test(start_paused = true)]
async fn one_lost_status_contradicts_answered_at_most() {
    for n in 0..25 {
        let rig = Rig::new(Framing::Ascii);
        rig.faults.add_rule(Rule::new(Fault::DropReply).command(Code::ReadStatus).skip(n).times(1));
        let findings = rig.examine().await;
        let others: Vec<_> = contradicted(&findings).into_iter().filter(|name| *name != "answered").collect();
        assert_eq!(others, [""; 0], "reply {n} lost");
    }
}

/// Before, `--connections 9` was contradicted by a module that has 8 as documented.
#[tokio::test(start_paused = true)]
async fn more_than_8_connections_are_a_question() {
    for (served, verdict) in [(8, Verdict::Holds), (7, Verdict::Open), (9, Verdict::Open)] {
        let mut rig = Rig::new(Framing::Ascii);
        rig.connections = 9;
        rig.faults.add_rule(Rule::new(Fault::Refuse).skip(served));
        let findings = rig.examine().await;
        assert_eq!(contradicted(&findings), [""; 0], "{served}");
        assert_eq!(finding(&findings, "several").verdict, verdict, "{served}");
    }
}
