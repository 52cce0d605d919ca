//! The gateway of `examples/serial_gateway`: its clients get what they would get on the bus itself.
#![cfg(feature = "sim")]

#[path = "../common/mod.rs"]
mod common;
#[path = "../../examples/serial_gateway/proxy.rs"]
mod proxy;
#[path = "../../examples/serial_gateway/server.rs"]
mod server;

mod bad_clients;
mod bench;
mod overload;
mod ports;
mod read_only;
mod soak;

use std::time::Duration;

use bytes::BytesMut;
use fatek::command::*;
use fatek::sim::{self, Fault, Faults, Plc, Rule};
use fatek::wire::{Framing, Side};
use fatek::{ErrorCode, Register, Symbol, Value, discrete, element, register, register32};
use tokio::io::duplex;
use tokio::time::Instant;

use self::bench::{
    Bench, CALL_TIMEOUT, Client, READ_ONLY_MODE, RESPONSE_TIMEOUT, STATIONS, UNRESTRICTED, Unanswered, bus, plc, word,
};
use self::common::{FRAMINGS, framed, vectors};
use self::proxy::{Counts, Rules};

/// Connects a client to a bus without gateway. The bus equals that of the bench.
fn direct(framing: Framing) -> (Client, Vec<Plc>) {
    let plcs: Vec<_> = (1..=STATIONS).map(plc).collect();
    let (near, far) = duplex(4096);
    tokio::spawn(sim::serve(far, bus(&plcs), framing));
    (Client::new(near, framing, CALL_TIMEOUT), plcs)
}

/// A request of every command. Reads are last, so that they return what the others have changed.
fn requests() -> Vec<Request> {
    let page = ProgramPage::new([0xABCD; PAGE_WORDS]);
    vec![
        Request::WriteProgramPage(WriteProgramPage::new(2, page)),
        Request::ControlPlc(ControlPlc::Run),
        Request::ControlDiscrete(ControlDiscrete::new(DiscreteControl::Disable, discrete!("X16"))),
        Request::ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, discrete!("X16"))),
        Request::WriteDiscretes(WriteDiscretes::new(discrete!("Y0"), [true, false, true]).unwrap()),
        Request::WriteRegisters(WriteRegisters::new(register!("R0"), [1, 2, 3]).unwrap()),
        Request::WriteRegisters32(WriteRegisters::new(register32!("DR10"), [0x1234_5678]).unwrap()),
        Request::WriteMixed(WriteMixed::new([(element!("Y9"), true.into()), (element!("R20"), 7_u16.into())]).unwrap()),
        Request::ReadStatus(ReadStatus),
        Request::ReadDisabled(ReadDisabled::new(discrete!("X15"), 3).unwrap()),
        Request::ReadDiscretes(ReadDiscretes::new(discrete!("Y0"), 256).unwrap()),
        Request::ReadRegisters(ReadRegisters::new(register!("R0"), 64).unwrap()),
        Request::ReadRegisters(ReadRegisters::new(register!("D100"), 64).unwrap()),
        Request::ReadRegisters32(ReadRegisters::new(register32!("DR10"), 32).unwrap()),
        Request::ReadMixed(ReadMixed::new([element!("Y9"), element!("R20"), element!("DR10")]).unwrap()),
        Request::LoopBack(LoopBack::new("ABCDEFG").unwrap()),
        Request::ReadProgramPage(ReadProgramPage::new(2)),
        Request::ReadProgramPage(ReadProgramPage::new(65_535)), // no PLC has it: error A
        Request::ReadDetailedStatus(ReadDetailedStatus),
    ]
}

fn encoded(request: &Request, framing: Framing, station: u8) -> Option<BytesMut> {
    let mut bytes = BytesMut::new();
    request.encode(framing, station, &mut bytes).ok().map(|()| bytes)
}

#[tokio::test(start_paused = true)]
async fn a_gateway_client_gets_the_bytes_of_the_bus() {
    for (theirs, of_the_bus) in FRAMINGS.into_iter().flat_map(|theirs| FRAMINGS.map(|bus| (theirs, bus))) {
        let (mut direct, plcs) = direct(theirs);
        let bench = Bench::new(of_the_bus, UNRESTRICTED);
        let mut client = bench.client(theirs);
        let manuals = vectors().into_iter().filter(|v| v.framing == theirs && v.sender == Side::Client);
        // Requests that the bus's framing cannot carry have their own test.
        let manuals = manuals.filter(|v| {
            let request = Request::decode(&v.frame(), theirs).expect(v.row);
            encoded(&request, of_the_bus, 1).is_some()
        });
        let ours = requests().into_iter().filter(|request| encoded(request, of_the_bus, 1).is_some());
        let ours = ours.filter_map(|request| encoded(&request, theirs, 3));
        let mut count = 0;
        for bytes in manuals.map(|v| v.bytes).chain(ours.map(|bytes| bytes.to_vec())) {
            let expected = direct.exchange(&bytes).await.expect("a PLC answers");
            assert_eq!(client.exchange(&bytes).await, Some(expected), "{theirs} to {of_the_bus}: {bytes:02X?}");
            count += 1;
        }
        assert!(count >= 26, "{count}");
        for (plc, same) in plcs.iter().zip(&bench.plcs) {
            for element in [element!("R0"), element!("DR10"), element!("Y0"), element!("X16"), element!("WY8")] {
                assert_eq!(plc.read(element), same.read(element), "{theirs} to {of_the_bus}: {element}");
            }
            assert_eq!(plc.page(2), same.page(2), "{theirs} to {of_the_bus}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn faulty_requests_are_answered_without_bus_traffic() {
    for framing in FRAMINGS {
        let (mut direct, _) = direct(framing);
        let bench = Bench::new(framing, UNRESTRICTED);
        let mut client = bench.client(framing);
        let of_ascii: [(u8, &[u8]); 8] = [
            (0x99, b""),          // unknown command
            (0x46, b"03Q00012"),  // unknown symbol
            (0x46, b"41R00000"),  // 65 registers
            (0x46, b"02R65535"),  // past the last address
            (0x46, b"01WM0001"),  // not a multiple of 8
            (0x46, b"01R0001"),   // too short
            (0x41, b"2"),         // neither RUN nor STOP
            (0x45, b"02Y000012"), // not a state of a discrete
        ];
        let of_binary: [(u8, &[u8]); 8] = [
            (0x4F, &[0, 0]), // not in this framing
            (0x46, b"\x03Q\0\x0C"),
            (0x46, b"\x41R\0\0"),
            (0x46, b"\x02R\xFF\xFF"),
            (0x46, b"\x01WM\0\x01"),
            (0x46, b"\x01R\0"),
            (0x41, &[2]),
            (0x45, b"\x02Y\0\0\x01\x02"),
        ];
        let faulty = if framing == Framing::Ascii { of_ascii } else { of_binary };
        for (command, data) in faulty {
            let bytes = framed(framing, Side::Client, 1, command, data);
            let expected = direct.exchange(&bytes).await.expect("an error code");
            assert_eq!(client.exchange(&bytes).await, Some(expected), "{framing}: {command:02X} {data:?}");
        }
        assert_eq!(bench.proxy.counts(), Counts { faulty: 8, ..Counts::default() });
        assert_eq!(bench.faults.log().arrivals(), 0);

        // Neither answers a frame with a bad checksum, or noise; both go on.
        let mut bad = framed(framing, Side::Client, 1, 0x40, b"");
        let place = bad.len() - if framing == Framing::Ascii { 2 } else { 4 };
        bad[place] ^= 1;
        for noise in [&bad[..], b"\x06\x15"] {
            assert_eq!(direct.exchange(noise).await, None);
            assert_eq!(client.exchange(noise).await, None);
        }
        client.call(1, &ReadStatus).await.unwrap();
    }
}

#[tokio::test(start_paused = true)]
async fn requests_outside_the_bus_framing_get_error_4() {
    let refused = |result: Result<(), Unanswered>| {
        matches!(result, Err(Unanswered::Reply(ReplyError::Plc(ErrorCode::IllegalFormat))))
    };
    let bench = Bench::new(Framing::Binary, UNRESTRICTED);
    let mut client = bench.client(Framing::Ascii);
    assert!(refused(client.call(1, &ReadProgramPage::new(0)).await.map(|_| ())));
    assert!(refused(client.call(1, &WriteProgramPage::new(0, ProgramPage::new([0; PAGE_WORDS]))).await));
    // RT87, X0 has the bytes of R21504, WX0.
    let ambiguous = ReadMixed::new([element!("RT87"), element!("X0")]).unwrap();
    assert!(refused(client.call(1, &ambiguous).await.map(|_| ())));
    assert_eq!(bench.faults.log().arrivals(), 0);
    assert_eq!(client.call(1, &ReadRegisters::new(register!("D1"), 1).unwrap()).await.unwrap(), [word(1, 1)]);

    let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
    let mut client = bench.client(Framing::Binary);
    assert!(refused(client.call(1, &LoopBack::new(&[0xFF, 0xFF][..]).unwrap()).await));
    // The same list from a client is ambiguous.
    let reply = client.exchange(&framed(Framing::Binary, Side::Client, 1, 0x48, b"\x02RT\0WX\0\0")).await;
    assert_eq!(reply.unwrap(), framed(Framing::Binary, Side::Plc, 1, 0x48, &[4]));
    assert_eq!(bench.faults.log().arrivals(), 0);
    assert_eq!(bench.proxy.counts(), Counts { faulty: 2, ..Counts::default() });
}

#[tokio::test(start_paused = true)]
async fn read_only_mode_blocks_writes_and_control() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, READ_ONLY_MODE);
        let mut client = bench.client(framing);
        let prohibited = if framing == Framing::Ascii { ErrorCode::WriteProhibited } else { ErrorCode::IllegalFormat };
        let (mut held_back, mut done) = (0, 0);
        for request in requests() {
            let (code, Some(bytes)) = (request.code(), encoded(&request, framing, 2)) else { continue };
            let reply = client.exchange(&bytes).await.expect("an answer");
            let mut refusal = BytesMut::new();
            encode_refusal(code.into(), prohibited, framing, 2, &mut refusal);
            assert_eq!(reply == refusal, code.class() != Class::Read, "{framing}: {code}");
            if code.class() == Class::Read {
                done += 1;
                continue;
            }
            // As a broadcast the request gets no reply.
            assert_eq!(client.exchange(&encoded(&request, framing, 0).unwrap()).await, None, "{framing}: {code}");
            held_back += 2;
        }
        assert!(held_back >= 14 && done >= 9, "{held_back}, {done}");
        let counts = bench.proxy.counts();
        assert_eq!((counts.held_back, counts.done + counts.refused), (held_back, done));
        let log = bench.faults.log();
        assert!(log.entries().iter().all(|entry| entry.request().unwrap().code().class() == Class::Read));
        // In addition: the check of the station, and a page whose refusal may be that of the page
        // before. It is read again after another check.
        let stats = bench.proxy.link().stats().stations;
        let pages = u64::from(framing == Framing::Ascii);
        assert_eq!((stats.checks, stats.unproven_replies), (1 + pages, pages), "{framing}");
        assert_eq!((log.arrivals(), log.writes(), log.forgotten()), (done + 1 + 2 * pages, 0, 0));
    }
}

#[tokio::test(start_paused = true)]
async fn a_broadcast_is_executed_by_all_and_not_answered() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, UNRESTRICTED);
        let mut client = bench.client(framing);
        let write = Request::WriteRegisters(WriteRegisters::new(register!("R5"), [0xAAAA]).unwrap());
        client.send(&encoded(&write, framing, 0).unwrap()).await;
        // A read cannot be broadcast, and an unknown command is ignored.
        client.send(&encoded(&Request::ReadStatus(ReadStatus), framing, 0).unwrap()).await;
        client.send(&framed(framing, Side::Client, 0, 0x99, b"")).await;
        // The next frame must be the reply to this request.
        assert_eq!(client.call(8, &ReadRegisters::new(register!("R5"), 1).unwrap()).await.unwrap(), [0xAAAA]);
        assert!(bench.plcs.iter().all(|plc| plc.read(register!("R5")) == Value::Word(0xAAAA)));
        assert_eq!(bench.proxy.counts(), Counts { broadcast: 1, ignored: 2, done: 1, ..Counts::default() });
        // The broadcast, the read, and the check of the station.
        assert_eq!(bench.faults.log().arrivals(), 3);
    }
}

#[tokio::test(start_paused = true)]
async fn requests_to_unserved_stations_do_not_reach_the_bus() {
    let bench = Bench::new(Framing::Ascii, Rules { stations: 2..=3, read_only: false });
    let mut client = bench.client(Framing::Ascii);
    for station in [0, 1, 4, 255] {
        assert_eq!(
            client.exchange(&framed(Framing::Ascii, Side::Client, station, 0x41, b"0")).await,
            None,
            "{station}"
        );
    }
    assert_eq!(bench.faults.log().arrivals(), 0);
    client.call(2, &ReadStatus).await.unwrap();
    client.call(3, &ReadStatus).await.unwrap();
    assert_eq!(bench.proxy.counts(), Counts { ignored: 4, done: 2, ..Counts::default() });
}

#[tokio::test(start_paused = true)]
async fn a_dead_station_is_silent_and_soon_does_not_delay_others() {
    let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
    bench.faults.add_rule(Rule::new(Fault::Ignore).station(4));
    let read = ReadRegisters::new(register!("D0"), 1).unwrap();
    let (mut first, mut other) = (bench.client(Framing::Ascii), bench.client(Framing::Binary));
    let mut elapsed = Vec::new();
    for _ in 0..3 {
        // Two requests; the second one is answered after the timeout of the first.
        let began = Instant::now();
        first.send(&framed(Framing::Ascii, Side::Client, 4, 0x46, b"01D00000")).await;
        assert_eq!(first.call(5, &read).await.unwrap(), [word(5, 0)]);
        elapsed.push(began.elapsed());
        assert_eq!(other.call(6, &read).await.unwrap(), [word(6, 0)]);
    }
    assert!(elapsed[0] >= 3 * RESPONSE_TIMEOUT && elapsed[0] < CALL_TIMEOUT, "{elapsed:?}");
    assert_eq!(elapsed[2], Duration::ZERO, "the station is offline, so there is no timeout: {elapsed:?}");
    assert_eq!(bench.proxy.counts(), Counts { silent: 3, done: 6, ..Counts::default() });
}

#[tokio::test(start_paused = true)]
async fn an_unanswered_write_is_not_repeated() {
    let bench = Bench::new(Framing::Ascii, UNRESTRICTED);
    bench.faults.add_rule(Rule::new(Fault::DropReply).command(Code::WriteRegisters));
    let mut client = bench.client(Framing::Ascii);
    let write = WriteRegisters::new(register!("R0"), [7]).unwrap();
    assert!(matches!(client.call(1, &write).await, Err(Unanswered::Silence)));
    assert_eq!(client.call(1, &ReadRegisters::new(register!("R0"), 1).unwrap()).await.unwrap(), [7]);
    assert_eq!(bench.faults.log().applied(1, &Request::WriteRegisters(write)), 1);
}

#[tokio::test(start_paused = true)]
async fn the_gateway_sends_no_reply_after_its_timeout() {
    let late = Rule::new(Fault::Delay { min: Duration::from_millis(90), max: Duration::from_millis(90) });
    let call_timeout = Duration::from_millis(80);
    let bench = Bench::with_faults(Framing::Ascii, UNRESTRICTED, Faults::new(0).rule(late.times(1)), call_timeout);
    let mut client = bench.client(Framing::Ascii);
    // The client waits a little longer. It would take a later reply for that to its next request.
    assert!(matches!(client.call(1, &ReadRegisters::new(register!("D1"), 1).unwrap()).await, Err(Unanswered::Silence)));
    assert_eq!(client.call(1, &ReadRegisters::new(register!("D2"), 1).unwrap()).await.unwrap(), [word(1, 2)]);
}

#[tokio::test(start_paused = true)]
async fn pipelined_requests_are_answered_in_order() {
    for framing in FRAMINGS {
        let bench = Bench::new(framing, UNRESTRICTED);
        let mut client = bench.client(framing);
        let targets: Vec<_> = (0..20).map(|n| (1 + n % 7, u16::from(n) * 3)).collect();
        let requests = targets.iter().map(|&(station, address)| {
            let read = ReadRegisters::new(Register::new(Symbol::D, address).unwrap(), 1).unwrap();
            encoded(&Request::ReadRegisters(read), framing, station).unwrap()
        });
        let bytes = requests.collect::<Vec<_>>().concat();
        for piece in [bytes.len(), 1] {
            for piece in bytes.chunks(piece) {
                client.send(piece).await;
            }
            for &(station, address) in &targets {
                let read = ReadRegisters::new(Register::d(address), 1).unwrap();
                let mut expected = BytesMut::new();
                encode_reply(&read, Ok(&vec![word(station, address)]), framing, station, &mut expected);
                assert_eq!(client.reply().await, Some(expected), "{framing}, {station}, {address}");
            }
        }
    }
}
