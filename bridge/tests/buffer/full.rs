//! A disk that takes no more: the poller never waits, the other outputs get all, and what is dropped is counted.

use std::io::Write;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use fatek_bridge::buffer::{Buffer, BufferSettings};

use super::common::*;

/// Not a test: a process whose files may have 2 MiB.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn full_child() {
    let Ok(dir) = std::env::var("FATEK_BUFFER_FULL") else { return };
    let buffer =
        Buffer::open(&BufferSettings { memory: 1 << 20, ..settings(Path::new(&dir)) }, &["fast", "slow"]).unwrap();
    let delivered = Arc::new(AtomicU64::new(0));
    let count = delivered.clone();
    tokio::spawn(deliver(buffer.cursor(0), move |_| {
        count.fetch_add(1, Ordering::Relaxed);
    }));
    let (mut longest, mut total, mut was_full) = (Duration::ZERO, 0, false);
    // 8 MB in about 4 s.
    for seq in 1..=32_000 {
        let before = Instant::now();
        buffer.push(batch(seq));
        longest = longest.max(before.elapsed());
        total = seq;
        if seq % 8 == 0 {
            was_full |= buffer.figures().is_full;
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        assert!(buffer.bytes() <= 1 << 20, "memory is bounded");
    }
    wait_until("the fast output has all", || delivered.load(Ordering::Relaxed) + buffer.stats()[0].dropped == total)
        .await;
    let (fast, slow) = (buffer.stats()[0], buffer.stats()[1]);
    let figures = buffer.figures();
    let line = format!(
        "\nfull: longest push {longest:?}, fast {fast:?}, slow {slow:?}, errors {}, failure {:?}\n",
        figures.disk_errors, figures.failure
    );
    std::io::stdout().write_all(line.as_bytes()).unwrap();
    assert!(figures.disk_errors > 0 && figures.failure.is_some(), "{figures:?}");
    assert_eq!((fast.dropped, fast.lag), (0, 0));
    assert!(was_full, "it drops batches, and is not full");
    assert!(slow.dropped > 0 && slow.dropped + slow.lag == total, "{slow:?}");
    assert!(!buffer.close().await, "the end tells that not all is written");
    std::io::stdout().write_all(b"\nfull: passed\n").unwrap();
}

#[test]
fn a_full_disk_holds_up_nobody() {
    let dir = tempfile::tempdir().unwrap();
    let script = "trap '' XFSZ; ulimit -f 2048; exec \"$0\" --exact full::full_child --nocapture";
    let mut command = Command::new("bash");
    command.arg("-c").arg(script).arg(std::env::current_exe().unwrap());
    let output = command.env("FATEK_BUFFER_FULL", dir.path()).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout);
    assert!(
        output.status.success() && text.contains("full: passed"),
        "{text}\n{}",
        String::from_utf8_lossy(&output.stderr)
    );
    text.lines().filter(|line| line.starts_with("full: ")).for_each(|line| println!("{line}"));
}

#[tokio::test]
async fn a_process_with_place_goes_on_with_the_full_file() {
    let dir = tempfile::tempdir().unwrap();
    let script = "trap '' XFSZ; ulimit -f 2048; exec \"$0\" --exact full::full_child --nocapture";
    let mut command = Command::new("bash");
    command.arg("-c").arg(script).arg(std::env::current_exe().unwrap());
    assert!(command.env("FATEK_BUFFER_FULL", dir.path()).output().unwrap().status.success());
    let buffer = Buffer::open(&settings(dir.path()), &["fast", "slow"]).unwrap();
    assert_eq!(buffer.figures().corrupt_files, 0, "the file is good");
    let taken = take_all(&buffer, 1, true).await;
    println!("{} batches were on the full disk", taken.len());
    assert!(taken.len() > 1000 && taken[0].batch.seq == 1);
    assert!(buffer.close().await);
}
