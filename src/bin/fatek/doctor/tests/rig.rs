//! A simulated PLC in memory, and its examination.

use std::io;
use std::time::Duration;

use fatek::clock::Clock;
use fatek::command::Code;
use fatek::sim::{self, Bus, Faults, Line, Plc};
use fatek::wire::Framing;
use fatek::{discrete, element, register};
use tokio::io::{DuplexStream, copy_bidirectional, duplex};
use tokio::task::AbortHandle;

use crate::doctor::check::{Check, Choice, Finding, Verdict};
use crate::doctor::checks::{Numbers, all};
use crate::doctor::line::{Connect, Medium, Wire};
use crate::doctor::request::Requests;
use crate::doctor::run::{End, Pace, Runner};

pub(super) const TIMEOUT: Duration = Duration::from_secs(1);

pub(super) struct Rig {
    pub(super) plc: Plc,
    pub(super) faults: Faults,
    pub(super) framing: Framing,
    pub(super) element: &'static str,
    pub(super) choice: Choice,
    /// A bus without faults is served without a queue.
    pub(super) has_faults: bool,
    /// Connections of the check of several.
    pub(super) connections: usize,
    /// Each new connection closes the one before.
    pub(super) has_one_connection: bool,
}

/// Connections in memory.
pub(super) struct InMemory(Box<dyn FnMut() -> std::future::Ready<io::Result<DuplexStream>>>);

impl Connect for InMemory {
    fn medium(&self) -> Medium {
        Medium::Tcp
    }

    async fn open(&mut self) -> io::Result<Wire> {
        Ok(Wire::Stream(Box::new((self.0)().await?)))
    }
}

/// Connections of which each closes the one before, as of a serial server for one client.
fn one_at_a_time(
    mut connect: impl FnMut() -> std::future::Ready<io::Result<DuplexStream>> + 'static,
) -> Box<dyn FnMut() -> std::future::Ready<io::Result<DuplexStream>>> {
    let mut last: Option<AbortHandle> = None;
    Box::new(move || {
        if let Some(last) = last.take() {
            last.abort();
        }
        let opened = connect().into_inner().map(|mut plc| {
            let (client, mut server) = duplex(4096);
            let forward = async move { copy_bidirectional(&mut server, &mut plc).await };
            last = Some(tokio::spawn(forward).abort_handle());
            client
        });
        std::future::ready(opened)
    })
}

impl Rig {
    /// A PLC whose values are all different, with a clock.
    pub(super) fn new(framing: Framing) -> Self {
        let plc = Plc::new();
        for n in 0..64 {
            plc.write(fatek::Register::r(n), 0x1234_u16.wrapping_mul(n + 1)).unwrap();
        }
        for n in 0..3 {
            let counter = element!("DRC200").nth(n).unwrap();
            plc.write(counter, 70_000 + u32::try_from(n).unwrap()).unwrap();
        }
        plc.write(element!("WM0"), 0x0180_u16).unwrap();
        plc.write(discrete!("Y9"), true).unwrap();
        plc.set_clock(Some(Clock::new((26, 11, 29), (6, 30, 0), 0).unwrap()));
        plc.write(register!("R4135"), 0x061E_u16).unwrap();
        Self::with_plc(framing, plc)
    }

    pub(super) fn with_plc(framing: Framing, plc: Plc) -> Self {
        let line = Line::new(0).response_time(Duration::from_millis(4), Duration::from_millis(9));
        let choice = Choice {
            quick: false,
            load: true,
            idle: Some(Duration::from_secs(60)),
            unknown_commands: true,
            write: false,
        };
        Self {
            plc,
            faults: Faults::new(5).line(line),
            framing,
            element: "R3000",
            choice,
            has_faults: true,
            connections: 3,
            has_one_connection: false,
        }
    }

    fn requests(&self) -> Requests {
        Requests { framing: self.framing, station: 1 }
    }

    pub(super) fn checks(&self) -> Vec<Check> {
        let element = Some(self.element.to_owned());
        all(
            self.requests(),
            &Numbers { connections: self.connections, idle: Duration::from_secs(60), load: 12, element },
        )
    }

    /// Examines the PLC; returns the findings by name, and the reason if it ended early.
    pub(super) async fn run(&self) -> (Vec<(String, Finding)>, Result<(), End>) {
        let mut result = None;
        self.with_runner(async |runner, _| {
            let ended = runner.run(|_, _| {}).await;
            if ended.is_err() {
                let _ = runner.undo().await;
            }
            let open = || Finding::open("not examined");
            let findings = runner.examined.iter().map(|e| e.as_ref().map_or_else(open, |e| e.finding.clone()));
            result = Some((findings.collect::<Vec<_>>(), ended));
        })
        .await;
        let (findings, ended) = result.unwrap();
        (self.checks().into_iter().map(|check| check.name).zip(findings).collect(), ended)
    }

    /// Makes an examination of the PLC.
    pub(super) async fn with_runner(&self, examine: impl AsyncFnOnce(&mut Runner<'_, InMemory>, &Plc)) {
        let bus = Bus::new().with_station(1, self.plc.clone()).unwrap();
        let bus = if self.has_faults { bus.with_faults(self.faults.clone()) } else { bus };
        let connect = sim::connector(bus, self.framing);
        let connector = InMemory(if self.has_one_connection { one_at_a_time(connect) } else { Box::new(connect) });
        let pace = Pace { timeout: TIMEOUT, interval: Duration::from_millis(50) };
        let checks = self.checks();
        let mut runner = Runner::new(connector, self.requests(), &checks, self.choice, pace);
        examine(&mut runner, &self.plc).await;
    }

    /// Examines the PLC to the end.
    pub(super) async fn examine(&self) -> Vec<(String, Finding)> {
        let (findings, ended) = self.run().await;
        assert!(ended.is_ok(), "{ended:?}: {findings:#?}");
        findings
    }
}

/// The names of the checks whose assumption is contradicted.
pub(super) fn contradicted(findings: &[(String, Finding)]) -> Vec<&str> {
    let contradictions = findings.iter().filter(|(_, finding)| finding.verdict == Verdict::Contradicts);
    contradictions.map(|(name, _)| &name[..]).collect()
}

/// The data of a request for one element, as a quirk compares it.
pub(super) fn data_of(framing: Framing, code: Code, n: u16, first: &str) -> bytes::Bytes {
    Requests { framing, station: 1 }.read(code, n, first).frame.data
}
