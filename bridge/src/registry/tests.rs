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
