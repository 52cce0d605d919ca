//! A PLC behind connections that misbehave as devices in the field do, in paused time.

use std::future::{Ready, ready};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use bytes::BytesMut;
use fatek::sim::{Bus, Plc};
use fatek::wire::{Codec, Framing, Received, Side};
use fatek::{Link, LinkBuilder};
use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};
use tokio::sync::Mutex;
use tokio::time::{Instant, sleep, sleep_until};
use tokio_util::codec::Decoder;

/// Settings of a [`Device`]. The default answers at once.
#[derive(Clone, Copy, Default)]
pub(crate) struct Behaviour {
    /// Time from a request, or from the end of the one before it, to its reply.
    pub(crate) plc_time: Duration,
    /// Bytes that come within this time after the connection is opened are lost.
    pub(crate) deaf: Duration,
    /// Number of a connection, and of the replies after which it is mute.
    pub(crate) mute: Option<(usize, usize)>,
    /// The connection is closed this long after each reply.
    pub(crate) closes_after: Option<Duration>,
    /// Pause before each byte of a reply.
    pub(crate) byte_time: Duration,
}

/// A bus with the stations 1 and 3, and without station 2.
#[derive(Clone)]
pub(crate) struct Device {
    bus: Bus,
    pub(crate) behaviour: Behaviour,
    /// Number of connections so far.
    pub(crate) accepted: Arc<AtomicUsize>,
    /// Number of requests executed.
    pub(crate) executed: Arc<AtomicUsize>,
    /// Held while the PLC executes a request.
    plc: Arc<Mutex<()>>,
}

impl Device {
    pub(crate) fn new(behaviour: Behaviour) -> Self {
        let bus = Bus::new().with_station(1, Plc::new()).unwrap().with_station(3, Plc::new()).unwrap();
        Self { bus, behaviour, accepted: Arc::default(), executed: Arc::default(), plc: Arc::default() }
    }

    /// Settings of a link to the device.
    pub(crate) fn link(&self) -> LinkBuilder {
        let device = self.clone();
        Link::connector_builder("the device", Framing::Ascii, move || device.open())
    }

    pub(crate) fn accepted(&self) -> usize {
        self.accepted.load(Ordering::Relaxed)
    }

    pub(crate) fn executed(&self) -> usize {
        self.executed.load(Ordering::Relaxed)
    }

    fn open(&self) -> Ready<io::Result<DuplexStream>> {
        let (client, plc) = duplex(4096);
        let number = self.accepted.fetch_add(1, Ordering::Relaxed) + 1;
        tokio::spawn(self.clone().serve(plc, number));
        ready(Ok(client))
    }

    async fn serve(self, mut stream: DuplexStream, number: usize) {
        let Behaviour { plc_time, deaf, mute, closes_after, byte_time } = self.behaviour;
        let listens_at = Instant::now() + deaf;
        let mut codec = Codec::new(Framing::Ascii, Side::Plc);
        let (mut received, mut answered) = (BytesMut::new(), 0);
        while let Ok(1..) = stream.read_buf(&mut received).await {
            if Instant::now() < listens_at {
                received.clear();
                sleep_until(listens_at).await;
                continue;
            }
            while let Some(item) = codec.decode(&mut received).unwrap() {
                let mut reply = BytesMut::new();
                self.answer(&item, plc_time, &mut reply).await;
                if reply.is_empty() || mute.is_some_and(|(mute, after)| number == mute && answered >= after) {
                    continue;
                }
                answered += 1;
                if byte_time.is_zero() {
                    stream.write_all(&reply).await.ok();
                } else {
                    for byte in reply {
                        sleep(byte_time).await;
                        stream.write_all(&[byte]).await.ok();
                    }
                }
                if let Some(after) = closes_after {
                    sleep(after).await;
                    return;
                }
            }
        }
    }

    async fn answer(&self, item: &Received, plc_time: Duration, reply: &mut BytesMut) {
        let _turn = self.plc.lock().await;
        sleep(plc_time).await;
        self.bus.answer(item, Framing::Ascii, reply);
        self.executed.fetch_add(usize::from(!reply.is_empty()), Ordering::Relaxed);
    }
}
