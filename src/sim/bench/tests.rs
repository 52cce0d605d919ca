use std::time::Duration;

use tokio::time::{Instant, sleep};

use super::*;
use crate::command::{Code, ProgramPage, Request, WriteProgramPage};
use crate::sim::{Change, Fault, Rule};
use crate::{ErrorCode, discrete, element, register, register32};

#[tokio::test(start_paused = true)]
async fn a_bench_is_connected_and_takes_no_time() {
    let began = Instant::now();
    let bench = station().await;
    assert_eq!(began.elapsed(), Duration::ZERO);
    assert!(matches!(bench.station.link().state(), crate::LinkState::Up));
    assert_eq!((bench.log().arrivals(), bench.log().to_string()), (0, String::new()));
    bench.plc.write(register!("R0"), 5_u16).unwrap();
    assert_eq!(bench.station.read_registers(register!("R0"), 1).await.unwrap(), [5]);
    assert_eq!((bench.log().arrivals(), began.elapsed()), (1, Duration::ZERO));
}

#[tokio::test(start_paused = true)]
async fn benches_are_independent() {
    let (one, other) = (station().await, station().await);
    one.station.run().await.unwrap();
    assert_eq!((one.plc.is_running(), other.plc.is_running()), (true, false));
    assert_eq!((one.log().changes(1), other.log().changes(1)), (vec![Change::Run], vec![]));
}

#[tokio::test(start_paused = true)]
async fn every_write_is_a_change() {
    let bench = station().await;
    let Bench { station, .. } = &bench;
    station.run().await.unwrap();
    station.stop().await.unwrap();
    for discrete in [discrete!("X3"), discrete!("X4")] {
        station.disable(discrete).await.unwrap();
    }
    station.enable(discrete!("X3")).await.unwrap();
    station.set(discrete!("Y0")).await.unwrap();
    station.reset(discrete!("Y0")).await.unwrap();
    station.write_discretes(discrete!("M8"), &[true, false]).await.unwrap();
    station.write_registers(register!("R0"), &[7, 8]).await.unwrap();
    station.write_registers32(register32!("DR10"), &[9, 10]).await.unwrap();
    let mixed = [(element!("WM16"), 11_u16.into()), (element!("S1"), true.into())];
    station.write_mixed(&mixed).await.unwrap();
    let page = ProgramPage::new([0xFB00; 64]);
    station.call(WriteProgramPage::new(3, page.clone())).await.unwrap();
    let changes = [
        Change::Run,
        Change::Stop,
        Change::Disabled(discrete!("X3")),
        Change::Disabled(discrete!("X4")),
        Change::Enabled(discrete!("X3")),
        Change::value(discrete!("Y0"), true),
        Change::value(discrete!("Y0"), false),
        Change::value(discrete!("M8"), true),
        Change::value(discrete!("M9"), false),
        Change::value(register!("R0"), 7_u16),
        Change::value(register!("R1"), 8_u16),
        Change::value(register32!("DR10"), 9_u32),
        Change::value(register32!("DR12"), 10_u32),
        Change::value(element!("WM16"), 11_u16),
        Change::value(element!("S1"), true),
        Change::Page(3, page),
    ];
    assert_eq!(bench.log().changes(1), changes);
    assert_eq!(bench.log().changes(2), []);
}

#[tokio::test(start_paused = true)]
async fn reads_change_nothing() {
    let bench = station().await;
    let Bench { station, .. } = &bench;
    station.read_registers(register!("R0"), 100).await.unwrap();
    station.read_registers32(register32!("DR0"), 2).await.unwrap();
    station.read_discretes(discrete!("M0"), 8).await.unwrap();
    station.read_disabled(discrete!("M0"), 8).await.unwrap();
    station.read_mixed(&[element!("R0"), element!("X0")]).await.unwrap();
    station.read_status().await.unwrap();
    station.read_detailed_status().await.unwrap();
    station.call(crate::command::ReadProgramPage::new(0)).await.unwrap();
    station.loop_back("ping").await.unwrap();
    assert!(bench.log().arrivals() >= 10);
    assert_eq!(bench.log().changes(1), []);
}

#[tokio::test(start_paused = true)]
async fn equal_writes_are_equal_changes_in_either_spelling() {
    let bench = station().await;
    for _ in 0..4 {
        bench.station.write_registers(register!("R0"), &[7]).await.unwrap();
    }
    let codes = bench.log().entries().into_iter().filter_map(|entry| entry.request().map(Request::code));
    let codes: Vec<Code> = codes.collect();
    assert!(codes.contains(&Code::WriteRegisters) && codes.contains(&Code::WriteMixed), "{codes:?}");
    assert_eq!(bench.log().changes(1), vec![Change::value(register!("R0"), 7_u16); 4]);
}

#[tokio::test(start_paused = true)]
async fn refused_and_lost_writes_change_nothing() {
    let bench = station().await;
    for (fault, changes) in [
        (Fault::Error(ErrorCode::WriteProhibited), &[][..]),
        (Fault::Ignore, &[]),
        (Fault::DropReply, &[Change::value(register!("R0"), 7_u16)]),
    ] {
        bench.log().clear();
        bench.faults.set_rules([Rule::new(fault.clone()).command(Code::WriteRegisters)]);
        bench.faults.add_rule(Rule::new(fault.clone()).command(Code::WriteMixed));
        bench.station.write_registers(register!("R0"), &[7]).await.unwrap_err();
        assert_eq!(bench.log().changes(1), changes, "{fault:?}");
        bench.faults.set_rules([]);
    }
}

#[tokio::test(start_paused = true)]
async fn a_broadcast_changes_the_stations_that_obey_it() {
    let faults = Faults::new(1).rule(Rule::new(Fault::Ignore).station(2));
    let plcs = [1, 2, 3].map(|_| Plc::new());
    let bus =
        plcs.iter().zip(1..).fold(Bus::new(), |bus, (plc, number)| bus.with_station(number, plc.clone()).unwrap());
    let connector = connector(bus.with_faults(faults.clone()), Framing::Binary);
    let link = Link::connector_builder("bus", Framing::Binary, connector).build();
    link.broadcast().run().await.unwrap();
    sleep(Duration::from_secs(1)).await;
    let log = faults.log();
    let changes = [1, 2, 3].map(|station| log.changes(station));
    assert_eq!(changes, [vec![Change::Run], vec![], vec![Change::Run]]);
    assert_eq!(plcs.map(|plc| plc.is_running()), [true, false, true]);
}

#[tokio::test(start_paused = true)]
async fn writes_that_are_not_in_the_log_are_never_hidden() {
    let bench = station().await;
    let _ = bench.faults.clone().log_capacity(2);
    for value in [1_u16, 2, 3, 4] {
        bench.station.set(discrete!("Y0")).await.unwrap();
        bench.station.write_registers(register!("R0"), &[value]).await.unwrap();
    }
    let changes = bench.log().changes(1);
    let [Change::NotInLog(missing), ..] = changes[..] else { panic!("{changes:?}") };
    assert_eq!(missing + (changes.len() as u64 - 1), 8, "{changes:?}");
    assert_eq!(changes[0].to_string(), format!("{missing} writes that are not in the log"));
    assert!(matches!(bench.log().changes(9)[..], [Change::NotInLog(_)]), "a station without requests");

    let _ = bench.faults.clone().log_capacity(0);
    assert_eq!(bench.log().changes(1), [Change::NotInLog(8)]);
    bench.log().clear();
    assert_eq!(bench.log().changes(1), []);
}

#[tokio::test(start_paused = true)]
async fn changes_are_shown_as_short_texts() {
    let bench = station().await;
    bench.station.run().await.unwrap();
    bench.station.disable(discrete!("X3")).await.unwrap();
    bench.station.write_registers(register!("R0"), &[7]).await.unwrap();
    assert_eq!(format!("{:?}", bench.log().changes(1)), "[run, disable X3, R0 = 7]");
}

#[tokio::test(start_paused = true)]
async fn the_text_of_the_log_has_a_line_for_each_arrival() {
    let bench = station().await;
    bench.plc.run();
    bench.station.stop().await.unwrap();
    bench.faults.set_rules([Rule::new(Fault::DropReply)]);
    sleep(Duration::from_millis(1500)).await;
    let options = crate::CallOptions::new().with_retries(0);
    bench.station.with_options(options).read_registers(register!("R0"), 2).await.unwrap_err();
    let text = "    0.000 s  station 1: control RUN/STOP (41h) stop; executed; 9 bytes in reply\n    \
                1.500 s  station 1: read registers (46h) R0 to R1; executed; no reply; DropReply\n";
    assert_eq!(bench.log().to_string(), text);
    let _ = bench.faults.clone().log_capacity(1);
    let rest = "earlier arrivals: 1\n    0.000 s  station 1: read registers (46h) R0 to R1; executed; no reply; \
                DropReply\n";
    assert_eq!(bench.log().to_string(), rest);
}
