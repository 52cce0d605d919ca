//! What a link that has ended with its runtime keeps of it. One test, because open files are counted for the whole process.
#![cfg(target_os = "linux")]

use fatek::wire::Framing;
use fatek::{Link, LinkState};
use futures::FutureExt;
use tokio::runtime::Builder;

/// Of this process, with the one that it takes to count them.
fn open_files() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

/// A link whose task has run, on a runtime that is gone.
fn ended() -> Link {
    let runtime = Builder::new_current_thread().enable_all().build().unwrap();
    let (client, _plc) = tokio::io::duplex(4096);
    let link = Link::from_stream(client, Framing::Ascii);
    let station = link.station(1).unwrap();
    runtime.block_on(async {
        // Nobody answers.
        let mut call = Box::pin(station.read_status());
        assert!((&mut call).now_or_never().is_none());
        while !matches!(link.state(), LinkState::Up) {
            tokio::task::yield_now().await;
        }
    });
    link
}

#[test]
fn a_link_that_has_ended_keeps_nothing_of_its_runtime_open() {
    // What Tokio opens once stays open.
    let first = ended();
    let before = open_files();
    let links: Vec<Link> = (0..10).map(|_| ended()).collect();
    assert_eq!(open_files(), before);
    assert!(links.iter().chain([&first]).all(|link| matches!(link.state(), LinkState::Closed)));
}
