//! The file of the commands: ids with their results, and pulses that have not ended.
//!
//! A thread of its own writes it, since each commit waits for the disk. Changes that arrive meanwhile are
//! committed together.
//!
//! | table | key | value |
//! |---|---|---|
//! | `commands` | PLC, id | [`Record`] as JSON |
//! | `pulses` | [`Place`] as JSON | [`PulseRecord`] as JSON |

use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread::JoinHandle;

use redb::{Database, ReadableDatabase as _, ReadableTable as _, TableDefinition, TableError};
use serde::Serialize;
use serde::de::DeserializeOwned;
use tokio::sync::mpsc as tokio_mpsc;

use super::core::{Changes, Stored};
use super::journal::{Key, Record};
use super::pulse::{Place, PulseRecord};
use super::reply::Reply;

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
    File { changes: mpsc::Sender<(u64, Changes)>, thread: JoinHandle<()> },
    /// Nowhere.
    Memory(tokio_mpsc::UnboundedSender<Result>),
}

impl Store {
    /// Opens a file, or makes one, and reads it. Results of changes are sent to `results`.
    /// Blocks until the disk has answered.
    pub(super) fn open(
        path: &Path,
        results: tokio_mpsc::UnboundedSender<Result>,
    ) -> std::result::Result<(Self, Stored), StoreError> {
        let database = open(path).map_err(|error| StoreError::new(path, error))?;
        let stored = read(&database).map_err(|error| StoreError::new(path, error))?;
        let (sender, changes) = mpsc::channel();
        let writer = Writer { path: path.to_owned(), database: Some(database), results };
        let thread = std::thread::Builder::new().name("commands".to_owned()).spawn(move || writer.run(&changes));
        let thread = thread.map_err(|error| StoreError::new(path, error))?;
        Ok((Self::File { changes: sender, thread }, stored))
    }

    /// Stores a change. Its result is sent when it is on disk.
    pub(super) fn put(&self, token: u64, changes: Changes) {
        let lost = match self {
            Self::File { changes: sender, .. } => sender.send((token, changes)).is_err(),
            Self::Memory(results) => results.send((token, Ok(()))).is_err(),
        };
        debug_assert!(!lost, "the thread runs as long as the sender is there");
    }

    /// Waits until the file is closed. Blocks.
    pub(super) fn close(self) {
        match self {
            Self::File { changes, thread } => {
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
    /// `None` after a failure: the database must be opened anew.
    database: Option<Database>,
    results: tokio_mpsc::UnboundedSender<Result>,
}

impl Writer {
    fn run(mut self, changes: &mpsc::Receiver<(u64, Changes)>) {
        while let Ok(first) = changes.recv() {
            let mut group = vec![first];
            group.extend(changes.try_iter().take(MAX_GROUP - 1));
            let result = self.commit(&group).map_err(|error| error.to_string());
            if result.is_err() {
                self.database = None;
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
            None => open(&self.path)?,
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

fn open(path: &Path) -> std::result::Result<Database, redb::Error> {
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        std::fs::create_dir_all(folder)?;
    }
    Ok(Database::builder().set_cache_size(CACHE).create(path)?)
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
