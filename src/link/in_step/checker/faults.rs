//! The sets of faults, and the tests.

use std::time::Duration;

use super::client::{Ablation, Wrong};
use super::model::{Faults, LoopBack};
use super::requests::Name;
use super::{is_full, report};
use crate::endpoint::InStepSettings;
use crate::link::in_step::{Prices, Rule};

use Name::{One, Page, Read, Run, Status, Write};

const ALL_CALLS: [Name; 6] = [Read, One, Write, Page, Run, Status];

const NONE: Faults = Faults {
    name: "none",
    copies: 0,
    again: false,
    roam: false,
    loss: 0,
    late: 0,
    left: 0,
    broadcasts: 0,
    reconnects: 0,
    loopback: LoopBack::Known,
    calls: &[Read, Write, Page],
    lacks: false,
    job: None,
};
const LEFT: Faults = Faults { name: "2 left over", left: 2, ..NONE };
const LATE: Faults = Faults { name: "late", late: 1, calls: &ALL_CALLS, ..NONE };
const BROADCAST: Faults = Faults { name: "answered broadcast", broadcasts: 1, calls: &[Read, Write, Run], ..NONE };
const COPIES: Faults = Faults { name: "2 copies", copies: 2, ..NONE };
const COPY_LOSS: Faults =
    Faults { name: "copy + loss", copies: 1, loss: 1, calls: &[Read, One, Write, Run], lacks: true, ..NONE };
const AGAIN: Faults = Faults { name: "2 copies, asked again", again: true, ..COPIES };
const RECONNECT: Faults =
    Faults { calls: &[Read, Write], name: "lost connection, copy, late", copies: 1, late: 1, reconnects: 1, ..NONE };
const ALL: Faults = Faults {
    name: "all, in order",
    copies: 1,
    loss: 1,
    late: 1,
    left: 1,
    broadcasts: 1,
    calls: &[Read, Write],
    ..NONE
};
const ALL_AGAIN: Faults = Faults { name: "all, asked again", again: true, ..ALL };
const ALL_PAGES: Faults = Faults { name: "all, asked again, pages", late: 0, calls: &[Page, Run], ..ALL_AGAIN };
const LEFT_3: Faults = Faults { name: "3 left over", left: 3, ..NONE };
const NO_4E: Faults = Faults {
    name: "no 4E: late, copy, loss",
    copies: 1,
    loss: 1,
    late: 2,
    loopback: LoopBack::Refused,
    calls: &[Read, Status],
    ..NONE
};
const NO_4E_LEFT: Faults =
    Faults { name: "no 4E: 3 left over", left: 3, loopback: LoopBack::Refused, calls: &[Read, Write, Status], ..NONE };
const SILENT_4E: Faults =
    Faults { name: "4E unanswered: late, copy", late: 1, loopback: LoopBack::Unanswered, ..NO_4E };
const SILENT_4E_LEFT: Faults =
    Faults { name: "4E unanswered: 3 left over", loopback: LoopBack::Unanswered, ..NO_4E_LEFT };
const NO_4E_AT_TIMES: Faults = Faults {
    name: "4E at times: late, copy, left",
    copies: 1,
    late: 1,
    left: 1,
    loopback: LoopBack::AtTimes,
    calls: &[Read, Write, Status],
    ..NONE
};
const ROAM: Faults = Faults { name: "1 roaming copy", copies: 1, roam: true, calls: &[Read, Write, Run], ..NONE };
const ROAM_2: Faults = Faults { name: "2 roaming copies", copies: 2, calls: &[Read, Run], ..ROAM };
const ROAM_3: Faults = Faults { name: "1 roaming copy, 3 remembered", calls: &[Read, Run], ..ROAM };
const JOB: Faults = Faults { name: "job: 1 roaming copy", job: Some(Read), calls: &[Write], ..ROAM };
const JOB_ALONE: Faults = Faults { name: "job alone: 1 roaming copy", calls: &[], ..JOB };
const JOB_ORDERED: Faults =
    Faults { name: "job: copy, loss, asked again", roam: false, loss: 1, again: true, ..JOB_ALONE };
const JOB_OF_PAGES: Faults = Faults { name: "job of pages: 1 roaming copy", job: Some(Page), ..JOB_ALONE };

/// The rule on a serial line of 115200 bit/s, or on a network.
pub(super) fn rule(serial: bool, copies: u8) -> Rule {
    let byte = if serial { Duration::from_micros(87) } else { Duration::ZERO };
    let exchange = byte * 16 + Duration::from_millis(5);
    let settings = InStepSettings::default().with_copies(copies).unwrap();
    Rule {
        settings,
        quiet: settings.quiet(),
        one_request: false,
        prices: Prices { byte, exchange },
        busy: Duration::ZERO,
    }
}

fn is_sound(name: &str, faults: &Faults, rule: Rule) {
    let calls: &[Name] = if faults.job.is_some() { &[Write, Run] } else { &ALL_CALLS };
    let full = Faults { calls, lacks: true, ..*faults };
    let verdict = report(name, if is_full() { &full } else { faults }, rule, Ablation::Nothing, 1);
    assert!(verdict.found.is_empty() && !verdict.cut, "{name}, {}", faults.name);
}

#[test]
fn late_and_left_over_replies_are_given_to_no_request() {
    for faults in [&LEFT, &LATE, &BROADCAST, &LEFT_3, &RECONNECT] {
        is_sound("network", faults, rule(false, 1));
    }
    is_sound("serial", &LATE, rule(true, 1));
}

#[test]
fn copies_in_order_are_given_to_no_request() {
    for faults in [&COPIES, &COPY_LOSS, &AGAIN] {
        is_sound("network", faults, rule(false, 1));
        is_sound("serial", faults, rule(true, 1));
    }
}

#[test]
fn all_faults_in_order_together_give_no_wrong_result() {
    for faults in [&ALL, &ALL_AGAIN, &ALL_PAGES] {
        is_sound("network", faults, rule(false, 1));
    }
}

#[test]
fn a_device_without_loop_back_gives_no_wrong_result() {
    for faults in [&NO_4E, &NO_4E_LEFT, &NO_4E_AT_TIMES] {
        is_sound("serial", faults, rule(true, 1));
    }
    is_sound("one request", &RECONNECT, Rule { one_request: true, ..rule(false, 1) });
}

#[test]
fn a_device_that_does_not_answer_the_loop_back_gives_no_wrong_result() {
    for faults in [&SILENT_4E, &SILENT_4E_LEFT] {
        is_sound("serial", faults, rule(true, 1));
        is_sound("network", faults, rule(false, 1));
    }
}

#[test]
fn a_roaming_copy_gives_one_wrong_result_and_no_shift() {
    let verdict = report("network", &ROAM, rule(false, 1), Ablation::Nothing, 4);
    assert!(verdict.most <= 1 && !verdict.cut);
    // A duplicate of a refusal that was dropped without proof is not remembered.
    let verdict = report("3 remembered", &ROAM_3, rule(false, 3), Ablation::Nothing, 4);
    assert!(verdict.most <= 1 && verdict.found.keys().all(|&wrong| wrong == Wrong::Refusal) && !verdict.cut);
    report("network", &ROAM_2, rule(false, 1), Ablation::Nothing, 4);
}

#[test]
fn a_job_gives_out_no_reply_of_a_roaming_copy() {
    is_sound("network", &JOB, rule(false, 1));
    is_sound("serial", &JOB_ALONE, rule(true, 1));
    is_sound("network", &JOB_ORDERED, rule(false, 1));
}

/// Before, a stray equal to the page taken last always passed for its duplicate, and a shift among equal
/// pages was not noticed.
#[test]
fn a_job_of_equal_pages_gives_out_no_page_of_a_roaming_copy() {
    is_sound("network", &JOB_OF_PAGES, rule(false, 1));
    is_sound("serial", &JOB_OF_PAGES, rule(true, 1));
}

#[test]
fn every_ingredient_of_the_rule_is_needed() {
    let ablations: [(Ablation, &Faults, bool); 14] = [
        (Ablation::Suspicion, &LEFT, false),
        (Ablation::Timeout, &LATE, false),
        (Ablation::Broadcast, &BROADCAST, false),
        (Ablation::Separation, &COPIES, false),
        (Ablation::FreshNonce, &LEFT, false),
        (Ablation::EverySize, &COPIES, true),
        (Ablation::OtherAnswer, &AGAIN, true),
        (Ablation::Proof, &COPIES, false),
        (Ablation::Echo, &NO_4E_LEFT, false),
        (Ablation::Silence, &NO_4E_LEFT, false),
        (Ablation::Silence, &SILENT_4E_LEFT, false),
        (Ablation::Strays, &JOB, false),
        (Ablation::IdleInput, &JOB, false),
        (Ablation::Confirmation, &JOB, false),
    ];
    let mut missed = Vec::new();
    for (ablation, faults, serial) in ablations {
        let verdict = report(&format!("without {ablation:?}"), faults, rule(serial, 1), ablation, 1);
        if verdict.found.is_empty() {
            missed.push((ablation, faults.name));
        }
    }
    assert!(missed.is_empty(), "{missed:?}");
    // A frame that is not read before a request is sent is read as a stray after it: no wrong
    // result.
    report("without ReadFirst", &COPIES, rule(false, 1), Ablation::ReadFirst, 1);
}
