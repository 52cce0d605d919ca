//! Read-only mode against mutated writes.

use std::time::Duration;

use bytes::BytesMut;
use fatek::command::Class;
use fatek::wire::{Framing, Side};
use tokio::time::sleep;

use crate::bench::{Bench, READ_ONLY_MODE, UNRESTRICTED, word};
use crate::common::{FRAMINGS, Rng, frame_content, framed};
use crate::proxy::Rules;
use crate::{encoded, requests};

/// Mutated requests of each framing.
const REQUESTS: usize = 6000;

/// Mutated requests of one client, without a pause between them.
const AT_ONCE: usize = 20;

/// A write or control command with one to three changes. In half of them the frame is whole, and its
/// checksum right.
fn mutated(framing: Framing, random: &mut Rng) -> Vec<u8> {
    let mut below = |limit: usize| usize::try_from(random.next() % u64::try_from(limit).unwrap()).unwrap();
    let writes: Vec<_> = requests().into_iter().filter(|request| request.code().class() != Class::Read).collect();
    let station = u8::try_from(below(10)).unwrap();
    let bytes: BytesMut = loop {
        if let Some(bytes) = encoded(&writes[below(writes.len())], framing, station) {
            break bytes;
        }
    };
    let whole = below(2) == 0;
    let frame = frame_content(framing, &bytes);
    let mut part = if whole { frame.data.to_vec() } else { bytes.to_vec() };
    for _ in 0..=below(3) {
        let at = below(part.len().max(1));
        match (below(7), part.is_empty()) {
            (_, true) | (0, _) => part.insert(at.min(part.len()), u8::try_from(below(256)).unwrap()),
            (1, _) => part[at] ^= 1 << below(8),
            (2, _) => part[at] = u8::try_from(below(256)).unwrap(),
            (3, _) => part[at] = b"0123456789ABCDEF\x02\x03"[below(18)],
            (4, _) => drop(part.remove(at)),
            (5, _) => part.truncate(at),
            _ => part.extend_from_within(at..),
        }
    }
    let command = if below(8) == 0 { u8::try_from(below(256)).unwrap() } else { frame.command };
    if whole { framed(framing, Side::Client, station, command, &part[..part.len().min(400)]).to_vec() } else { part }
}

/// Sends all mutated requests to a gateway. Returns the bench, and how many of them were executed.
async fn attack(framing: Framing, rules: Rules, seed: u64) -> (Bench, u64) {
    let bench = Bench::new(framing, rules);
    let mut random = Rng(seed);
    for _ in 0..REQUESTS / AT_ONCE {
        let mut client = bench.client(framing);
        for _ in 0..AT_ONCE {
            client.try_send(&mutated(framing, &mut random)).await;
        }
        // All are answered, or their response timeouts have passed.
        sleep(Duration::from_secs(60)).await;
    }
    let executed = bench.faults.log().writes();
    (bench, executed)
}

/// The same requests without read-only mode show that many of them are good writes.
#[tokio::test(start_paused = true)]
async fn twelve_thousand_mutated_writes_do_not_reach_a_plc() {
    for framing in FRAMINGS {
        let seed = 0x5EED;
        let (_, executed) = attack(framing, UNRESTRICTED, seed).await;
        let (bench, none) = attack(framing, READ_ONLY_MODE, seed).await;
        println!("{framing}: of {REQUESTS} mutated writes {executed} are executed, and {none} in read-only mode");
        assert!(executed > 300, "{framing}: seed {seed:#x}: only {executed} of them are writes");
        assert_eq!(none, 0, "{framing}: seed {seed:#x}");
        assert!(bench.proxy.counts().held_back > 300, "{framing}");
        let log = bench.faults.log();
        let is_read = |code: fatek::command::Code| code.class() == Class::Read;
        assert!(log.entries().iter().all(|entry| entry.request().is_none_or(|request| is_read(request.code()))));
        let plcs = bench.plcs.iter().zip(1_u8..);
        assert!(plcs.clone().all(|(plc, _)| !plc.is_running()));
        for (plc, station) in plcs {
            assert_eq!(plc.read(fatek::register!("D5")), word(station, 5).into());
            assert_eq!(plc.read(fatek::register!("R0")), 0_u16.into());
        }
    }
}
