//! The own session: its deadline, renewals without a result, and its end.

use super::*;

#[test]
fn the_deadline_counts_from_before_the_sending() {
    let mut bench = Bench::new(&[]);
    bench.connect(&[]);
    let sent = bench.now;
    let (request, operation) = bench.put("w.me-1");
    assert!(matches!(operation, Operation::Put { expected: 0, .. }));
    bench.now += L / 5;
    bench.store(request);
    assert_eq!(bench.open_until(), sent + L - L / 10);
    assert_eq!(bench.core.wake_at(), Some(sent + L / 3), "renewed each third of a lease");
    bench.now = sent + L - L / 10;
    assert_eq!(bench.open_until(), 0, "closed at the deadline");
}

#[test]
fn a_renewal_without_a_result_is_read_and_adopted() {
    let mut bench = Bench::active(&[], &[]);
    let before = bench.open_until();
    bench.wait(L / 3);
    let (renewal, operation) = bench.put("w.me-1");
    let Operation::Put { value, .. } = operation else { panic!() };
    bench.wait(L / 4);
    bench.reply(renewal, Outcome::Unknown);
    let (read, operation) = bench.requests.remove(0);
    assert_eq!(operation, Operation::Get { key: "w.me-1".to_owned() });
    bench.wait(L / 20);
    bench.reply(read, Outcome::Found { value: Some(value), revision: 150 });
    assert_eq!(bench.open_until(), before, "what was read moves no deadline");
    let (request, operation) = bench.put("w.me-1");
    assert!(matches!(operation, Operation::Put { expected: 150, .. }), "the revision is adopted");
    bench.revision = 150;
    let sent = bench.now;
    bench.store(request);
    assert_eq!(bench.open_until(), sent + L - L / 10);
}

#[test]
fn a_renewal_that_was_not_stored_is_sent_again() {
    let mut bench = Bench::active(&[], &[]);
    let value = session("hall-1", |value| value.beat = 1);
    bench.wait(L / 3);
    let (renewal, _) = bench.put("w.me-1");
    bench.wait(L / 4);
    bench.reply(renewal, Outcome::Unknown);
    let (read, _) = bench.requests.remove(0);
    bench.wait(L / 20);
    bench.reply(read, Outcome::Found { value: Some(value), revision: 101 });
    let (_, operation) = bench.put("w.me-1");
    assert!(matches!(operation, Operation::Put { expected: 101, .. }));
}

#[test]
fn a_fenced_member_closes_its_links_and_joins_again() {
    let mut bench = Bench::active(&["plc1"], &[]);
    let token = bench.own("plc1");
    bench.see("w.me-1", DEAD);
    let close = Action::Close { link: "plc1".into(), token };
    assert_eq!(bench.take_actions(), [Action::Gate { session: "me-1".into(), until: 0 }, close]);
    bench.pass(L / 3);
    assert_eq!(bench.core.session_name().map(|name| &**name), Some("me-2"));
    assert_eq!(bench.requests, [], "not before the link is closed");
    bench.feed(Input::Closed { link: "plc1".into(), token });
    assert_eq!(bench.put("l.plc1").1, put("l.plc1", "me-2", token.revision), "an entry of a dead session");
}

#[test]
fn a_value_that_this_process_did_not_write_ends_the_session() {
    let mut bench = Bench::active(&[], &[]);
    // The first attempt again, after it was stored.
    let value = session("hall-1", |value| value.beat = 1);
    bench.see("w.me-1", &value);
    let actions = bench.take_actions();
    assert!(actions.contains(&Action::Gate { session: "me-1".into(), until: 0 }), "{actions:?}");
}

#[test]
fn a_member_without_a_store_closes_its_gates_and_makes_none() {
    let mut bench = Bench::active(&["plc1"], &[]);
    bench.own("plc1");
    bench.feed(Input::StoreMissing);
    assert_eq!(bench.open_until(), 0);
    bench.wait(10 * L);
    assert_eq!(bench.requests, []);
}

/// Rule 5.
#[test]
fn a_session_goes_on_after_a_short_loss_and_ends_after_a_long_one() {
    let value = session("hall-1", |_| {});
    let entries = [("w.me-1", &*value, 101), ("l.plc1", "me-1", 103)];
    let mut bench = Bench::active(&["plc1"], &[]);
    bench.own("plc1");
    bench.feed(Input::Disconnected);
    bench.wait(L / 2);
    bench.reconnect(103, &entries);
    bench.create();
    assert!(bench.open_until() > 0);
    bench.pass(3 * L);
    assert!(!bench.actions.iter().any(|action| matches!(action, Action::Close { .. })));

    let mut bench = Bench::active(&["plc1"], &[]);
    let token = bench.own("plc1");
    bench.feed(Input::Disconnected);
    bench.take_actions();
    bench.pass(L);
    // Without a connection as well. Before, it kept its links until the next one, and told that they do not answer.
    assert_eq!(bench.take_actions().last(), Some(&Action::Close { link: "plc1".into(), token }));
    bench.wait(L);
    bench.reconnect(103, &entries);
    bench.feed(Input::Closed { link: "plc1".into(), token });
    bench.pass(L - 1);
    assert_eq!(bench.requests, [], "its links are those of another session");
    bench.pass(1);
    let (request, operation) = bench.put("w.me-1");
    assert_eq!(operation, put("w.me-1", DEAD, 101));
    bench.store(request);
    assert_eq!(bench.put("l.plc1").1, put("l.plc1", "me-2", 103));
}
