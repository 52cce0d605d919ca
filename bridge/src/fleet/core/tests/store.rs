//! Stores that were deleted or set back.

use super::*;

#[test]
fn a_store_with_another_creation_time_stops_the_member() {
    let mut bench = Bench::active(&["plc1"], &[]);
    let token = bench.own("plc1");
    bench.feed(Input::Connected { created: 8, last_revision: 200 });
    let fault = StoreFault::Recreated { before: 7, now: 8 };
    let close = Action::Close { link: "plc1".into(), token };
    let gate = Action::Gate { session: "me-1".into(), until: 0 };
    assert_eq!(bench.take_actions(), [gate, close, Action::Fail(fault)]);
    bench.feed(Input::Closed { link: "plc1".into(), token });
    bench.wait(10 * L);
    bench.reconnect(300, &[]);
    assert_eq!((bench.requests.len(), bench.core.wake_at()), (0, None), "for good");
    assert!(matches!(bench.core.state(), MemberState::Failed(_)));
}

#[test]
fn a_store_that_was_set_back_stops_the_member() {
    let value = session("hall-1", |_| {});
    type Case<'a> = (&'a str, u64, &'a [(&'a str, &'a str, u64)]);
    let cases: [Case<'_>; 5] = [
        ("it", 102, &[]),
        ("l.plc1", 300, &[("w.me-1", &value, 101), ("l.plc1", "me-1", 102)]),
        ("l.plc1", 300, &[("w.me-1", &value, 101)]),
        ("w.me-1", 300, &[("w.me-1", &value, 99)]),
        ("l.plc1", 300, &[("w.me-1", &value, 101), ("l.plc1", "x", 103)]),
    ];
    for (fault, last_revision, entries) in cases {
        let mut bench = Bench::active(&["plc1"], &[]);
        assert_eq!(bench.own("plc1").revision, 103);
        bench.reconnect(last_revision, entries);
        let is_it = |action: &Action| matches!(action, Action::Fail(StoreFault::SetBack { what, .. }) if what == fault);
        assert!(bench.actions.iter().any(is_it), "{fault}: {:?}", bench.actions);
    }
}

#[test]
fn a_revision_that_does_not_rise_stops_the_member() {
    let mut bench = Bench::active(&["plc1"], &[]);
    bench.wait(L / 3);
    let (request, _) = bench.put("w.me-1");
    // A store that was deleted and made again has begun to count anew.
    bench.reply(request, Outcome::Stored(3));
    assert!(matches!(bench.actions.last(), Some(Action::Fail(StoreFault::SetBack { now: 3, .. }))));
}
