//! Overload, slow devices.

use std::io::Write as _;
use std::time::Duration;

use fatek::sim::{Bus, Plc, Server};
use fatek::wire::Framing;
use fatek::{Link, Register, register};
use tokio::time::Instant;

use crate::device::{Behaviour, Device};

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);

/// Before: 12 callers had 47 good replies a second, 14 had none, while the PLC executed 47.
#[tokio::test(start_paused = true)]
async fn goodput_stays_at_the_capacity_at_any_number_of_callers() {
    for callers in [1_usize, 8, 12, 14, 16, 20, 50, 200] {
        let device = Device::new(Behaviour { plc_time: 20 * MS, ..Behaviour::default() });
        let link = device.link().call_timeout(290 * MS).build();
        let end = Instant::now() + 20 * SECOND;
        let tasks: Vec<_> = (0..callers)
            .map(|caller| {
                let station = link.station(1).unwrap();
                let first = Register::new(fatek::Symbol::R, u16::try_from(caller).unwrap() * 7).unwrap();
                tokio::spawn(async move {
                    let mut good = 0_u32;
                    while Instant::now() < end {
                        good += u32::from(station.read_registers(first, 1).await.is_ok());
                    }
                    good
                })
            })
            .collect();
        let mut good = 0;
        for task in tasks {
            good += task.await.unwrap();
        }
        let (good, executed) = (f64::from(good) / 20.0, device.executed() / 20);
        println!("{callers} callers: {good:.1} good replies a second, {executed} executed");
        assert!(good >= 45.0, "{callers} callers: {good:.1} good replies a second, {executed} executed");
    }
}

/// A peer that sends STX without end, on the thread of 20 healthy links and of a task that sleeps
/// 5 ms.
///
/// Before: the task slept 6.2 s, and the links made 160 of 1500 readings.
#[tokio::test]
async fn a_flooding_peer_does_not_hold_up_its_runtime() {
    let flood = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let address = flood.local_addr().unwrap();
    std::thread::spawn(move || {
        let (mut stream, _) = flood.accept().unwrap();
        let garbage = [0x02; 64 * 1024];
        while stream.write_all(&garbage).is_ok() {}
    });
    let (served, healthy) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap().block_on(async {
            let bus = Bus::new().with_station(1, Plc::new()).unwrap();
            let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
            served.send(server.local_addr()).unwrap();
            std::future::pending::<()>().await;
        });
    });
    let healthy = healthy.recv().unwrap();
    let flooded = Link::new(address.into()).station(1).unwrap();
    let caller = tokio::spawn(async move {
        loop {
            let _ = flooded.read_registers(register!("R0"), 1).await;
        }
    });
    tokio::time::sleep(50 * MS).await;
    let sleeps = tokio::spawn(async {
        let mut longest = Duration::ZERO;
        for _ in 0..100 {
            let began = Instant::now();
            tokio::time::sleep(5 * MS).await;
            longest = longest.max(began.elapsed());
        }
        longest
    });
    let readings = (0..20).map(|_| {
        let station = Link::new(healthy.into()).station(1).unwrap();
        tokio::spawn(async move {
            let mut good = 0;
            for _ in 0..75 {
                good += u32::from(station.read_registers(register!("R0"), 1).await.is_ok());
            }
            good
        })
    });
    let mut good = 0;
    for reading in readings.collect::<Vec<_>>() {
        good += reading.await.unwrap();
    }
    let longest = sleeps.await.unwrap();
    caller.abort();
    println!("flood: {good} of 1500 readings, the longest sleep of 5 ms took {longest:?}");
    assert_eq!(good, 1500);
    // On a busy machine the thread may not run for a while.
    assert!(longest < Duration::from_secs(1), "{longest:?}");
}

/// Before: given up after 1 s though bytes came.
#[tokio::test(start_paused = true)]
async fn a_slow_reply_is_awaited_while_its_bytes_come() {
    for byte_time in [2 * MS, 5 * MS, 20 * MS] {
        let device = Device::new(Behaviour { byte_time, ..Behaviour::default() });
        let link = device.link().build();
        let began = Instant::now();
        let read = link.station(1).unwrap().read_registers(register!("R0"), 64).await;
        println!("{byte_time:?} a byte: {:?} after {:?}", read.as_ref().map(Vec::len), began.elapsed());
        assert_eq!(read.map(|values| values.len()).ok(), Some(64), "{byte_time:?} a byte");
    }
}
