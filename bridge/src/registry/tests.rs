use fatek::Poller;

use super::*;

const BEFORE: &str = "\
[class]
fast = { every = '100ms' }
slow = { every = '10s' }
[plc.mixer]
link = 'tcp://127.0.0.1:9'
station = 1
tag.level = { at = 'R5:i16', class = 'fast' }
tag.alarm = { at = 'M7', class = 'fast' }
tag.name = { at = 'R10-R19:text', class = 'slow' }
[plc.boiler]
link = 'tcp://127.0.0.1:9'
station = 2
tag.level = 'R5:i16'
";

fn registry() -> (Registry, Pool, Poller) {
    let parts = (Registry::default(), Pool::new(), Poller::new());
    let changes = parts.0.apply(&Plant::from_toml(BEFORE).unwrap(), &parts.1, &parts.2.handle()).unwrap();
    assert_eq!((changes.plcs_added, changes.tags_added, changes.tags_kept), (2, 4, 0));
    parts
}

fn ids(registry: &Registry, plc: &str) -> Vec<TagId> {
    registry.read().get(plc).unwrap().ids.clone()
}

fn apply(parts: &(Registry, Pool, Poller), from: &str, to: &str) -> Result<Changes, AddError> {
    assert!(BEFORE.contains(from), "{from}");
    parts.0.apply(&Plant::from_toml(&BEFORE.replace(from, to)).unwrap(), &parts.1, &parts.2.handle())
}

#[tokio::test]
async fn a_changed_tag_gets_a_new_id_and_the_others_keep_theirs() {
    let parts = registry();
    let before = ids(&parts.0, "mixer");
    let changes = apply(&parts, "at = 'M7', class = 'fast'", "at = 'M7', class = 'slow'").unwrap();
    let after = ids(&parts.0, "mixer");
    assert_eq!((after[0], after[2]), (before[0], before[2]));
    assert_ne!(after[1], before[1]);
    assert_eq!((changes.tags_added, changes.tags_removed, changes.tags_kept), (1, 1, 3));
    assert_eq!((changes.plcs_added, changes.plcs_moved, changes.plcs_removed), (0, 0, 0));
    let plcs = parts.0.read();
    assert!(plcs.place(before[1]).is_none());
    assert_eq!(&*plcs.place(after[1]).unwrap().tag, "alarm");
    assert_eq!(plcs.places.len(), 4);
    assert_eq!(parts.2.handle().snapshot().len(), 4);
}

#[tokio::test]
async fn a_unit_changes_no_polling() {
    let parts = registry();
    let before = ids(&parts.0, "mixer");
    let changes = apply(&parts, "at = 'R5:i16', class", "at = 'R5:i16', unit = '%', class").unwrap();
    assert_eq!((changes.tags_added, changes.tags_kept), (0, 4));
    assert_eq!(ids(&parts.0, "mixer"), before);
    assert_eq!(parts.0.read().get("mixer").unwrap().plc.tag("level").unwrap().unit(), Some("%"));
}

#[tokio::test]
async fn plcs_are_added_moved_and_removed() {
    let parts = registry();
    let mixer = ids(&parts.0, "mixer");
    let changes = apply(&parts, "station = 2", "station = 3").unwrap();
    assert_eq!((changes.plcs_moved, changes.tags_added, changes.tags_removed, changes.tags_kept), (1, 1, 1, 3));
    let changes = apply(&parts, "[plc.boiler]", "[plc.kettle]").unwrap();
    assert_eq!((changes.plcs_added, changes.plcs_removed), (1, 1));
    assert_eq!((changes.tags_added, changes.tags_removed, changes.tags_kept), (1, 1, 3));
    let plcs = parts.0.read();
    assert!(plcs.get("boiler").is_none());
    assert_eq!(plcs.get("mixer").unwrap().ids, mixer);
    assert_eq!((plcs.places.len(), parts.2.handle().snapshot().len()), (4, 4));
}

/// Without `undo`, the poller had 5 tags after the failure.
#[tokio::test]
async fn a_plant_that_cannot_be_polled_changes_nothing() {
    let parts = registry();
    let before = (ids(&parts.0, "mixer"), ids(&parts.0, "boiler"));
    // The change of a tag is possible; a new PLC is not, because the pool is closed.
    parts.1.close().await;
    let plant = format!("{BEFORE}[plc.added]\nlink = 'tcp://127.0.0.1:9'\nstation = 7\ntag.x = 'R1'\n");
    let plant = Plant::from_toml(&plant.replace("at = 'M7'", "at = 'M8'")).unwrap();
    let error = parts.0.apply(&plant, &parts.1, &parts.2.handle()).unwrap_err();
    assert_eq!(error.to_string(), "plc added: the pool is closed");
    assert_eq!((ids(&parts.0, "mixer"), ids(&parts.0, "boiler")), before);
    assert_eq!(parts.2.handle().snapshot().len(), 4);
    assert_eq!(parts.0.read().places.len(), 4);
}

fn owned(plcs: &[(&str, u64)]) -> HashMap<Arc<str>, PlcOwnership> {
    let ownership = |revision| PlcOwnership { revision, gate: Gate::always_open() };
    plcs.iter().map(|(name, revision)| ((*name).into(), ownership(*revision))).collect()
}

fn revisions(registry: &Registry) -> Vec<(String, u64)> {
    registry.read().iter().map(|plc| (plc.plc.name().to_owned(), plc.revision)).collect()
}

#[tokio::test]
async fn a_member_polls_its_share_alone() {
    let (registry, pool, poller) = (Registry::default(), Pool::new(), Poller::new());
    let (plant, handle) = (Plant::from_toml(BEFORE).unwrap(), poller.handle());
    let none = HashMap::new();
    registry.apply_share(&plant, Share::Owned(&none), &pool, &handle).unwrap();
    assert_eq!((revisions(&registry), handle.snapshot().len()), (vec![], 0));
    assert_eq!(registry.read().elsewhere("mixer"), Some(Elsewhere::Member));
    assert_eq!(registry.read().elsewhere("kettle"), None, "the configuration does not have it");

    registry.take(&plant, &owned(&[("mixer", 7)]), &pool, &handle).unwrap();
    registry.take(&plant, &owned(&[("boiler", 9)]), &pool, &handle).unwrap();
    assert_eq!(revisions(&registry), [("boiler".to_owned(), 9), ("mixer".to_owned(), 7)]);
    let (first, boiler) = (ids(&registry, "mixer"), ids(&registry, "boiler"));
    assert_eq!(registry.read().place(first[0]).unwrap().revision, 7);
    assert_eq!((registry.read().elsewhere("mixer"), registry.read().places.len()), (None, 4));

    // A reload keeps the share, and with it the tags that are the same.
    let changed = Plant::from_toml(&BEFORE.replace("tag.alarm = { at = 'M7'", "tag.alarm = { at = 'M8'")).unwrap();
    let share = owned(&[("mixer", 7), ("boiler", 9)]);
    let changes = registry.apply_share(&changed, Share::Owned(&share), &pool, &handle).unwrap();
    assert_eq!((changes.tags_added, changes.tags_removed, changes.tags_kept), (1, 1, 3));
    assert_eq!((ids(&registry, "boiler"), ids(&registry, "mixer")[0]), (boiler.clone(), first[0]));

    let mixer: Arc<str> = "mixer".into();
    registry.give_up([(&mixer, Elsewhere::Lost)]);
    assert_eq!((registry.read().elsewhere("mixer"), registry.read().lost().count()), (Some(Elsewhere::Lost), 1));
    assert_eq!((registry.read().places.len(), handle.snapshot().len()), (1, 1));
    registry.settle(|plc| plc == "mixer");
    assert_eq!(registry.read().elsewhere("mixer"), Some(Elsewhere::Member));

    // The next ownership has other tags in the poller: samples of the one before have no place.
    registry.take(&plant, &owned(&[("mixer", 12)]), &pool, &handle).unwrap();
    assert!(ids(&registry, "mixer").iter().all(|id| !first.contains(id)));
    assert_eq!((registry.read().elsewhere("mixer"), ids(&registry, "boiler")), (None, boiler));

    // A reload with another token in between does the same.
    let before = ids(&registry, "mixer");
    let share = owned(&[("mixer", 15), ("boiler", 9)]);
    let changes = registry.apply_share(&plant, Share::Owned(&share), &pool, &handle).unwrap();
    assert_eq!((changes.plcs_moved, changes.tags_added, changes.tags_kept), (1, 3, 1));
    assert!(ids(&registry, "mixer").iter().all(|id| !before.contains(id)));
    let gone = Plant::from_toml(&BEFORE.replace("[plc.mixer]", "[plc.kettle]")).unwrap();
    registry.apply_share(&gone, Share::Owned(&owned(&[("boiler", 9)])), &pool, &handle).unwrap();
    let plcs = registry.read();
    assert_eq!((plcs.elsewhere("mixer"), plcs.elsewhere("kettle")), (None, Some(Elsewhere::Member)));
    assert_eq!((plcs.places.len(), handle.snapshot().len()), (1, 1));
}

#[tokio::test]
async fn a_batch_of_an_earlier_ownership_is_history() {
    let (registry, pool, poller) = (Registry::default(), Pool::new(), Poller::new());
    let (plant, handle) = (Plant::from_toml(BEFORE).unwrap(), poller.handle());
    registry.apply_share(&plant, Share::Owned(&owned(&[("mixer", 7), ("boiler", 0)])), &pool, &handle).unwrap();
    let batch = |plc: &str, revision| Batch { plc: plc.into(), revision, seq: 1, ts: 1, samples: 1, data: "{}".into() };
    assert!(!registry.is_former(&batch("mixer", 7)) && registry.is_former(&batch("mixer", 5)));
    assert!(!registry.is_former(&batch("boiler", 0)), "a pinned link has no token");
    let mixer: Arc<str> = "mixer".into();
    registry.give_up([(&mixer, Elsewhere::Member)]);
    assert!(registry.is_former(&batch("mixer", 7)), "another member may have newer values");
}

/// Without it, a reload that was still in its thread polled again what the bridge had given away.
#[tokio::test]
async fn a_bridge_that_gives_its_plcs_away_takes_no_other_configuration() {
    let parts = registry();
    parts.0.freeze();
    let error = apply(&parts, "[plc.boiler]", "[plc.kettle]").unwrap_err();
    assert_eq!(error.to_string(), "plc any: the bridge is stopping");
    assert!(parts.0.read().get("boiler").is_some() && parts.0.read().get("kettle").is_none());
}
