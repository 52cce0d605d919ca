//! Links: taken, given away, moved by hand, and pinned.

use super::*;

#[test]
fn a_missing_entry_must_be_seen_missing_for_a_lease() {
    let mut bench = Bench::active(&["plc1"], &[]);
    bench.pass(L - 1);
    assert_eq!(bench.requests, []);
    bench.pass(1);
    assert_eq!(bench.put("l.plc1").1, put("l.plc1", "me-1", 0));
}

#[test]
fn an_owner_without_a_session_must_be_missing_for_a_lease() {
    let mut bench = Bench::active(&["plc1"], &[]);
    bench.pass(L / 2);
    bench.see("l.plc1", "x");
    bench.pass(L - 1);
    assert_eq!(bench.requests, []);
    bench.pass(1);
    bench.put("l.plc1");
}

/// Rule 5.
#[test]
fn an_entry_of_a_young_view_counts_after_a_lease_and_news_at_once() {
    for owner in ["", "dead-one"] {
        let mut bench = Bench::active(&["plc1"], &[("w.dead-one", DEAD), ("l.plc1", owner)]);
        bench.pass(L - 1);
        assert_eq!(bench.requests, [], "{owner:?}");
        bench.pass(1);
        bench.put("l.plc1");
    }
    let mut bench = Bench::active(&["plc1"], &[("w.dead-one", DEAD), ("l.plc1", "dead-one")]);
    bench.own("plc1");
}

#[test]
fn a_link_is_closed_before_it_is_released() {
    let link = links_of("hall-2", 1).remove(0);
    let mut bench = Bench::active(&[&link], &[]);
    let token = bench.own(&link);
    bench.see("w.x", &other());
    assert_eq!(bench.take_actions(), [Action::Close { link: link.as_str().into(), token }]);
    assert_eq!(bench.requests, [], "not before it is closed");
    bench.feed(Input::Closed { link: link.as_str().into(), token });
    let (request, operation) = bench.requests.remove(0);
    assert_eq!(operation, put(&format!("l.{link}"), "", token.revision));
    bench.store(request);
    bench.pass(L / 2);
    assert_eq!(bench.requests, [], "left to its target");
}

#[test]
fn a_link_is_kept_while_its_target_is_silent() {
    let link = links_of("hall-2", 1).remove(0);
    let mut bench = Bench::active(&[&link], &[("w.x", &other()), ("d.hall-2", DRAIN)]);
    bench.own(&link);
    bench.pass(L - 1);
    bench.take_actions();
    bench.see("d.hall-2", "");
    assert_eq!(bench.take_actions(), []);
    bench.see("w.x", &other());
    bench.pass(L / 4);
    assert!(bench.actions.iter().any(|action| matches!(action, Action::Close { .. })));
}

#[test]
fn a_release_without_a_result_is_sent_again_until_the_watch_tells() {
    let link = links_of("hall-2", 1).remove(0);
    let key = format!("l.{link}");
    let mut bench = Bench::active(&[&link], &[]);
    let token = bench.own(&link);
    bench.see("w.x", &other());
    bench.feed(Input::Closed { link: link.as_str().into(), token });
    let (request, _) = bench.put(&key);
    bench.reply(request, Outcome::Unknown);
    bench.pass(L / 12);
    let (request, _) = bench.put(&key);
    bench.see(&key, "");
    bench.reply(request, Outcome::WrongRevision);
    bench.see("w.x", &other());
    bench.pass(L / 2);
    assert_eq!(bench.requests, []);
}

#[test]
fn a_take_without_a_result_is_adopted_from_the_watch() {
    let mut bench = Bench::active(&["plc1"], &[]);
    bench.see("l.plc1", "");
    let (request, _) = bench.put("l.plc1");
    bench.reply(request, Outcome::Unknown);
    bench.take_actions();
    let revision = bench.see("l.plc1", "me-1");
    let token = LinkToken { store: 7, revision };
    let owns = Action::Own { link: "plc1".into(), token, session: Some("me-1".into()) };
    assert_eq!(bench.take_actions(), [owns]);
}

#[test]
fn a_take_that_the_watch_has_overtaken_is_not_owned() {
    let link = links_of("hall-1", 1).remove(0);
    let key = format!("l.{link}");
    let mut bench = Bench::active(&[&link], &[("w.x", &other())]);
    bench.see(&key, "");
    let (request, _) = bench.put(&key);
    bench.take_actions();
    bench.revision += 1;
    bench.see(&key, "x");
    bench.reply(request, Outcome::Stored(bench.revision - 1));
    assert_eq!(bench.take_actions(), []);
}

#[test]
fn a_link_is_moved_by_hand_to_a_member_that_reaches_it() {
    let link = links_of("hall-1", 1).remove(0);
    let key = format!("o.{link}");
    let mut bench = Bench::active(&[&link], &[("w.x", &other())]);
    bench.own(&link);
    bench.see(&key, "hall-3");
    assert_eq!(bench.take_actions(), [], "a member that does not live");
    bench.see(&key, "hall-2");
    assert!(matches!(bench.take_actions()[..], [Action::Close { .. }]));

    let only = Reach::Only(vec!["hall-1".into()]);
    let mut bench = Bench::with(vec![LinkSpec { id: link.as_str().into(), reach: only }]);
    bench.connect(&[("w.x", &other())]);
    bench.create();
    bench.own(&link);
    bench.see(&key, "hall-2");
    assert_eq!(bench.take_actions(), [], "a member that does not reach it");
}

#[test]
fn a_pinned_link_needs_no_store() {
    let pinned = |member: &str| Reach::Pinned(member.into());
    let links = vec![
        LinkSpec { id: "line1".into(), reach: pinned("hall-1") },
        LinkSpec { id: "line2".into(), reach: pinned("hall-2") },
    ];
    let mut bench = Bench::with(links);
    let owns = Action::Own { link: "line1".into(), token: LinkToken::PINNED, session: None };
    assert_eq!(bench.take_actions(), [owns]);
    bench.connect(&[]);
    bench.create();
    bench.pass(3 * L);
    assert_eq!(bench.requests, [], "neither is leased");
    bench.feed(Input::Configure { member: member(), links: Vec::new() });
    let close = Action::Close { link: "line1".into(), token: LinkToken::PINNED };
    assert_eq!(bench.take_actions().last(), Some(&close));
}

#[test]
fn requests_for_links_are_bounded() {
    let links: Vec<String> = (0..20).map(|n| format!("plc{n}")).collect();
    let links: Vec<&str> = links.iter().map(String::as_str).collect();
    let mut bench = Bench::active(&links, &[]);
    bench.pass(L);
    let mut owned = 0;
    while !bench.requests.is_empty() {
        assert!(bench.requests.len() <= 4);
        let (request, _) = bench.put("l.");
        bench.store(request);
        owned += 1;
    }
    assert_eq!(owned, 20);
}

#[test]
fn links_are_handed_over_in_batches() {
    let links = links_of("hall-2", 200);
    let links: Vec<&str> = links.iter().map(String::as_str).collect();
    let mut bench = Bench::active(&links, &[]);
    bench.pass(L);
    while !bench.requests.is_empty() {
        let (request, _) = bench.put("l.");
        bench.store(request);
    }
    bench.take_actions();
    bench.see("w.x", &other());
    let mut closing: VecDeque<_> = bench.take_actions().into();
    let mut moved = 0;
    while let Some(action) = closing.pop_front() {
        assert!(closing.len() <= MAX_HANDED);
        let Action::Close { link, token } = action else { continue };
        bench.feed(Input::Closed { link: link.clone(), token });
        let (request, _) = bench.put("l.");
        bench.store(request);
        bench.see(&format!("l.{link}"), "x");
        closing.extend(bench.take_actions());
        moved += 1;
    }
    assert_eq!(moved, 200);
}

#[test]
fn a_new_configuration_adds_and_removes_links() {
    let mut bench = Bench::active(&["plc1"], &[]);
    let token = bench.own("plc1");
    bench.pass(2 * L);
    let new = vec![LinkSpec { id: "plc2".into(), reach: Reach::All }];
    bench.feed(Input::Configure { member: member(), links: new });
    bench.put("l.plc2");
    let close = Action::Close { link: "plc1".into(), token };
    assert_eq!(bench.take_actions().last(), Some(&close));
    bench.feed(Input::Closed { link: "plc1".into(), token });
    assert_eq!(bench.put("l.plc1").1, put("l.plc1", "", token.revision));
}
