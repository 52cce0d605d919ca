//! Callers of several runtimes at one link, which is closed, abandoned or deprived of its runtime at any moment; and what
//! callers that put their requests on the wire themselves owe to each other and to the rest of their program.
//!
//! `FATEK_RACE_SEED` replays a seed, `FATEK_RACE_ROUNDS` makes more of them.
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

use peer::{Peer, line, station, undoubled};

/// Far more than it takes, and less than a call may take by itself: if this passes, something was forgotten.
const AT_ONCE: Duration = Duration::from_secs(5);

fn one_thread() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}

#[test]
fn a_runtime_that_ends_before_the_links_task_has_begun_leaves_no_call_waiting() {
    let (link, _end) = line();
    let plc = station(&link);
    let first = one_thread();
    // It starts the task, which has no turn.
    first.block_on(async { assert!(plc.read_status().now_or_never().is_none()) });
    drop(first);
    one_thread().block_on(async {
        let error = timeout(AT_ONCE, plc.read_status()).await.unwrap().unwrap_err();
        assert!(matches!(error, Error::Closed { sent: false, .. }), "{error:?}");
        timeout(AT_ONCE, link.close()).await.unwrap();
    });
}

#[test]
fn handles_can_be_used_across_a_panic() {
    fn check<T: UnwindSafe + RefUnwindSafe + Send + Sync>() {}
    check::<Link>();
    check::<Station>();
}

/// A stream that does something of its own.
struct Odd {
    stream: DuplexStream,
    panics: Arc<AtomicBool>,
    /// How long it keeps the thread, once there is something to read.
    reads_for: Duration,
    log: Arc<Mutex<Vec<(Did, Instant)>>>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Did {
    Read,
    Write,
}

impl Odd {
    fn new(stream: DuplexStream) -> Self {
        Self { stream, panics: Arc::default(), reads_for: Duration::ZERO, log: Arc::default() }
    }
}

impl AsyncRead for Odd {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, into: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let read = Pin::new(&mut self.stream).poll_read(cx, into);
        if read.is_ready() {
            std::thread::sleep(self.reads_for);
            self.log.lock().unwrap().push((Did::Read, Instant::now()));
        }
        read
    }
}

impl AsyncWrite for Odd {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        assert!(!self.panics.load(Ordering::SeqCst), "as it must");
        self.log.lock().unwrap().push((Did::Write, Instant::now()));
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
async fn a_stream_that_panics_ends_the_link_and_no_caller() {
    let (client, plc) = duplex(4096);
    let odd = Odd::new(client);
    let panics = odd.panics.clone();
    let link = Link::from_stream(odd, Framing::Ascii);
    let plc_task = tokio::spawn(Peer::new(plc).serve());
    let plc = station(&link);
    plc.read_status().await.unwrap();
    panics.store(true, Ordering::SeqCst);
    for _ in 0..2 {
        let plc = plc.clone();
        let call = tokio::spawn(async move { plc.read_status().await });
        let error = timeout(AT_ONCE, call).await.unwrap().expect("the caller has not panicked").unwrap_err();
        assert!(matches!(error, Error::Closed { .. }), "{error:?}");
    }
    timeout(AT_ONCE, link.close()).await.unwrap();
    timeout(AT_ONCE, plc_task).await.unwrap().unwrap();
}

#[tokio::test]
async fn a_caller_that_never_has_to_wait_leaves_others_their_turn() {
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
    assert_ne!(turns.load(Ordering::SeqCst), 0, "a thousand calls in one turn");
    other.abort();
    drop((link, broadcast));
    plc.read_to_end(&mut Vec::new()).await.unwrap();
}

#[tokio::test]
async fn the_gap_begins_when_the_reply_has_been_read_however_long_that_takes() {
    let gap = Duration::from_millis(60);
    let (client, plc) = duplex(4096);
    let odd = Odd { reads_for: gap / 2, ..Odd::new(client) };
    let log = odd.log.clone();
    let link = Link::stream_builder(odd, Framing::Ascii).frame_gap(gap).in_step(undoubled()).build();
    tokio::spawn(Peer::new(plc).serve());
    let plc = station(&link);
    for _ in 0..3 {
        plc.read_status().await.unwrap();
    }
    let log = log.lock().unwrap();
    let mut seen = 0;
    for pair in log.windows(2) {
        if let [(Did::Read, read), (Did::Write, written)] = pair {
            assert!(*written - *read >= gap, "written {:?} after the reply", *written - *read);
            seen += 1;
        }
    }
    assert_eq!(seen, 3, "behind the check of the new connection, and between three requests");
}

/// Numbers that follow from a seed.
struct Dice(u64);

impl Dice {
    fn below(&mut self, limit: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) % limit
    }
}

const CALLERS: u16 = 24;
const CALLS: u32 = 30;

/// What a caller has seen.
#[derive(Clone, Copy, Debug, Default)]
struct Seen {
    done: u32,
    given_up: u32,
    closed: u32,
}

/// Writes and reads its own register, gives up at any moment, and knows at all times what the register may hold.
async fn caller(station: Station, address: u16, mut dice: Dice, closes: bool) -> Seen {
    let register = Register::r(address);
    // The value that is there, and those that a write which was given up may still bring.
    let (mut held, mut next, mut seen) = (vec![address], 0_u16, Seen::default());
    for _ in 0..CALLS {
        let patience = (dice.below(4) == 0).then(|| Duration::from_micros(dice.below(1500)));
        if dice.below(2) == 0 {
            let value = CALLERS + address + CALLERS * next;
            next += 1;
            held.push(value);
            match within(patience, station.write_registers(register, &[value])).await {
                None => seen.given_up += 1,
                Some(Ok(())) => (held, seen.done) = (vec![value], seen.done + 1),
                Some(Err(error)) if closes && matches!(error, Error::Closed { .. }) => return closed(seen),
                Some(Err(error)) => panic!("{error}"),
            }
        } else {
            match within(patience, station.read_registers(register, 1)).await {
                None => seen.given_up += 1,
                Some(Ok(values)) => {
                    assert_eq!(values.len(), 1);
                    let at = held.iter().position(|held| *held == values[0]);
                    // Requests of one caller are sent in order, so an older value does not come back.
                    held.drain(..at.unwrap_or_else(|| panic!("{values:?} is none of {held:?}")));
                    seen.done += 1;
                }
                Some(Err(error)) if closes && matches!(error, Error::Closed { .. }) => return closed(seen),
                Some(Err(error)) => panic!("{error}"),
            }
        }
    }
    seen
}

fn closed(seen: Seen) -> Seen {
    Seen { closed: seen.closed + 1, ..seen }
}

async fn within<T>(patience: Option<Duration>, call: impl Future<Output = T>) -> Option<T> {
    match patience {
        None => Some(call.await),
        Some(patience) => timeout(patience, call).await.ok(),
    }
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum End {
    /// All calls are made.
    None,
    Close,
    /// All handles are dropped while calls are on their way.
    Orphan,
    /// The runtime of the link's task ends.
    Runtime,
}

/// One link from its first call to its end.
fn round(seed: u64, callers: &[Runtime]) -> (Seen, End) {
    let mut dice = Dice(seed);
    let plc = Plc::new();
    for address in 0..CALLERS {
        plc.write(Register::r(address), address).unwrap();
    }
    let bus = Bus::new().with_station(1, plc).unwrap();
    let framing = if dice.below(2) == 0 { Framing::Ascii } else { Framing::Binary };
    let end = [End::None, End::Close, End::Orphan, End::Runtime][dice.below(4) as usize];
    // Its own, so that it can be taken away; sometimes it has one thread, which does nothing else.
    let mut owner =
        Some(Builder::new_multi_thread().worker_threads(1 + dice.below(2) as usize).enable_all().build().unwrap());
    let with_the_task = owner.as_ref().unwrap();
    let server = (dice.below(3) > 0)
        .then(|| callers[0].block_on(sim::Server::bind("127.0.0.1:0", bus.clone(), framing)).unwrap());
    let link = match &server {
        Some(server) => Link::new(format!("tcp://{}?framing={framing}", server.local_addr()).parse().unwrap()),
        None => {
            // Its other ends are served where the callers are, for they must outlive the link's task.
            let (handle, bus) = (callers[0].handle().clone(), bus.clone());
            Link::connector_builder("races", framing, move || {
                let _entered = handle.enter();
                sim::connector(bus.clone(), framing)()
            })
            .build()
        }
    };
    let plc = link.station(1).unwrap();
    let started = dice.below(3) > 0;
    if started {
        with_the_task.block_on(plc.read_registers(register!("R0"), 1)).unwrap();
    } else {
        // The task has begun as late as that can be.
        let _entered = with_the_task.enter();
        let _ = plc.read_registers(register!("R0"), 1).now_or_never();
    }
    let tasks: Vec<JoinHandle<Seen>> = (0..CALLERS)
        .map(|address| {
            let dice = Dice(dice.below(u64::MAX));
            let on = &callers[usize::from(address) % callers.len()];
            on.spawn(caller(plc.clone(), address, dice, end != End::None))
        })
        .collect();
    std::thread::sleep(Duration::from_micros(dice.below(8000)));
    let outside = &callers[dice.below(callers.len() as u64) as usize];
    match end {
        End::None => {}
        End::Close => outside.block_on(async { timeout(AT_ONCE, link.close()).await.expect("closed") }),
        End::Orphan => tasks.iter().filter(|_| dice.below(2) == 0).for_each(JoinHandle::abort),
        End::Runtime => owner.take().unwrap().shutdown_background(),
    }
    let mut state = link.watch_state();
    drop((link, plc));
    let mut all = Seen::default();
    for (address, task) in tasks.into_iter().enumerate() {
        let seen = outside.block_on(async { timeout(AT_ONCE * 4, task).await });
        match seen.unwrap_or_else(|_| panic!("seed {seed}, {end:?}: caller {address} waits for ever")) {
            Ok(seen) => {
                all.done += seen.done;
                all.given_up += seen.given_up;
                all.closed += seen.closed;
            }
            Err(error) => assert!(error.is_cancelled(), "seed {seed}, {end:?}: caller {address}: {error}"),
        }
    }
    // The task ends with its last handle, whatever was on the wire, and takes its end of the state with it.
    outside
        .block_on(async { timeout(AT_ONCE, async { while state.changed().await.is_ok() {} }).await })
        .unwrap_or_else(|_| panic!("seed {seed}, {end:?}: the link's task goes on for nobody"));
    if let Some(server) = server {
        callers[0].block_on(server.shutdown());
    }
    if let Some(owner) = owner {
        owner.shutdown_background();
    }
    (all, end)
}

#[test]
fn every_call_of_every_runtime_ends_whatever_becomes_of_the_link() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let multi = |threads| Builder::new_multi_thread().worker_threads(threads).enable_all().build().unwrap();
    let callers = [multi(4), multi(2), multi(1)];
    let (first, rounds) = match number("FATEK_RACE_SEED") {
        Some(seed) => (seed, 1),
        None => (0, number("FATEK_RACE_ROUNDS").unwrap_or(24)),
    };
    let began = Instant::now();
    for seed in first..first + rounds {
        let (seen, end) = round(seed, &callers);
        println!("seed {seed}: {seen:?}, {end:?}, {:?}", began.elapsed());
        if end == End::None {
            assert_eq!(seen.done + seen.given_up, u32::from(CALLERS) * CALLS, "seed {seed}");
        }
    }
}
