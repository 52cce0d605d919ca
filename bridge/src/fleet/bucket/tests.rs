//! Watches, with a real nats-server.

use super::super::plants::{self, PlantStore};
use super::*;
use crate::config::StoredPlant;

#[path = "../../../tests/common/nats.rs"]
#[allow(dead_code, unreachable_pub, reason = "it is shared with the integration tests")]
mod nats;

use nats::{NatsServer, PATIENCE};

/// The time in which a server sends what it was asked for.
const SENT: Duration = Duration::from_millis(500);

fn name(text: &str) -> Name {
    Name::parse(text).unwrap()
}

/// A server with an empty store.
async fn server(folder: &std::path::Path) -> Option<(NatsServer, NatsSection)> {
    let server = NatsServer::start(folder)?;
    let section: NatsSection = toml::from_str(&format!("url = 'nats://127.0.0.1:{}'", server.port())).unwrap();
    init(&section, &name("test"), &name("leases")).await.unwrap();
    Some((server, section))
}

async fn open_store(section: &NatsSection) -> Opened {
    open(section, &name("test"), &name("leases"), OPEN).await.unwrap()
}

async fn put(store: &Store, key: &str, expected: u64) -> u64 {
    let outcome = store.put(key, "value".to_owned(), expected).await;
    let Outcome::Stored(revision) = outcome else { panic!("{key}: {outcome:?}") };
    revision
}

async fn next(watch: &mut Watch) -> Result<Seen, String> {
    tokio::time::timeout(PATIENCE, watch.next()).await.expect("no entry comes")
}

fn key(seen: Seen) -> Option<String> {
    match seen {
        Seen::Entry(entry) => Some(entry.key),
        Seen::Complete => None,
    }
}

/// A member with 5000 links stopped reading for a moment. Seen with room for 256 entries: the client dropped some, and
/// the watch brought no more, until it was begun again after a lease.
#[tokio::test(flavor = "multi_thread")]
async fn a_watch_that_is_read_late_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let Some((_server, section)) = server(folder.path()).await else { return };
    let opened = open_store(&section).await;
    let store = opened.bucket.store();
    let keys = (0..1000).map(|n| format!("l.{n}"));
    let puts: FuturesUnordered<_> = keys
        .map(|key| {
            let store = store.clone();
            async move { put(&store, &key, 0).await }
        })
        .collect();
    assert_eq!(puts.count().await, 1000);

    let Opened { bucket: _connection, mut watch, .. } = open_store(&section).await;
    let mut entries = 0;
    while let Seen::Entry(_) = next(&mut watch).await.unwrap() {
        entries += 1;
        // Each time, one request is nearly read, and the next one is on its way.
        if entries % (BATCH / 2 + 20) == 0 {
            tokio::time::sleep(SENT).await;
        }
    }
    assert_eq!(entries, 1000);
}

/// nats-server 2.9 has skipped an entry under load: a free link stayed without a master. Here the consumer leaves out
/// another key. Without the lookup, the test waits for ever for the end of the watch.
#[tokio::test(flavor = "multi_thread")]
async fn a_watch_that_skips_an_entry_ends() {
    let folder = tempfile::tempdir().unwrap();
    let Some((_server, section)) = server(folder.path()).await else { return };
    let opened = open_store(&section).await;
    let store = opened.bucket.store();
    let (mut watch, _) = Watch::new(&store.stream, &format!("{}l.", store.prefix)).await.unwrap();
    assert_eq!(key(next(&mut watch).await.unwrap()), None);

    // It was removed before it was delivered: that is no gap.
    let removed = put(&store, "w.a", 0).await;
    let purge = Operation::Purge { key: "w.a".to_owned(), revision: removed };
    assert_eq!(store.clone().perform(purge).await, Outcome::Purged);
    put(&store, "l.1", 0).await;
    put(&store, "l.2", 0).await;
    assert_eq!(key(next(&mut watch).await.unwrap()).as_deref(), Some("1"));
    assert_eq!(key(next(&mut watch).await.unwrap()).as_deref(), Some("2"));

    let skipped = put(&store, "w.b", 0).await;
    put(&store, "l.3", 0).await;
    assert_eq!(key(next(&mut watch).await.unwrap()).as_deref(), Some("3"));
    assert_eq!(next(&mut watch).await.unwrap_err(), format!("the watch lacks revision {skipped}"));
}

/// The last entry that a watch skips is followed by no other, which would show the gap. Without the second way of
/// reading, a member stays with the former plant.
#[tokio::test(flavor = "multi_thread")]
async fn a_plant_that_the_watch_has_skipped_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let Some((_server, section)) = server(folder.path()).await else { return };
    let (id, bucket) = (name("test"), name("leases"));
    plants::init_plants(&section, &id, &bucket).await.unwrap();
    let mut writer = PlantStore::open(&section, &id, &bucket).await.unwrap();
    let mut reader = PlantStore::open(&section, &id, &bucket).await.unwrap();
    // A watch of another bucket: it brings nothing.
    let Opened { bucket: _connection, watch, .. } = open_store(&section).await;
    reader.set_watch(watch);
    let version = writer.put("[class]\n").await.unwrap();
    let read = async {
        while reader.current().is_none() {
            reader.changed().await.unwrap();
        }
    };
    tokio::time::timeout(PATIENCE, read).await.expect("the plant is not read");
    assert_eq!(reader.current(), Some(&StoredPlant { version: Some(version), text: "[class]\n".into() }));
}
