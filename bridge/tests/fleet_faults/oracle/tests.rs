//! Tests of the oracle: requests that it must find, and requests that it must not.

use std::time::Duration;

use super::*;
use crate::plcs::Arrival;

/// Times are milliseconds after a common begin.
struct Scene {
    begin: Instant,
    oracle: Oracle,
    record: Record,
}

impl Scene {
    fn new() -> Self {
        let (oracle, record) = (Oracle::new(vec!["plc".to_owned()]), Record::default());
        Self { begin: Instant::now(), oracle, record }
    }

    fn at(&self, time: u64) -> Instant {
        self.begin + Duration::from_millis(time)
    }

    fn entry(&mut self, epoch: u32, revision: u64, session: &str, stored: u64) {
        let token = Token { epoch, revision };
        let (link, session) = ("plc".to_owned(), session.to_owned());
        let stored = self.at(stored);
        let entry = Entry { link, session, token, after: stored, stored };
        self.oracle.add(vec![entry]);
    }

    fn connection(&mut self, number: usize, process: usize, accepted: u64) {
        let connection = Connection { process: Some(process), link: 0, accepted: self.at(accepted) };
        self.record.connections.insert(number, connection);
    }

    fn arrival(&mut self, connection: usize, after: u64, before: u64) {
        let (after, before) = (self.at(after), self.at(before));
        self.record.arrivals.push(Arrival { connection, after, before });
    }

    fn judge(mut self) -> Judged {
        let sessions = [("a", 0), ("b", 1), ("c", 0)].map(|(name, process)| (name.to_owned(), process));
        self.oracle.judge(&self.record, &sessions.into(), |_| None);
        self.oracle.judged
    }
}

/// `a` has the link until `b` takes it at 100.
fn handover() -> Scene {
    let mut scene = Scene::new();
    scene.entry(0, 5, "a", 0);
    scene.connection(0, 0, 1);
    scene.arrival(0, 2, 3);
    scene.entry(0, 9, "b", 100);
    scene.connection(1, 1, 101);
    scene
}

#[test]
fn a_request_after_one_of_a_newer_owner_is_stale() {
    let mut scene = handover();
    scene.arrival(1, 102, 103);
    scene.arrival(0, 104, 105);
    let judged = scene.judge();
    assert_eq!((judged.requests, judged.stale, judged.late, judged.used), (3, 1, 0, 2), "{:?}", judged.faults);
}

#[test]
fn a_request_after_a_newer_entry_is_late() {
    let mut scene = handover();
    scene.arrival(0, 101, 102);
    scene.arrival(1, 103, 104);
    let judged = scene.judge();
    assert_eq!((judged.stale, judged.late), (0, 1), "{:?}", judged.faults);
    // Also after the release of the owner itself.
    let mut scene = Scene::new();
    scene.entry(0, 5, "a", 0);
    scene.connection(0, 0, 1);
    scene.entry(0, 6, "", 50);
    scene.arrival(0, 51, 52);
    assert_eq!(scene.judge().late, 1);
}

#[test]
fn requests_in_no_certain_order_are_good() {
    let mut scene = handover();
    scene.arrival(1, 102, 105);
    scene.arrival(0, 99, 105);
    assert_eq!(scene.judge().wrong(), 0);
}

#[test]
fn a_process_may_own_a_link_again() {
    let mut scene = handover();
    scene.arrival(1, 102, 103);
    scene.entry(0, 12, "c", 200);
    scene.connection(2, 0, 201);
    scene.arrival(2, 202, 203);
    // Its former connection is stale, although it owns the link.
    scene.arrival(0, 210, 211);
    let judged = scene.judge();
    assert_eq!((judged.stale, judged.late, judged.ownerships, judged.used), (1, 0, 3, 3), "{:?}", judged.faults);
}

#[test]
fn a_store_that_was_set_back_has_newer_tokens() {
    let mut scene = handover();
    scene.arrival(1, 102, 103);
    scene.entry(1, 7, "c", 200);
    scene.connection(2, 0, 201);
    scene.arrival(2, 202, 203);
    scene.arrival(1, 210, 211);
    let judged = scene.judge();
    assert_eq!((judged.stale, judged.late), (1, 0), "{:?}", judged.faults);
}

#[test]
fn a_request_without_an_ownership_is_found() {
    let mut scene = Scene::new();
    scene.entry(0, 5, "a", 10);
    // Made before the entry was stored.
    scene.connection(0, 0, 9);
    scene.arrival(0, 11, 12);
    scene.connection(1, 7, 20);
    scene.arrival(1, 21, 22);
    assert_eq!(scene.judge().unowned, 2);
}
