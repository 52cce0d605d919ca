//! Resources of an ended link. A single test, because open files are counted for the whole process.
#![cfg(target_os = "linux")]

use fatek::wire::Framing;
use fatek::{Link, LinkState};
use futures::FutureExt;
use tokio::io::DuplexStream;
use tokio::runtime::Builder;

/// Open files of this process, including the one opened to count them.
fn open_files() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

/// Creates a link whose task has run on a runtime that has ended, and the other end of its line. That has the
/// waker of the last read.
fn ended() -> (Link, DuplexStream) {
    let runtime = Builder::new_current_thread().enable_all().build().unwrap();
    let (client, plc) = tokio::io::duplex(4096);
    let link = Link::from_stream(client, Framing::Ascii);
    let station = link.station(1).unwrap();
    runtime.block_on(async {
        // No reply comes.
        let mut call = Box::pin(station.read_status());
        assert!((&mut call).now_or_never().is_none());
        while !matches!(link.state(), LinkState::Up) {
            tokio::task::yield_now().await;
        }
    });
    (link, plc)
}

#[test]
fn an_ended_link_keeps_no_files_open() {
    // Files that Tokio opens once stay open.
    let first = ended();
    let before = open_files();
    let links: Vec<(Link, DuplexStream)> = (0..10).map(|_| ended()).collect();
    assert_eq!(open_files(), before);
    assert!(links.iter().chain([&first]).all(|(link, _)| matches!(link.state(), LinkState::Closed)));
}
