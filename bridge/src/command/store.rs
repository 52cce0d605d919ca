//! The file of the commands: ids with their results, and pulses that have not ended.
//!
//! A thread of its own writes it, since each commit waits for the disk. Changes that arrive meanwhile are
//! committed together. redb may panic on a damaged page: that counts as an error of the disk.
//!
//! | table | key | value |
//! |---|---|---|
//! | `commands` | PLC, id | [`Record`] as JSON |
//! | `pulses` | [`Place`] as JSON | [`PulseRecord`] as JSON |

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread::JoinHandle;

use redb::{Builder, Database, ReadableDatabase as _, ReadableTable as _, TableDefinition, TableError};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::sync::mpsc as tokio_mpsc;

use super::core::{Changes, Stored};
use super::journal::{Key, Record};
use super::pulse::{Place, PulseRecord};
use super::reply::Reply;
use crate::database;

const COMMANDS: TableDefinition<'_, (&str, &str), &[u8]> = TableDefinition::new("commands");
const PULSES: TableDefinition<'_, &[u8], &[u8]> = TableDefinition::new("pulses");

/// The memory of the database for pages, in bytes.
const CACHE: usize = 4 << 20;
/// The largest number of changes in one commit.
const MAX_GROUP: usize = 256;

/// The result of a change, with its token.
pub(super) type Result = (u64, std::result::Result<(), String>);

/// A file that cannot be used.
#[derive(Debug, thiserror::Error)]
#[error("{}: {reason}", path.display())]
pub struct StoreError {
    path: PathBuf,
    reason: String,
}

impl StoreError {
    pub(super) fn new(path: &Path, reason: impl ToString) -> Self {
        Self { path: path.to_owned(), reason: reason.to_string() }
    }
}

/// Where changes are stored.
#[derive(Debug)]
pub(super) enum Store {
    /// In a file, by a thread.
    File(FileStore),
    /// Nowhere.
    Memory(tokio_mpsc::UnboundedSender<Result>),
}

/// A file with its thread.
#[derive(Debug)]
pub(super) struct FileStore {
    changes: mpsc::Sender<(u64, Changes)>,
    results: tokio_mpsc::UnboundedSender<Result>,
    thread: JoinHandle<()>,
}

impl Store {
    /// Opens a file, or makes one, and reads it. Results of changes are sent to `results`.
    /// Blocks until the disk has answered.
    pub(super) fn open(
        path: &Path,
        results: tokio_mpsc::UnboundedSender<Result>,
    ) -> std::result::Result<(Self, Stored), StoreError> {
        let opened = guarded(|| {
            let database = open_or_create(path)?;
            let stored = read(&database)?;
            Ok((database, stored))
        });
        let (database, stored) = opened.map_err(|error| StoreError::new(path, error))?;
        let writer =
            Writer { path: path.to_owned(), opener: open_again, database: Some(database), results: results.clone() };
        let store = writer.start(results).map_err(|error| StoreError::new(path, error))?;
        Ok((store, stored))
    }

    /// Stores a change. Its result is sent when it is on disk.
    pub(super) fn put(&self, token: u64, changes: Changes) {
        let (results, result) = match self {
            Self::File(FileStore { changes: sender, results, .. }) => match sender.send((token, changes)) {
                Ok(()) => return,
                Err(_) => (results, Err("the thread of the disk has ended".to_owned())),
            },
            Self::Memory(results) => (results, Ok(())),
        };
        // The receiver is gone if the bridge is ending.
        let _ = results.send((token, result));
    }

    /// Waits until the file is closed. Blocks.
    pub(super) fn close(self) {
        match self {
            Self::File(FileStore { changes, thread, .. }) => {
                drop(changes);
                // A panic of the thread was reported by the panic hook.
                let _ = thread.join();
            }
            Self::Memory(_) => {}
        }
    }
}

/// The thread of a file.
struct Writer {
    path: PathBuf,
    /// Opens the database; tests put faults here.
    opener: fn(&Path) -> std::result::Result<Database, redb::Error>,
    /// `None` after a failure: the database must be opened anew.
    database: Option<Database>,
    results: tokio_mpsc::UnboundedSender<Result>,
}

impl Writer {
    fn start(self, results: tokio_mpsc::UnboundedSender<Result>) -> std::io::Result<Store> {
        let (sender, changes) = mpsc::channel();
        let thread = std::thread::Builder::new().name("commands".to_owned()).spawn(move || self.run(&changes))?;
        Ok(Store::File(FileStore { changes: sender, results, thread }))
    }

    fn run(mut self, changes: &mpsc::Receiver<(u64, Changes)>) {
        while let Ok(first) = changes.recv() {
            let mut group = vec![first];
            group.extend(changes.try_iter().take(MAX_GROUP - 1));
            let result = guarded(|| self.commit(&group));
            if result.is_err() {
                let database = self.database.take();
                // A damaged file may cause a panic here, too.
                let _ = catch_unwind(AssertUnwindSafe(|| drop(database)));
            }
            for (token, _) in group {
                // The receiver is gone if the bridge is ending.
                let _ = self.results.send((token, result.clone()));
            }
        }
    }

    fn commit(&mut self, group: &[(u64, Changes)]) -> std::result::Result<(), redb::Error> {
        let database = match self.database.take() {
            Some(database) => database,
            None => (self.opener)(&self.path)?,
        };
        let database = self.database.insert(database);
        let transaction = database.begin_write()?;
        {
            let mut commands = transaction.open_table(COMMANDS)?;
            let mut pulses = transaction.open_table(PULSES)?;
            for (_, change) in group {
                for key in &change.forget {
                    commands.remove((&*key.plc, &*key.id))?;
                }
                for (key, record) in &change.put {
                    commands.insert((&*key.plc, &*key.id), json(record).as_slice())?;
                }
                if let Some((place, record)) = &change.begin {
                    pulses.insert(json(place).as_slice(), json(record).as_slice())?;
                }
                if let Some(place) = &change.end {
                    pulses.remove(json(place).as_slice())?;
                }
            }
        }
        transaction.commit()?;
        Ok(())
    }
}

/// Runs work on the database. A panic in it is an error.
fn guarded<T>(work: impl FnOnce() -> std::result::Result<T, redb::Error>) -> std::result::Result<T, String> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(done) => done.map_err(|error| error.to_string()),
        // The panic hook has reported it.
        Err(_) => Err("the file is damaged".to_owned()),
    }
}

fn open_or_create(path: &Path) -> std::result::Result<Database, redb::Error> {
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder)?;
    }
    database::ensure(path, &builder())?;
    open_again(path)
}

/// Opens a file that has been open before. If it is gone, the ids in it are not known: that is an error.
fn open_again(path: &Path) -> std::result::Result<Database, redb::Error> {
    Ok(builder().open(path)?)
}

fn builder() -> Builder {
    let mut builder = Database::builder();
    builder.set_cache_size(CACHE);
    builder
}

fn read(database: &Database) -> std::result::Result<Stored, redb::Error> {
    let transaction = database.begin_read()?;
    let mut stored = Stored::default();
    match transaction.open_table(COMMANDS) {
        Ok(table) => {
            for row in table.iter()? {
                let (key, value) = row?;
                let (plc, id) = key.value();
                let key = Key { plc: plc.into(), id: id.into() };
                let record = parse(value.value()).unwrap_or_else(|| unreadable(&key));
                stored.commands.push((key, record));
            }
        }
        Err(TableError::TableDoesNotExist(_)) => {}
        Err(error) => return Err(error.into()),
    }
    match transaction.open_table(PULSES) {
        Ok(table) => {
            for row in table.iter()? {
                let (key, value) = row?;
                match parse::<Place>(key.value()).zip(parse::<PulseRecord>(value.value())) {
                    Some(pulse) => stored.pulses.push(pulse),
                    None => tracing::error!("a stored pulse is not readable: it cannot be ended"),
                }
            }
        }
        Err(TableError::TableDoesNotExist(_)) => {}
        Err(error) => return Err(error.into()),
    }
    Ok(stored)
}

/// The record of a command whose content cannot be read: its id must not be executed again.
fn unreadable(key: &Key) -> Record {
    let why = "storage: the result was stored in a form that cannot be read";
    Record { at: u64::MAX, digest: 0, reply: Some(Reply::unknown(Some(&key.id), why)) }
}

fn json(value: &impl Serialize) -> Vec<u8> {
    // Serializing texts and numbers to memory cannot fail.
    serde_json::to_vec(value).unwrap_or_default()
}

fn parse<T: DeserializeOwned>(text: &[u8]) -> Option<T> {
    serde_json::from_slice(text).ok()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::time::Duration;

    use tokio::time::timeout;

    use super::*;

    static OPENED: AtomicU32 = AtomicU32::new(0);

    /// Panics once, as redb can on a damaged page.
    fn damaged_once(path: &Path) -> std::result::Result<Database, redb::Error> {
        assert!(OPENED.fetch_add(1, Ordering::Relaxed) > 0, "a damaged page");
        open_or_create(path)
    }

    /// The next result, which comes much sooner.
    async fn next(results: &mut tokio_mpsc::UnboundedReceiver<Result>) -> Result {
        timeout(Duration::from_secs(60), results.recv()).await.expect("there is a result").expect("the thread lives")
    }

    /// Without the guard the thread ended, and no result came.
    #[tokio::test]
    async fn a_panic_of_the_database_is_an_error_and_the_next_change_opens_it_anew() {
        let folder = tempfile::tempdir().unwrap();
        let (sender, mut results) = tokio_mpsc::unbounded_channel();
        let path = folder.path().join("commands.redb");
        let writer = Writer { path, opener: damaged_once, database: None, results: sender.clone() };
        let store = writer.start(sender).unwrap();
        store.put(1, Changes::default());
        assert_eq!(next(&mut results).await, (1, Err("the file is damaged".to_owned())));
        store.put(2, Changes::default());
        assert_eq!(next(&mut results).await, (2, Ok(())));
        store.close();
    }

    /// With a file that is made anew, the ids of the run were not known after its end, and no command failed.
    #[tokio::test]
    async fn a_file_that_is_gone_is_not_made_anew() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("commands.redb");
        let (sender, mut results) = tokio_mpsc::unbounded_channel();
        drop(open_or_create(&path).unwrap());
        let writer = Writer { path: path.clone(), opener: open_again, database: None, results: sender.clone() };
        let store = writer.start(sender).unwrap();
        std::fs::remove_file(&path).unwrap();
        store.put(1, Changes::default());
        let (token, result) = next(&mut results).await;
        assert!(token == 1 && result.is_err_and(|why| why.contains("No such file")) && !path.exists());
        store.close();
    }

    #[tokio::test]
    async fn changes_fail_if_the_thread_has_ended() {
        let (results, mut receiver) = tokio_mpsc::unbounded_channel();
        let (changes, _) = mpsc::channel();
        let store = Store::File(FileStore { changes, results, thread: std::thread::spawn(|| ()) });
        store.put(1, Changes::default());
        assert!(receiver.recv().await.is_some_and(|(token, result)| token == 1 && result.is_err()));
    }
}
