//! Handles that outlive a runtime, calls outside of one, and processes that were stopped.

use std::io::{Read, Write};
use std::net::{SocketAddr, TcpListener};
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::task::{Context, Poll, Wake, Waker};
use std::thread;
use std::time::Duration;

use bytes::BytesMut;
use fatek::poll::{PollTag, Poller, ScanClass};
use fatek::sim::{Bus, Faults, Line, Plc, Server};
use fatek::wire::{Codec, Framing, Side};
use fatek::{Error, Link, Station, register};
use futures::StreamExt;
use tokio::runtime::{Builder, Runtime};
use tokio_util::codec::Decoder;

const MS: Duration = Duration::from_millis(1);

fn runtime() -> Runtime {
    Builder::new_current_thread().enable_all().build().unwrap()
}

/// Runs a future on this thread, without Tokio.
fn block_on<F: Future>(future: F) -> F::Output {
    struct Unpark(thread::Thread);
    impl Wake for Unpark {
        fn wake(self: Arc<Self>) {
            self.0.unpark();
        }
    }
    let waker = Waker::from(Arc::new(Unpark(thread::current())));
    let mut future = pin!(future);
    loop {
        if let Poll::Ready(output) = future.as_mut().poll(&mut Context::from_waker(&waker)) {
            return output;
        }
        thread::park();
    }
}

/// A simulated PLC on a runtime and a thread of its own.
fn serve(bus: Bus) -> SocketAddr {
    let (address, served) = std::sync::mpsc::channel();
    thread::spawn(move || {
        runtime().block_on(async {
            let server = Server::bind("127.0.0.1:0", bus, Framing::Ascii).await.unwrap();
            address.send(server.local_addr()).unwrap();
            std::future::pending::<()>().await;
        });
    });
    served.recv().unwrap()
}

fn bus() -> Bus {
    Bus::new().with_station(1, Plc::new()).unwrap()
}

/// Before: the second runtime's calls failed with "the link is closed".
#[test]
fn a_static_station_serves_one_runtime_after_another() {
    static STATION: OnceLock<Station> = OnceLock::new();
    let address = serve(bus());
    let station = STATION.get_or_init(|| Link::new(address.into()).station(1).unwrap());
    for n in 0..5 {
        let runtime = runtime();
        runtime.block_on(async {
            station.write_registers(register!("R0"), &[n]).await.unwrap();
            assert_eq!(station.read_registers(register!("R0"), 1).await.unwrap(), [n]);
        });
    }
    // A runtime of several threads, and one that ends while others use the link.
    let threads = Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    assert_eq!(threads.block_on(station.read_registers(register!("R0"), 1)).unwrap(), [4]);
}

/// Before: the link was closed for good, because its task was dropped while its thread panicked.
#[test]
fn a_panic_of_its_user_does_not_close_a_link() {
    let address = serve(bus());
    let station = Link::new(address.into()).station(1).unwrap();
    let user = station.clone();
    let panicked = thread::spawn(move || {
        runtime().block_on(async {
            user.read_registers(register!("R0"), 1).await.unwrap();
            panic!("a test that fails");
        });
    });
    assert!(panicked.join().is_err());
    assert_eq!(runtime().block_on(station.read_registers(register!("R0"), 1)).unwrap(), [0]);
}

#[test]
fn a_call_during_the_end_of_the_links_runtime_fails_or_is_answered() {
    let address = serve(bus());
    for _ in 0..50 {
        let station = Link::new(address.into()).station(1).unwrap();
        let first = runtime();
        first.block_on(station.read_registers(register!("R0"), 1)).unwrap();
        let other = station.clone();
        let caller = thread::spawn(move || {
            runtime().block_on(async {
                for _ in 0..20 {
                    match other.read_registers(register!("R0"), 1).await {
                        Ok(values) => assert_eq!(values, [0]),
                        Err(Error::Disconnected { .. } | Error::Closed { .. }) => {}
                        Err(error) => panic!("{error}"),
                    }
                }
            });
        });
        drop(first);
        caller.join().unwrap();
    }
}

/// Before: a panic, "there is no reactor running".
#[test]
fn a_call_outside_of_tokio_is_an_error() {
    let address = serve(bus());
    let station = Link::new(address.into()).station(1).unwrap();
    for _ in 0..2 {
        let error = block_on(station.read_registers(register!("R0"), 1)).unwrap_err();
        assert!(matches!(error, Error::Connect { .. }), "{error:?}");
        assert!(error.to_string().contains("Tokio"), "{error}");
        // The second time the link's task runs.
        runtime().block_on(station.read_registers(register!("R0"), 1)).unwrap();
    }
}

#[test]
fn a_poller_ends_its_stream_with_its_runtime() {
    let address = serve(bus());
    let station = Link::new(address.into()).station(1).unwrap();
    let runtime = runtime();
    let mut poller = runtime.block_on(async {
        let mut poller = Poller::new();
        let tag = PollTag::new("speed", "R0".parse().unwrap());
        poller.station(&station).unwrap().add(ScanClass::every(10 * MS), [tag]).unwrap();
        assert!(poller.next().await.is_some());
        poller
    });
    drop(runtime);
    // Samples taken before it ended come first.
    let rest = block_on(async { poller.by_ref().take(1000).count().await });
    assert!(rest < 1000, "{rest}");
    assert!(block_on(poller.next()).is_none());
}

/// The thread is stopped from the moment of the request until after the deadline of the call, as by
/// a debugger, `SIGSTOP`, or code that blocks. The answer is in the socket long before.
///
/// Before: 10 of 10 writes "may have been executed".
#[test]
fn an_answer_that_came_while_the_process_was_stopped_is_taken() {
    let slow = Faults::new(1).line(Line::new(0).response_time(20 * MS, 20 * MS));
    let address = serve(bus().with_faults(slow));
    let runtime = runtime();
    runtime.block_on(async {
        for (call_timeout, response_timeout) in [(200_u32, 5000_u32), (5000, 200), (200, 200)] {
            let link = Link::builder(address.into())
                .call_timeout(MS * call_timeout)
                .response_timeout(MS * response_timeout)
                .build();
            let station = link.station(1).unwrap();
            station.read_registers(register!("R9"), 1).await.unwrap();
            let mut taken = 0;
            for n in 0..10 {
                let stops = tokio::spawn(async {
                    tokio::time::sleep(5 * MS).await;
                    thread::sleep(300 * MS);
                });
                match station.write_registers(register!("R0"), &[n]).await {
                    Ok(()) => taken += 1,
                    Err(error) => println!("{call_timeout} ms, {response_timeout} ms: {error}"),
                }
                stops.await.unwrap();
            }
            println!("call timeout {call_timeout} ms, response timeout {response_timeout} ms: {taken} of 10 confirmed");
            assert_eq!(taken, 10);
        }
    });
}

/// The PLC has closed the connection while the thread was stopped: the write uses another one.
#[test]
fn a_close_that_came_before_a_write_is_noticed() {
    let address = serve_closing();
    let runtime = runtime();
    runtime.block_on(async {
        let link = Link::builder(address.into()).build();
        let station = link.station(1).unwrap();
        let mut failed = Vec::new();
        for n in 0..20 {
            station.read_registers(register!("R0"), 1).await.unwrap();
            // Longer than the server keeps a silent connection.
            thread::sleep(60 * MS);
            if let Err(error) = station.write_registers(register!("R0"), &[n]).await {
                failed.push(format!("{n}: {error}"));
            }
        }
        assert!(failed.is_empty(), "{failed:#?}");
    });
}

/// A PLC that closes a connection after 30 ms of silence.
fn serve_closing() -> SocketAddr {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    thread::spawn(move || {
        for stream in listener.incoming() {
            let mut stream = stream.unwrap();
            stream.set_read_timeout(Some(30 * MS)).unwrap();
            thread::spawn(move || {
                let (bus, mut codec) = (bus(), Codec::new(Framing::Ascii, Side::Plc));
                let (mut received, mut bytes) = (BytesMut::new(), [0; 512]);
                while let Ok(count @ 1..) = stream.read(&mut bytes) {
                    received.extend_from_slice(&bytes[..count]);
                    while let Some(item) = codec.decode(&mut received).unwrap() {
                        let mut reply = BytesMut::new();
                        bus.answer(&item, Framing::Ascii, &mut reply);
                        stream.write_all(&reply).unwrap();
                    }
                }
            });
        }
    });
    address
}
