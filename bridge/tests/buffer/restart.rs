//! The end of a run, and the next one.

use std::time::Duration;

use fatek_bridge::buffer::{Buffer, BufferError};

use super::common::*;

#[tokio::test]
async fn a_closed_buffer_goes_on_with_all_that_was_not_acknowledged() {
    let dir = tempfile::tempdir().unwrap();
    let settings = settings(dir.path());
    let buffer = Buffer::open(&settings, &["mqtt", "nats"]).unwrap();
    let positions: Vec<u64> = (1..=1000).map(|seq| buffer.push(batch(seq))).collect();
    let mut mqtt = buffer.cursor(0);
    let read = mqtt.next(700).await;
    assert!(read.iter().all(|entry| !entry.replay));
    mqtt.acknowledge(read[699].position);
    assert!(buffer.close().await);

    let buffer = Buffer::open(&settings, &["nats", "mqtt"]).unwrap();
    assert!(buffer.next_seqs()["mixer"] > 1000);
    assert!(buffer.push(batch(1001)) > positions[999], "positions grow");
    let nats = take_all(&buffer, 0, true).await;
    assert_eq!(seqs(&nats), (1..=1001).collect::<Vec<_>>());
    let mqtt = take_all(&buffer, 1, true).await;
    assert_eq!(seqs(&mqtt), (701..=1001).collect::<Vec<_>>());
    // A batch that an earlier run may have delivered is a replay; the new batch is not.
    assert!(mqtt.iter().all(|entry| entry.replay == (entry.batch.seq <= 1000)));
    assert!(buffer.close().await);

    let buffer = Buffer::open(&settings, &["nats", "mqtt"]).unwrap();
    assert_eq!(buffer.figures().batches, 0);
    assert!(buffer.close().await);
}

#[tokio::test]
async fn a_removed_output_holds_nothing_back_and_a_new_one_gets_all() {
    let dir = tempfile::tempdir().unwrap();
    let settings = settings(dir.path());
    let buffer = Buffer::open(&settings, &["mqtt", "nats"]).unwrap();
    (1..=100).for_each(|seq| {
        buffer.push(batch(seq));
    });
    let mut mqtt = buffer.cursor(0);
    let read = mqtt.next(60).await;
    mqtt.acknowledge(read[59].position);
    assert!(buffer.close().await);

    let buffer = Buffer::open(&settings, &["mqtt"]).unwrap();
    assert_eq!(seqs(&take_all(&buffer, 0, false).await), (61..=100).collect::<Vec<_>>());
    assert!(buffer.close().await);

    // Chunks leave the buffer whole, so the new output gets more than `mqtt` lacks.
    let buffer = Buffer::open(&settings, &["mqtt", "stdout"]).unwrap();
    let stdout = take_all(&buffer, 1, false).await;
    assert_eq!(seqs(&stdout).last(), Some(&100));
    assert!(stdout[0].batch.seq <= 61 && stdout.iter().all(|entry| entry.replay));
    assert!(buffer.close().await);
}

#[tokio::test]
async fn a_second_process_on_the_same_file_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let settings = settings(dir.path());
    let buffer = Buffer::open(&settings, &["mqtt"]).unwrap();
    let error = Buffer::open(&settings, &["mqtt"]).unwrap_err();
    assert!(matches!(error, BufferError::InUse { .. }), "{error:?}");
    assert!(error.to_string().ends_with("another process uses it; each bridge needs its own `buffer.dir`"));
    assert!(buffer.close().await);
    assert!(Buffer::open(&settings, &["mqtt"]).unwrap().close().await);
}

#[tokio::test]
async fn with_sync_a_batch_is_delivered_soon_and_only_from_disk() {
    let dir = tempfile::tempdir().unwrap();
    let settings = fatek_bridge::buffer::BufferSettings { sync: true, ..settings(dir.path()) };
    let buffer = Buffer::open(&settings, &["mqtt"]).unwrap();
    let mut cursor = buffer.cursor(0);
    for seq in 1..=50 {
        buffer.push(batch(seq));
        let read = tokio::time::timeout(PATIENCE, cursor.next(9)).await.unwrap();
        assert_eq!(seqs(&read), [seq]);
        assert_eq!(buffer.figures().spilled_batches, seq);
        cursor.acknowledge(read[0].position);
    }
    assert!(buffer.close().await);
}

#[tokio::test]
async fn what_is_acknowledged_at_once_is_never_written() {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer::open(&settings(dir.path()), &["mqtt"]).unwrap();
    let mut cursor = buffer.cursor(0);
    for seq in 1..=300 {
        buffer.push(batch(seq));
        let read = cursor.next(9).await;
        cursor.acknowledge(read.last().unwrap().position);
        tokio::time::sleep(Duration::from_millis(2)).await;
    }
    assert_eq!(buffer.figures().spilled_batches, 0);
    assert!(buffer.close().await);
}

#[test]
fn limits_that_are_too_small_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let small = fatek_bridge::buffer::BufferSettings { max: 5000, ..settings(dir.path()) };
    let error = Buffer::open(&small, &["mqtt"]).unwrap_err().to_string();
    assert_eq!(error, "buffer.max is 5000 bytes: it is at least 1048576 bytes");
    let blocked = dir.path().join("file");
    std::fs::write(&blocked, "").unwrap();
    assert!(matches!(Buffer::open(&settings(&blocked), &["mqtt"]), Err(BufferError::Io { .. })));
}
