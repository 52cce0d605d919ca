//! Spans of `tracing`: one for each call, and one for the events of the link, which any task may
//! process.

use std::io;
use std::sync::{Arc, Mutex};

use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{Endpoint, Link, register};
use tracing::Instrument;
use tracing_subscriber::fmt::format::FmtSpan;

/// The log so far.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.lock().unwrap().write(bytes)
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

#[tokio::test]
async fn link_events_and_calls_have_their_own_spans() {
    let log = Log::default();
    let writer = log.clone();
    let subscriber = tracing_subscriber::fmt()
        .with_ansi(false)
        .with_max_level(tracing::Level::TRACE)
        .with_span_events(FmtSpan::CLOSE)
        .with_writer(move || writer.clone())
        .finish();
    let _default = tracing::subscriber::set_default(subscriber);

    let bus = Bus::new().with_station(1, Plc::new()).unwrap();
    let server = Server::bind("127.0.0.1:0", bus, Framing::Binary).await.unwrap();
    let link = Link::new(Endpoint::from(server.local_addr()).with_framing(Framing::Binary));
    let station = link.station(1).unwrap();
    let reads = async {
        for _ in 0..3 {
            station.read_registers(register!("R0"), 1).await.unwrap();
        }
    };
    reads.instrument(tracing::info_span!("shop")).await;

    let text = String::from_utf8(log.0.lock().unwrap().clone()).unwrap();
    let lines_with = |what: &str| text.lines().filter(|line| line.contains(what)).collect::<Vec<_>>();
    // The check and the first request are sent by the link's task, the others by the caller.
    for (what, count) in [("connected", 1), ("sending", 4), ("received", 4)] {
        let lines = lines_with(&format!(" {what}"));
        let of_the_link = lines.iter().filter(|line| line.contains("link{name=") && line.contains("fatek::link"));
        assert_eq!(of_the_link.clone().count(), count, "{what}: {text}");
        assert!(of_the_link.clone().all(|line| !line.contains("shop") && !line.contains("call{")), "{text}");
    }
    let calls = lines_with("shop:call{link=");
    assert_eq!(calls.iter().filter(|line| line.contains("close")).count(), 3, "{text}");
}
