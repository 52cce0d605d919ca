//! The file stays within its limit and shrinks; memory stays within its own.

use std::os::unix::fs::MetadataExt;
use std::path::Path;
use std::time::Duration;

use fatek_bridge::buffer::{Buffer, BufferSettings};

use super::common::*;

/// The length of the file, and the bytes that it takes on the disk.
fn size(dir: &Path) -> (u64, u64) {
    let metadata = std::fs::metadata(dir.join("buffer.redb")).unwrap();
    (metadata.len(), metadata.blocks() * 512)
}

#[tokio::test]
async fn the_file_stays_within_its_limit_over_many_cycles() {
    let dir = tempfile::tempdir().unwrap();
    let max = 4 << 20;
    let settings = BufferSettings { max, memory: 1 << 20, ..settings(dir.path()) };
    let buffer = Buffer::open(&settings, &["fast", "slow"]).unwrap();
    let fast = tokio::spawn(deliver(buffer.cursor(0), |_| {}));
    let (mut longest, mut largest, mut seq) = (0, 0, 0);
    let cycles: u32 = number("FATEK_BUFFER_CYCLES", 6);
    for cycle in 0..cycles {
        // More than the limit, so that the oldest is dropped.
        let look = || {
            let (length, blocks) = size(dir.path());
            (longest, largest) = (longest.max(length), largest.max(blocks));
        };
        seq = push_stalled(&buffer, settings.memory, seq + 1, 40_000, look).await;
        let before = buffer.stats()[1];
        let taken = take_all(&buffer, 1, cycle % 2 == 0).await;
        assert_eq!(taken.last().map(|entry| entry.batch.seq), Some(seq));
        assert_eq!(buffer.stats()[1].dropped, before.dropped, "nothing is lost on the way back");
        assert!(u64::try_from(taken.len()).unwrap() == before.lag && before.dropped > 0, "{before:?}");
        assert!(taken.is_sorted_by(|a, b| a.batch.seq + 1 == b.batch.seq), "no gap");
        buffer.cursor(1).rewind();
    }
    println!("limit {max}: file at most {largest} bytes on disk, length at most {longest}");
    assert!(largest <= max + max / 8, "{largest} bytes on disk");
    assert!(longest <= 2 * max, "{longest} bytes long");
    take_all(&buffer, 1, true).await;
    tokio::time::sleep(Duration::from_millis(700)).await;
    assert!(buffer.close().await);
    fast.abort();
}

#[tokio::test]
async fn the_file_shrinks_when_all_is_delivered() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer::open(&settings(dir.path()), &["mqtt"]).unwrap();
    push_stalled(&buffer, 4 << 20, 1, 60_000, || {}).await;
    let (full, _) = size(dir.path());
    assert!(full > 10 << 20);
    assert_eq!(take_all(&buffer, 0, true).await.len(), 60_000);
    wait_until("the file is small", || size(dir.path()).0 < 2 << 20).await;
    println!("{full} bytes with a backlog, {} without", size(dir.path()).0);
    assert!(buffer.close().await);
}
