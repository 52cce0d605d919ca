//! SIGKILL at random moments: at most one second of batches is lost, and none that an output got with `sync`.
//!
//! Seen failing without its cure: with batches that are written after 3 s instead of 0.5 s, 2.3 s were lost;
//! with `sync` and outputs that read what is in memory, batches that were delivered were lost.

use std::collections::BTreeSet;
use std::io::{BufRead, BufReader, Write};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use fatek_bridge::buffer::{Buffer, BufferSettings};

use super::common::*;

const OUTPUTS: [&str; 2] = ["fast", "slow"];

fn now_ms() -> u64 {
    u64::try_from(SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_millis()).unwrap()
}

fn say(line: &str) {
    let mut stdout = std::io::stdout().lock();
    stdout.write_all(line.as_bytes()).and_then(|()| stdout.flush()).unwrap();
}

/// Not a test: the process that is killed. It pushes batches and tells of each, and of each that it delivers.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn kill_child() {
    let Ok(dir) = std::env::var("FATEK_BUFFER_CHILD") else { return };
    let sync = std::env::var("FATEK_BUFFER_SYNC").is_ok();
    let first: u64 = number("FATEK_BUFFER_FIRST", 1);
    let settings = BufferSettings { sync, ..settings(Path::new(&dir)) };
    let buffer = Buffer::open(&settings, &OUTPUTS).unwrap();
    assert!(buffer.next_seqs().get("mixer").is_none_or(|next| *next >= first), "sequence numbers grow");
    tokio::spawn(deliver(buffer.cursor(0), |entry| {
        let kind = if entry.replay { 'R' } else { 'D' };
        say(&format!("\n{kind} {} {}\n", entry.batch.seq, now_ms()));
    }));
    for seq in first.. {
        buffer.push(batch(seq));
        say(&format!("\nP {seq} {}\n", now_ms()));
        tokio::time::sleep(Duration::from_millis(1)).await;
    }
}

/// The lines of the process before its end: sequence numbers with times.
#[derive(Default)]
struct Told {
    pushed: Vec<(u64, u64)>,
    delivered: Vec<u64>,
    replayed: Vec<u64>,
}

/// Runs the process, kills it after this time, and returns what it told.
fn run(dir: &Path, sync: bool, first: u64, time: Duration) -> Told {
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.args(["--exact", "kill::kill_child", "--nocapture"]);
    command.env("FATEK_BUFFER_CHILD", dir).env("FATEK_BUFFER_FIRST", first.to_string());
    if sync {
        command.env("FATEK_BUFFER_SYNC", "1");
    }
    let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let mut told = Told::default();
    let mut end: Option<Instant> = None;
    for line in lines.map_while(Result::ok) {
        let fields: Vec<&str> = line.split(' ').collect();
        let [kind, seq, at] = fields[..] else { continue };
        let (Ok(seq), Ok(at)) = (seq.parse(), at.parse()) else { continue };
        match kind {
            "P" => told.pushed.push((seq, at)),
            "D" => told.delivered.push(seq),
            "R" => told.replayed.push(seq),
            _ => continue,
        }
        let end = *end.get_or_insert_with(|| Instant::now() + time);
        if Instant::now() >= end {
            // The pipe still has what was told before.
            let _ = child.kill();
        }
    }
    child.wait().unwrap();
    told
}

async fn kill_often(sync: bool) {
    let kills: u32 = number("FATEK_BUFFER_KILLS", 6);
    let limit = if std::env::var("FATEK_BUFFER_STRICT").is_ok() { 1000 } else { 2000 };
    let mut rng = fastrand::Rng::with_seed(number("FATEK_BUFFER_SEED", 17));
    let dir = tempfile::tempdir().unwrap();
    let (mut next, mut known, mut losses) = (1, BTreeSet::new(), Vec::new());
    let (mut total, mut lost_total, mut undelivered) = (0, 0, 0);
    for kill in 0..kills {
        let told = run(dir.path(), sync, next, Duration::from_millis(rng.u64(50..4000)));
        let (Some((first, _)), Some((last, killed_at))) = (told.pushed.first(), told.pushed.last()) else {
            panic!("kill {kill}: nothing was pushed");
        };
        assert_eq!(*first, next);
        total += told.pushed.len();
        next = last + 2;
        assert!(told.delivered.is_sorted_by(|a, b| a < b), "delivered in order and once");
        assert!(told.delivered.iter().all(|seq| seq >= first), "an earlier batch is a replay");
        assert!(told.replayed.iter().all(|seq| seq < first), "a batch of this run is no replay");

        let buffer = Buffer::open(&BufferSettings { sync, ..settings(dir.path()) }, &OUTPUTS).unwrap();
        assert_eq!(buffer.figures().corrupt_files, 0, "a killed process leaves a good file");
        let slow = take_all(&buffer, 1, false).await;
        assert!(slow.iter().all(|entry| entry.replay));
        let slow: BTreeSet<u64> = slow.iter().map(|entry| entry.batch.seq).collect();
        assert!(known.is_subset(&slow), "kill {kill}: what was on disk before is still there");
        if sync {
            let lost: Vec<&u64> = told.delivered.iter().filter(|seq| !slow.contains(seq)).collect();
            assert!(lost.is_empty(), "kill {kill}: delivered, but not on disk: {lost:?}");
        }
        let lost: Vec<&(u64, u64)> = told.pushed.iter().filter(|(seq, _)| !slow.contains(seq)).collect();
        let fast: BTreeSet<u64> = told.delivered.iter().copied().collect();
        undelivered += lost.iter().filter(|(seq, _)| !fast.contains(seq)).count();
        lost_total += lost.len();
        let loss = lost.first().map_or(0, |(_, at)| killed_at.saturating_sub(*at));
        losses.push(loss);
        assert!(loss <= limit, "kill {kill}: {loss} ms are lost");
        // The loss is at the end: there is no gap.
        let kept = told.pushed.iter().take_while(|(seq, _)| slow.contains(seq)).count();
        assert_eq!(kept + lost.len(), told.pushed.len(), "kill {kill}: there is a gap");
        known = slow;
        if rng.bool() {
            take_all_again(&buffer).await;
            known.clear();
        }
        assert!(buffer.close().await);
    }
    losses.sort_unstable();
    let (median, worst) = (losses[losses.len() / 2], losses[losses.len() - 1]);
    println!(
        "sync {sync}: {kills} kills, {total} pushed, {lost_total} lost for the slow output ({undelivered} that the \
         fast one lacks, too); lost time: median {median} ms, worst {worst} ms"
    );
}

async fn take_all_again(buffer: &Buffer) {
    buffer.cursor(1).rewind();
    take_all(buffer, 1, true).await;
}

#[tokio::test]
async fn kill_loses_at_most_a_second() {
    kill_often(false).await;
}

#[tokio::test]
async fn kill_with_sync_loses_nothing_that_was_delivered() {
    kill_often(true).await;
}
