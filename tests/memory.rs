//! What a link costs on the heap, counted to the byte: its slot in the pool, its handle, its task, its buffers, and the
//! future of a caller. A byte too much here is ten thousand of them in a service that polls as many PLCs.
//!
//! Sockets are not in it: the connections here answer by themselves. `examples/poll_many` measures all together.
#![cfg(feature = "sim")]
#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, Waker};
use std::time::Duration;

use bytes::{Buf, BytesMut};
use fatek::sim::{Bus, Plc};
use fatek::wire::{Codec, Framing, Side};
use fatek::{Pool, Station, register};
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::task::JoinSet;
use tokio::time::sleep;
use tokio_util::codec::Decoder;

#[global_allocator]
static HEAP: dhat::Alloc = dhat::Alloc;

const LINKS: usize = 512;
const KIB: usize = 1024;

/// One test, because the heap is one.
#[tokio::test(start_paused = true)]
async fn a_link_keeps_little_memory_and_no_buffers() {
    let _profiler = dhat::Profiler::builder().testing().build();
    for framing in [Framing::Ascii, Framing::Binary] {
        let before = heap();
        let plant = Plant::new(framing);
        let pool = plant.pool();
        let endpoint = |n| format!("tcp://10.0.{}.{}:500?framing={framing}", n / 256, n % 256);
        let stations: Vec<Station> = (0..LINKS).map(|n| pool.station(endpoint(n), 1).unwrap()).collect();
        let per_link = |what: &str, limit: usize| {
            let bytes = (heap() - before) / LINKS;
            println!("{framing}: {bytes} bytes a link {what}");
            assert!(bytes <= limit, "{framing}: {bytes} bytes a link {what}, more than {limit}");
            bytes
        };
        per_link("that nobody has used", 4 * KIB);

        read_all(&stations, 10).await;
        let connected = per_link("that is connected", 6 * KIB);

        read_all(&stations, 64).await;
        plant.babble(true);
        read_all(&stations, 10).await;
        plant.babble(false);
        read_all(&stations, 10).await;
        let after = per_link("that has received much", 6 * KIB);
        assert!(after <= connected + 64, "{framing}: nothing of it is kept");

        plant.hold(true);
        let mut calls = JoinSet::new();
        for station in &stations {
            let station = station.clone();
            calls.spawn(async move { station.read_registers(register!("R0"), 10).await.unwrap() });
        }
        sleep(Duration::from_millis(100)).await;
        per_link("with a call under way", 7 * KIB);
        plant.hold(false);
        assert_eq!(calls.join_all().await.len(), LINKS);
        assert!(per_link("after it", 6 * KIB) <= connected + 64, "{framing}: nothing of the call is kept");

        sleep(IDLE).await;
        assert_eq!(pool.stats().idle, LINKS);
        assert!(per_link("that has fallen idle", 6 * KIB) <= connected);

        pool.close().await;
        drop((pool, stations));
        sleep(Duration::from_millis(1)).await;
        // What is left is the queue of the runtime, which has grown.
        per_link("that is gone", 64);
    }
}

const IDLE: Duration = Duration::from_secs(60);

fn heap() -> usize {
    dhat::HeapStats::get().curr_bytes
}

async fn read_all(stations: &[Station], count: usize) {
    for station in stations {
        assert_eq!(station.read_registers(register!("R0"), count).await.unwrap().len(), count);
    }
}

/// The PLCs, all of them the same one, and what all connections to it do.
#[derive(Clone)]
struct Plant {
    bus: Arc<Bus>,
    framing: Framing,
    /// Whether answers are held back.
    held: Arc<AtomicBool>,
    /// Whether answers come with half a kilobyte of noise before them.
    babbles: Arc<AtomicBool>,
    waiting: Arc<Mutex<Vec<Waker>>>,
}

impl Plant {
    fn new(framing: Framing) -> Self {
        Self {
            bus: Arc::new(Bus::new().with_station(1, Plc::new()).unwrap()),
            framing,
            held: Arc::default(),
            babbles: Arc::default(),
            waiting: Arc::default(),
        }
    }

    fn pool(&self) -> Pool {
        let plant = self.clone();
        let open = move |_| {
            let wire = Wire { plant: plant.clone(), replies: BytesMut::new() };
            async move { Ok(wire) }
        };
        Pool::builder().connector(open).connects_per_second(1_000_000).idle_timeout(IDLE / 2).build()
    }

    fn babble(&self, on: bool) {
        self.babbles.store(on, Ordering::SeqCst);
    }

    fn hold(&self, on: bool) {
        self.held.store(on, Ordering::SeqCst);
        std::mem::take(&mut *self.waiting.lock().unwrap()).into_iter().for_each(Waker::wake);
    }
}

/// A connection that answers by itself.
struct Wire {
    plant: Plant,
    replies: BytesMut,
}

impl AsyncRead for Wire {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        if self.plant.held.load(Ordering::SeqCst) {
            self.plant.waiting.lock().unwrap().push(cx.waker().clone());
            return Poll::Pending;
        }
        if self.replies.is_empty() {
            // Whoever reads has written before, in the same task.
            return Poll::Pending;
        }
        let len = self.replies.len().min(buf.remaining());
        buf.put_slice(&self.replies[..len]);
        self.replies.advance(len);
        if self.replies.is_empty() {
            self.replies = BytesMut::new();
        }
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Wire {
    fn poll_write(mut self: Pin<&mut Self>, _: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let plant = self.plant.clone();
        if plant.babbles.load(Ordering::SeqCst) {
            self.replies.extend_from_slice(&[b'?'; 512]);
        }
        let mut codec = Codec::new(plant.framing, Side::Plc);
        let mut request = BytesMut::from(bytes);
        while let Some(received) = codec.decode(&mut request)? {
            plant.bus.answer(&received, plant.framing, &mut self.replies);
        }
        Poll::Ready(Ok(bytes.len()))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}
