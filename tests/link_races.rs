//! Races: callers of several runtimes share a link that is closed, dropped, or loses its runtime at
//! any moment.
//!
//! Also the obligations of callers that write their requests themselves: yielding, panics, the
//! frame gap.
//!
//! `FATEK_RACE_SEED` replays a seed. `FATEK_RACE_ROUNDS` sets the number of seeds.
#![cfg(feature = "sim")]

use std::io;
use std::panic::{RefUnwindSafe, UnwindSafe};
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::{Duration, Instant};

use fatek::sim::{self, Bus, Plc};
use fatek::wire::Framing;
use fatek::{Error, Link, Register, Station, register};
use futures::FutureExt;
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, DuplexStream, ReadBuf, duplex};
use tokio::runtime::{Builder, Runtime};
use tokio::task::JoinHandle;
use tokio::time::timeout;

mod peer;
#[path = "common/rng.rs"]
mod rng;

use peer::{Peer, line, station, without_duplicates};
use rng::Rng;

/// Limit for prompt results: far longer than needed, shorter than a call's own timeout.
const LIMIT: Duration = Duration::from_secs(5);

fn one_thread() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}

#[test]
fn calls_end_if_the_runtime_ends_before_the_link_task_starts() {
    let (link, _end) = line();
    let plc = station(&link);
    let first = one_thread();
    // Spawns the link's task, which does not run.
    first.block_on(async { assert!(plc.read_status().now_or_never().is_none()) });
    drop(first);
    one_thread().block_on(async {
        let error = timeout(LIMIT, plc.read_status()).await.unwrap().unwrap_err();
        assert!(matches!(error, Error::Closed { sent: false, .. }), "{error:?}");
        timeout(LIMIT, link.close()).await.unwrap();
    });
}

#[test]
fn handles_are_unwind_safe() {
    fn check<T: UnwindSafe + RefUnwindSafe + Send + Sync>() {}
    check::<Link>();
    check::<Station>();
}

/// A stream that records its operations, and panics or blocks on request.
struct InstrumentedStream {
    stream: DuplexStream,
    panics: Arc<AtomicBool>,
    /// Time for which a read blocks the thread.
    blocks_reads_for: Duration,
    log: Arc<Mutex<Vec<(StreamOp, Instant)>>>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum StreamOp {
    Read,
    Write,
}

impl InstrumentedStream {
    fn new(stream: DuplexStream) -> Self {
        Self { stream, panics: Arc::default(), blocks_reads_for: Duration::ZERO, log: Arc::default() }
    }
}

impl AsyncRead for InstrumentedStream {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(cx, into);
        if read.is_ready() {
            std::thread::sleep(self.blocks_reads_for);
            self.log.lock().unwrap().push((StreamOp::Read, Instant::now()));
        }
        read
    }
}

impl AsyncWrite for InstrumentedStream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        assert!(!self.panics.load(Ordering::SeqCst), "planned panic");
        self.log.lock().unwrap().push((StreamOp::Write, Instant::now()));
        Pin::new(&mut self.stream).poll_write(cx, bytes)
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[tokio::test]
async fn a_panicking_stream_ends_the_link_but_not_its_callers() {
    let (client, plc) = duplex(4096);
    let instrumented = InstrumentedStream::new(client);
    let panics = instrumented.panics.clone();
    let link = Link::from_stream(instrumented, Framing::Ascii);
    let plc_task = tokio::spawn(Peer::new(plc).serve());
    let plc = station(&link);
    plc.read_status().await.unwrap();
    panics.store(true, Ordering::SeqCst);
    for _ in 0..2 {
        let plc = plc.clone();
        let call = tokio::spawn(async move { plc.read_status().await });
        let error = timeout(LIMIT, call).await.unwrap().expect("the caller has not panicked").unwrap_err();
        assert!(matches!(error, Error::Closed { .. }), "{error:?}");
    }
    timeout(LIMIT, link.close()).await.unwrap();
    timeout(LIMIT, plc_task).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_caller_that_never_waits_yields_to_other_tasks() {
    let (client, mut plc) = duplex(1 << 20);
    let link = Link::from_stream(client, Framing::Binary);
    let broadcast = link.broadcast();
    broadcast.run().await.unwrap();
    let turns = Arc::new(AtomicU64::new(0));
    let other = tokio::spawn({
        let turns = turns.clone();
        async move {
            loop {
                turns.fetch_add(1, Ordering::SeqCst);
                tokio::task::yield_now().await;
            }
        }
    });
    for _ in 0..1000 {
        broadcast.write_registers(register!("R0"), &[1]).await.unwrap();
    }
    assert_ne!(turns.load(Ordering::SeqCst), 0, "a thousand calls without a yield");
    other.abort();
    drop((link, broadcast));
    plc.read_to_end(&mut Vec::new()).await.unwrap();
}

#[tokio::test]
async fn the_frame_gap_begins_after_a_slow_read() {
    let gap = Duration::from_millis(60);
    let (client, plc) = duplex(4096);
    let instrumented = InstrumentedStream { blocks_reads_for: gap / 2, ..InstrumentedStream::new(client) };
    let log = instrumented.log.clone();
    let link = Link::stream_builder(instrumented, Framing::Ascii).frame_gap(gap).in_step(without_duplicates()).build();
    tokio::spawn(Peer::new(plc).serve());
    let plc = station(&link);
    for _ in 0..3 {
        plc.read_status().await.unwrap();
    }
    let log = log.lock().unwrap();
    let mut gaps = 0;
    for pair in log.windows(2) {
        if let [(StreamOp::Read, read), (StreamOp::Write, written)] = pair {
            assert!(*written - *read >= gap, "written {:?} after the reply", *written - *read);
            gaps += 1;
        }
    }
    assert_eq!(gaps, 3, "after the check of the new connection, and between three requests");
}

const CALLERS: u16 = 24;
const CALLS: u32 = 30;

/// Counts of a caller's results.
#[derive(Clone, Copy, Debug, Default)]
struct CallerCounts {
    done: u32,
    given_up: u32,
    closed: u32,
}

/// Writes and reads one register, cancels calls at random, and checks each value read.
async fn caller(station: Station, address: u16, mut rng: Rng, closes: bool) -> CallerCounts {
    let register = Register::r(address);
    // The current value, and those of cancelled writes, which may still be executed.
    let (mut held, mut next, mut counts) = (vec![address], 0_u16, CallerCounts::default());
    for _ in 0..CALLS {
        let cancel_after = (rng.below(4) == 0).then(|| Duration::from_micros(rng.below(1500)));
        if rng.below(2) == 0 {
            let value = CALLERS + address + CALLERS * next;
            next += 1;
            held.push(value);
            match within(cancel_after, station.write_registers(register, &[value])).await {
                None => counts.given_up += 1,
                Some(Ok(())) => (held, counts.done) = (vec![value], counts.done + 1),
                Some(Err(error)) if closes && matches!(error, Error::Closed { .. } | Error::Disconnected { .. }) => {
                    return closed(counts);
                }
                Some(Err(error)) => panic!("{error}"),
            }
        } else {
            match within(cancel_after, station.read_registers(register, 1)).await {
                None => counts.given_up += 1,
                Some(Ok(values)) => {
                    assert_eq!(values.len(), 1);
                    let at = held.iter().position(|held| *held == values[0]);
                    // Requests of one caller are sent in order, so an older value cannot come back.
                    held.drain(..at.unwrap_or_else(|| panic!("{values:?} is none of {held:?}")));
                    counts.done += 1;
                }
                Some(Err(error)) if closes && matches!(error, Error::Closed { .. } | Error::Disconnected { .. }) => {
                    return closed(counts);
                }
                Some(Err(error)) => panic!("{error}"),
            }
        }
    }
    counts
}

fn closed(counts: CallerCounts) -> CallerCounts {
    CallerCounts { closed: counts.closed + 1, ..counts }
}

async fn within<T>(cancel_after: Option<Duration>, call: impl Future<Output = T>) -> Option<T> {
    match cancel_after {
        None => Some(call.await),
        Some(cancel_after) => timeout(cancel_after, call).await.ok(),
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum LinkEnd {
    /// All calls complete.
    None,
    Close,
    /// Some callers are aborted, and all handles dropped.
    DropHandles,
    /// The runtime of the link's task ends.
    EndRuntime,
}

/// Runs one link from its first call to its end.
fn round(seed: u64, callers: &[Runtime]) -> (CallerCounts, LinkEnd) {
    let mut rng = Rng(seed);
    let plc = Plc::new();
    for address in 0..CALLERS {
        plc.write(Register::r(address), address).unwrap();
    }
    let bus = Bus::new().with_station(1, plc).unwrap();
    let framing = if rng.below(2) == 0 { Framing::Ascii } else { Framing::Binary };
    let end = [LinkEnd::None, LinkEnd::Close, LinkEnd::DropHandles, LinkEnd::EndRuntime][rng.below(4) as usize];
    // A runtime for the link's task alone, with one or two threads, that can be shut down.
    let mut owner =
        Some(Builder::new_multi_thread().worker_threads(1 + rng.below(2) as usize).enable_all().build().unwrap());
    let link_runtime = owner.as_ref().unwrap();
    let server = (rng.below(3) > 0)
        .then(|| callers[0].block_on(sim::Server::bind("127.0.0.1:0", bus.clone(), framing)).unwrap());
    let link = match &server {
        Some(server) => Link::new(format!("tcp://{}?framing={framing}", server.local_addr()).parse().unwrap()),
        None => {
            // The server side runs in the callers' runtime, because it must outlive the link's
            // task.
            let (handle, bus) = (callers[0].handle().clone(), bus.clone());
            Link::connector_builder("races", framing, move || {
                let _entered = handle.enter();
                sim::connector(bus.clone(), framing)()
            })
            .build()
        }
    };
    let plc = link.station(1).unwrap();
    let started = rng.below(3) > 0;
    if started {
        link_runtime.block_on(plc.read_registers(register!("R0"), 1)).unwrap();
    } else {
        // Spawns the task, which starts as late as possible.
        let _entered = link_runtime.enter();
        let _ = plc.read_registers(register!("R0"), 1).now_or_never();
    }
    let tasks: Vec<JoinHandle<CallerCounts>> = (0..CALLERS)
        .map(|address| {
            let rng = Rng(rng.below(u64::MAX));
            let on = &callers[usize::from(address) % callers.len()];
            on.spawn(caller(plc.clone(), address, rng, end != LinkEnd::None))
        })
        .collect();
    std::thread::sleep(Duration::from_micros(rng.below(8000)));
    let outside = &callers[rng.below(callers.len() as u64) as usize];
    match end {
        LinkEnd::None => {}
        LinkEnd::Close => outside.block_on(async { timeout(LIMIT, link.close()).await.expect("closed") }),
        LinkEnd::DropHandles => tasks.iter().filter(|_| rng.below(2) == 0).for_each(JoinHandle::abort),
        LinkEnd::EndRuntime => owner.take().unwrap().shutdown_background(),
    }
    let mut state = link.watch_state();
    drop((link, plc));
    let mut all = CallerCounts::default();
    for (address, task) in tasks.into_iter().enumerate() {
        let counts = outside.block_on(async { timeout(LIMIT * 4, task).await });
        match counts.unwrap_or_else(|_| panic!("seed {seed}, {end:?}: caller {address} never ends")) {
            Ok(counts) => {
                all.done += counts.done;
                all.given_up += counts.given_up;
                all.closed += counts.closed;
            }
            Err(error) => assert!(error.is_cancelled(), "seed {seed}, {end:?}: caller {address}: {error}"),
        }
    }
    // The task ends with its last handle, and drops its side of the state.
    outside
        .block_on(async { timeout(LIMIT, async { while state.changed().await.is_ok() {} }).await })
        .unwrap_or_else(|_| panic!("seed {seed}, {end:?}: the link's task goes on without handles"));
    if let Some(server) = server {
        callers[0].block_on(server.shutdown());
    }
    if let Some(owner) = owner {
        owner.shutdown_background();
    }
    (all, end)
}

#[test]
fn every_call_of_every_runtime_ends_with_the_link() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let multi = |threads| Builder::new_multi_thread().worker_threads(threads).enable_all().build().unwrap();
    let callers = [multi(4), multi(2), multi(1)];
    let (first, rounds) = match number("FATEK_RACE_SEED") {
        Some(seed) => (seed, 1),
        None => (0, number("FATEK_RACE_ROUNDS").unwrap_or(24)),
    };
    let began = Instant::now();
    for seed in first..first + rounds {
        let (counts, end) = round(seed, &callers);
        println!("seed {seed}: {counts:?}, {end:?}, {:?}", began.elapsed());
        if end == LinkEnd::None {
            assert_eq!(counts.done + counts.given_up, u32::from(CALLERS) * CALLS, "seed {seed}");
        }
    }
}
