//! PLCs that fall silent, and writes that are interrupted.

use std::future::Future as _;
use std::task::{Context, Poll};

use fatek::command::Code;
use fatek::sim::{Fault, Rule};
use fatek::wire::Framing;
use fatek::{Value, register};

use super::rig::{Rig, contradicted};
use crate::doctor::check::{Choice, Verdict};
use crate::doctor::run::End;

#[tokio::test(start_paused = true)]
async fn a_plc_that_falls_silent_leaves_the_findings_so_far() {
    let rig = Rig::new(Framing::Ascii);
    rig.faults.add_rule(Rule::new(Fault::Ignore).skip(30));
    let (findings, ended) = rig.run().await;
    assert!(matches!(ended, Err(End::Silent)), "{ended:?}");
    let count = |verdict| findings.iter().filter(|(_, finding)| finding.verdict == verdict).count();
    assert!(count(Verdict::Holds) >= 10, "{findings:#?}");
    assert!(count(Verdict::Open) >= 30, "{findings:#?}");
    assert_eq!(contradicted(&findings), [""; 0]);
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_never_answers_ends_the_examination() {
    let rig = Rig::new(Framing::Binary);
    rig.faults.add_rule(Rule::new(Fault::Ignore));
    let (findings, ended) = rig.run().await;
    assert!(matches!(ended, Err(End::Silent)), "{ended:?}");
    assert!(findings.iter().all(|(_, finding)| finding.verdict == Verdict::Open));
}

#[tokio::test(start_paused = true)]
async fn a_plc_that_refuses_connections_later_is_lost() {
    let rig = Rig::new(Framing::Ascii);
    rig.faults.add_rule(Rule::new(Fault::Disconnect(fatek::sim::DisconnectAt::AfterReply)).skip(30));
    rig.faults.add_rule(Rule::new(Fault::Refuse).skip(1));
    let (findings, ended) = rig.run().await;
    assert!(matches!(ended, Err(End::Lost(_))), "{ended:?}");
    assert!(findings.iter().any(|(_, finding)| finding.verdict == Verdict::Holds));
}

#[tokio::test(start_paused = true)]
async fn a_value_that_was_written_is_restored_at_any_interruption() {
    let rig = || {
        let mut rig = Rig::new(Framing::Ascii);
        rig.choice = Choice { write: true, ..Choice::default() };
        rig.choice.quick = true;
        rig.plc.write(register!("R3000"), 77_u16).unwrap();
        rig
    };
    // The writes are the last requests of an examination.
    let (all, _) = rig().interrupt(usize::MAX).await;
    let mut interrupted_after_write = 0;
    for polls in all.saturating_sub(120)..all {
        let rig = rig();
        let (_, was_written) = rig.interrupt(polls).await;
        assert_eq!(rig.plc.read(register!("R3000")), Value::Word(77), "after {polls} of {all} polls");
        interrupted_after_write += usize::from(was_written);
    }
    assert!(interrupted_after_write > 5, "{interrupted_after_write} of {all}");
}

#[tokio::test(start_paused = true)]
async fn a_lost_connection_after_the_write_does_not_leave_the_value() {
    let mut rig = Rig::new(Framing::Ascii);
    rig.choice.write = true;
    rig.plc.write(register!("R3000"), 77_u16).unwrap();
    rig.faults.add_rule(Rule::new(Fault::DropReply).command(Code::WriteRegisters).times(1));
    let (findings, ended) = rig.run().await;
    assert!(ended.is_ok(), "{ended:?}");
    assert_eq!(rig.plc.read(register!("R3000")), Value::Word(77));
    assert_eq!(contradicted(&findings), ["write-47"]);
}

impl Rig {
    /// Drops the examination after this number of polls, and undoes. Returns the number of polls, and whether the
    /// value differed then.
    async fn interrupt(&self, most: usize) -> (usize, bool) {
        let (mut polls, mut differed) = (0, false);
        self.with_runner(async |runner, plc| {
            let mut running = Box::pin(runner.run(|_, _| {}));
            let done = std::future::poll_fn(|cx: &mut Context<'_>| {
                if polls == most {
                    return Poll::Ready(());
                }
                polls += 1;
                running.as_mut().poll(cx).map(drop)
            });
            done.await;
            drop(running);
            differed = plc.read(register!("R3000")) != Value::Word(77);
            assert_eq!(runner.undo().await, Ok(()));
        })
        .await;
        (polls, differed)
    }
}
