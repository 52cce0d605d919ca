//! Files that were cut or changed: no panic, nothing but what was pushed is delivered, and all that is lost is
//! counted.
//!
//! Seen failing without its cure: without the checksum of the records, a file that was changed while it was
//! open delivered wrong data: batches out of order.

use std::fs;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use fatek_bridge::buffer::{Buffer, BufferSettings};

use super::common::*;

const BATCHES: u64 = 2000;

fn file(dir: &Path) -> PathBuf {
    dir.join("buffer.redb")
}

/// The bytes of a good file with all batches.
async fn good_file() -> Vec<u8> {
    let dir = tempfile::tempdir().unwrap();
    let buffer = Buffer::open(&settings(dir.path()), &["mqtt"]).unwrap();
    (1..=BATCHES).for_each(|seq| {
        buffer.push(batch(seq));
    });
    assert!(buffer.close().await);
    fs::read(file(dir.path())).unwrap()
}

#[derive(Default)]
struct Outcomes {
    all: u32,
    some: u32,
    none: u32,
    refused: u32,
}

impl Outcomes {
    /// Opens a file with this content. All that is delivered is checked; the buffer works on.
    async fn open(&mut self, content: &[u8]) {
        let dir = tempfile::tempdir().unwrap();
        fs::write(file(dir.path()), content).unwrap();
        let Ok(buffer) = Buffer::open(&settings(dir.path()), &["mqtt"]) else {
            self.refused += 1;
            return;
        };
        let taken = take_all(&buffer, 0, true).await;
        let figures = buffer.figures();
        if figures.corrupt_files == 0 && figures.corrupt_batches == 0 && !content.is_empty() {
            assert_eq!(seqs(&taken), (1..=BATCHES).collect::<Vec<_>>(), "a file that counts as good has all");
            self.all += 1;
        } else if taken.is_empty() {
            self.none += 1;
        } else {
            self.some += 1;
        }
        if figures.corrupt_files == 1 {
            let kept = fs::read(dir.path().join("buffer.damaged-1")).unwrap();
            assert!(kept.len() >= content.len().min(4096), "the damaged file is kept");
        }
        buffer.push(batch(BATCHES + 1));
        assert_eq!(seqs(&take_all(&buffer, 0, false).await), [BATCHES + 1]);
        assert!(buffer.close().await, "the buffer works on");
    }

    fn print(&self, what: &str) {
        let Self { all, some, none, refused } = self;
        println!("{what}: all delivered {all}, some {some}, none {none}, refused {refused}");
        assert_eq!(*refused, 0, "a damaged file never keeps the bridge from starting");
    }
}

#[tokio::test]
async fn damage_by_truncation_is_survived() {
    let good = good_file().await;
    let mut outcomes = Outcomes::default();
    let cuts: usize = number("FATEK_BUFFER_CUTS", 60);
    let mut lengths: Vec<usize> = (0..cuts).map(|cut| good.len() * cut / cuts).collect();
    lengths.extend([1, 8, 63, 64, 127, 128, 319, 320, 4095, 4096, 4097, good.len() - 4096, good.len() - 1]);
    for length in lengths {
        outcomes.open(&good[..length]).await;
    }
    outcomes.print("cut");
}

#[tokio::test]
async fn damage_of_bytes_is_survived() {
    let good = good_file().await;
    let mut outcomes = Outcomes::default();
    let mut rng = fastrand::Rng::with_seed(number("FATEK_BUFFER_SEED", 3));
    for flip in 0..number("FATEK_BUFFER_FLIPS", 60) {
        let mut bad = good.clone();
        // The header decides the most, so every second byte is there or in the first pages.
        let end = if flip % 2 == 0 { bad.len() } else { 16 << 10 };
        let at = rng.usize(..end);
        bad[at] ^= 1 << rng.u8(..8);
        outcomes.open(&bad).await;
    }
    // A page that was not written.
    for page in (0..good.len() / 4096).step_by(good.len() / 4096 / 16 + 1) {
        let mut bad = good.clone();
        bad[page * 4096..(page + 1) * 4096].fill(0);
        outcomes.open(&bad).await;
    }
    outcomes.print("changed");
}

#[tokio::test]
async fn damage_while_the_file_is_open_is_counted() {
    let rounds: u32 = number("FATEK_BUFFER_FLIPS", 12);
    let mut rng = fastrand::Rng::with_seed(number("FATEK_BUFFER_SEED", 5));
    let (mut delivered_all, mut files, mut batches) = (0, 0, 0);
    for round in 0..rounds {
        let dir = tempfile::tempdir().unwrap();
        // Little memory, so that nearly all is read back from the file.
        let buffer = Buffer::open(&BufferSettings { memory: 256 << 10, ..settings(dir.path()) }, &["mqtt"]).unwrap();
        let total = 8_000;
        push_stalled(&buffer, 256 << 10, 1, total, || {}).await;
        let open = fs::OpenOptions::new().write(true).open(file(dir.path())).unwrap();
        let length = open.metadata().unwrap().len();
        for _ in 0..rng.u32(1..40) {
            open.write_at(&[rng.u8(..), rng.u8(..)], rng.u64(..length - 2)).unwrap();
        }
        let taken = take_all(&buffer, 0, true).await;
        let figures = buffer.figures();
        let lost = buffer.stats()[0].dropped;
        assert_eq!(u64::try_from(taken.len()).unwrap() + lost, total, "round {round}: what is lost is counted");
        delivered_all += u32::from(lost == 0);
        files += figures.corrupt_files;
        batches += figures.corrupt_batches;
        buffer.push(batch(total + 1));
        assert_eq!(seqs(&take_all(&buffer, 0, true).await), [total + 1]);
        assert!(buffer.close().await, "the buffer works on");
    }
    println!("{rounds} rounds: {delivered_all} without loss, {files} files moved aside, {batches} batches lost");
}

/// Without the cure an empty file was taken for a new one: what was lost with its content was not told.
#[tokio::test]
async fn damage_that_left_no_content_is_counted() {
    for content in [Vec::new(), vec![0; 1 << 20]] {
        let dir = tempfile::tempdir().unwrap();
        fs::write(file(dir.path()), &content).unwrap();
        let buffer = Buffer::open(&settings(dir.path()), &["mqtt"]).unwrap();
        assert_eq!(buffer.figures().corrupt_files, 1, "{} bytes", content.len());
        assert_eq!(fs::read(dir.path().join("buffer.damaged-1")).unwrap(), content);
        assert!(buffer.close().await);
    }
}

#[tokio::test]
async fn damage_keeps_at_most_three_files() {
    let dir = tempfile::tempdir().unwrap();
    for number in 0..5 {
        fs::write(file(dir.path()), format!("no database {number}")).unwrap();
        let buffer = Buffer::open(&settings(dir.path()), &["mqtt"]).unwrap();
        assert_eq!(buffer.figures().corrupt_files, 1);
        assert!(buffer.close().await);
    }
    let kept = |number: u32| fs::read_to_string(dir.path().join(format!("buffer.damaged-{number}"))).unwrap();
    assert_eq!([kept(1), kept(2), kept(3)], ["no database 4", "no database 3", "no database 2"]);
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 4);
}
