//! Contradictions that need sockets. No time is measured.

use std::time::Duration;

use fatek::Endpoint;
use fatek::sim::{Bus, Fault, Faults, Line, Plc, Rule, UdpServer};
use fatek::wire::Framing;

use crate::doctor::check::{Choice, Finding, Verdict};
use crate::doctor::checks::{Numbers, all};
use crate::doctor::request::Requests;
use crate::doctor::run::{Pace, Runner};

/// The findings of the checks that are for UDP alone.
async fn examine(faults: Faults, prepare: impl FnOnce(&UdpServer)) -> Vec<(String, Finding)> {
    let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_faults(faults);
    let server = UdpServer::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
    prepare(&server);
    let endpoint = Endpoint::udp("127.0.0.1", server.local_addr().port());
    let requests = Requests { framing: Framing::Ascii, station: 1 };
    let numbers = Numbers { connections: 2, idle: Duration::from_secs(1), load: 3, element: None };
    let mut checks = all(requests, &numbers);
    checks.retain(|check| super::contradictions::OF_UDP.contains(&&check.name[..]) || check.name == "registers-46");
    let choice = Choice { load: true, ..Choice::default() };
    let pace = Pace { timeout: Duration::from_secs(20), interval: Duration::from_millis(1) };
    let mut runner = Runner::new(endpoint, requests, &checks, choice, pace);
    runner.run(|_, _| {}).await.unwrap();
    let findings = checks.iter().zip(&runner.examined);
    let findings = findings.map(|(check, examined)| (check.name.clone(), examined.as_ref().unwrap().finding.clone()));
    let findings = findings.collect();
    server.shutdown().await;
    findings
}

fn contradicted(findings: &[(String, Finding)]) -> Vec<&str> {
    super::contradicted(findings)
}

#[tokio::test]
async fn datagrams_are_examined_over_udp() {
    let slow = || Faults::new(1).line(Line::new(0).response_time(Duration::from_millis(50), Duration::from_millis(50)));
    let plain = examine(slow(), |_| {}).await;
    assert!(plain.iter().all(|(_, finding)| finding.verdict == Verdict::Holds), "{plain:#?}");

    let split = Fault::Split { pieces: 2, pause: Duration::from_millis(1) };
    let found = examine(slow().rule(Rule::new(split).times(1)), |_| {}).await;
    assert_eq!(contradicted(&found), ["one-datagram"], "{found:#?}");

    let found = examine(slow(), |server| server.answer_last_sender(true)).await;
    assert_eq!(contradicted(&found), ["asking-port"], "{found:#?}");

    let found = examine(slow(), |server| server.answer_from_other_port(true)).await;
    assert_eq!(contradicted(&found), ["own-port"], "{found:#?}");
}
