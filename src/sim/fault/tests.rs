use std::time::Duration;

use super::*;
use crate::command::{Code, Value};
use crate::sim::{Bus, Plc, connector};
use crate::wire::Framing;
use crate::{Link, Station, register};

#[tokio::test(start_paused = true)]
async fn a_rule_takes_a_station_offline_and_back_during_use() {
    let (station, faults) = station(Faults::new(1));
    station.write_registers(register!("R0"), &[1]).await.unwrap();
    faults.set_rules([Rule::new(Fault::Ignore).station(1)]);
    assert!(station.write_registers(register!("R0"), &[2]).await.is_err());
    faults.set_rules([]);
    let values = tokio::time::timeout(Duration::from_secs(600), async {
        loop {
            if let Ok(values) = station.read_registers(register!("R0"), 1).await {
                return values;
            }
            tokio::time::sleep(Duration::from_secs(1)).await;
        }
    });
    assert_eq!(values.await.unwrap(), [1]);
}

#[test]
fn kinds_combine_and_the_first_match_of_each_applies() {
    let faults = Faults::new(1)
        .rule(Rule::new(Fault::Truncated { by: 1 }).times(1))
        .rule(Rule::new(Fault::WrongStation))
        .rule(Rule::new(Fault::Truncated { by: 2 }))
        .rule(Rule::new(Fault::Truncated { by: 3 }));
    let befallen = |nth: usize| {
        let decision = faults.decide(&frame(), None, FaultTarget::Station);
        assert_eq!(
            faults.rules().iter().map(Rule::times_applied).sum::<u64>(),
            2 * nth as u64,
            "the others are not evaluated"
        );
        decision.faults
    };
    assert_eq!(befallen(1), [Fault::Truncated { by: 1 }, Fault::WrongStation]);
    assert_eq!(befallen(2), [Fault::WrongStation, Fault::Truncated { by: 2 }]);
    assert_eq!(befallen(3), [Fault::WrongStation, Fault::Truncated { by: 2 }]);
    assert_eq!(faults.rules().iter().map(Rule::times_applied).collect::<Vec<_>>(), [1, 3, 2, 0]);
}

#[test]
fn set_rules_resets_the_counts() {
    let faults = Faults::new(1).rule(Rule::new(Fault::DropReply).times(1));
    let drops = || faults.decide(&frame(), None, FaultTarget::Station).has(&Fault::DropReply);
    assert_eq!([drops(), drops()], [true, false]);
    faults.set_rules(faults.rules());
    assert_eq!([drops(), drops()], [true, false]);
    faults.add_rule(faults.rules().remove(0));
    assert_eq!([drops(), drops()], [true, false]);
}

#[test]
fn only_refuse_rules_apply_to_connections() {
    let faults = Faults::new(1)
        .rule(Rule::new(Fault::DropReply))
        .rule(Rule::new(Fault::Refuse).station(1))
        .rule(Rule::new(Fault::Refuse).skip(1).times(2));
    assert_eq!([0; 5].map(|_| faults.refuse_connection()), [false, true, true, false, false]);
    let rare = Faults::new(1).rule(Rule::new(Fault::Refuse).one_in(4));
    let refused = (0..4000).filter(|_| rare.refuse_connection()).count();
    assert!((900..1100).contains(&refused), "{refused}");
}

/// The guarantees of the module's documentation: with all faults, a value is right or an error,
/// and a write is executed once, or at most once with an error that says so.
#[tokio::test(start_paused = true)]
async fn a_link_never_accepts_a_faulty_reply() {
    for framing in [Framing::Ascii, Framing::Binary] {
        for seed in 0..4 {
            let (successes, failures) = call_with_all_faults(seed, framing).await;
            assert!(successes > 100 && failures > 10, "{framing}, seed {seed}: {successes} and {failures}");
        }
    }
}

async fn call_with_all_faults(seed: u64, framing: Framing) -> (u32, u32) {
    const CALLS: u16 = 300;
    let ms = Duration::from_millis;
    let faults = Faults::new(seed).line(Line::new(115_200).response_time(ms(1), ms(5)));
    faults.set_rules(
        [
            Fault::Ignore,
            Fault::DropReply,
            Fault::Split { pieces: 3, pause: ms(5) },
            Fault::GarbageBefore { max_len: 12 },
            Fault::GarbageInside { max_len: 12 },
            Fault::WrongCommand,
            Fault::Truncated { by: 2 },
            Fault::Extended { by: 4 },
            Fault::BadChecksum,
            Fault::duplicate(),
            Fault::Disconnect(DisconnectAt::BeforeExecution),
            Fault::Disconnect(DisconnectAt::WithinReply),
        ]
        .map(|fault| Rule::new(fault).per_mille(20)),
    );
    // At one station, the two would give a late reply of the other station.
    faults.add_rule(Rule::new(Fault::Delay { min: ms(10), max: ms(1500) }).station(1).per_mille(40));
    faults.add_rule(Rule::new(Fault::WrongStation).station(2).per_mille(40));
    faults.add_rule(Rule::new(Fault::Refuse).one_in(4));
    let plcs = [Plc::new(), Plc::new()];
    for plc in &plcs {
        (0..100).for_each(|n| plc.write(crate::Register::r(100 + n), 7 * n).unwrap());
    }
    let bus = Bus::new().with_station(1, plcs[0].clone()).unwrap().with_station(2, plcs[1].clone()).unwrap();
    let open = connector(bus.with_faults(faults.clone()), framing);
    let link = Link::connector_builder("a bad line", framing, open).offline_after(0).build();
    let (mut successes, mut failures) = (0, 0);
    for nth in 0..CALLS {
        let (plc, station) = (&plcs[usize::from(nth % 2)], link.station(1 + (nth % 2) as u8).unwrap());
        let n = nth % 90;
        let read = station.read_registers(crate::Register::r(100 + n), usize::from(1 + nth % 3)).await;
        if let Ok(values) = &read {
            let expected: Vec<_> = (n..=n + nth % 3).map(|n| 7 * n).collect();
            assert_eq!(*values, expected, "{framing}, seed {seed}, call {nth}");
        }
        let own = crate::Register::d(nth);
        let write = station.write_registers(own, &[nth + 1]).await;
        match &write {
            Ok(()) => assert_eq!(plc.read(own), Value::Word(nth + 1)),
            Err(error) if !error.may_have_executed() => assert_eq!(plc.read(own), Value::Word(0)),
            Err(_) => {}
        }
        for is_ok in [read.is_ok(), write.is_ok()] {
            *(if is_ok { &mut successes } else { &mut failures }) += 1;
        }
    }
    assert_eq!(faults.log().repeated(), [], "{framing}, seed {seed}");
    assert!(faults.rules().iter().all(|rule| rule.times_applied() > 0), "{:?}", faults.rules());
    (successes, failures)
}

fn station(faults: Faults) -> (Station, Faults) {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_faults(faults.clone());
    let link = Link::connector_builder("in memory", Framing::Ascii, connector(bus, Framing::Ascii)).build();
    (link.station(1).unwrap(), faults)
}

fn frame() -> crate::wire::Frame {
    crate::wire::Frame { station: 1, command: Code::ReadStatus.into(), data: bytes::Bytes::new() }
}
