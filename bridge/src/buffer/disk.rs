//! The file of the buffer: a redb database. Blocks.
//!
//! | table | key | value |
//! |---|---|---|
//! | `chunks` | position of the first batch | records, see [`super::record`] |
//! | `index` | the same | count, length, times of the first and the last batch |
//! | `cursors` | output | the position before which all is acknowledged |
//! | `seqs` | PLC | the sequence number behind its last batch |
//! | `state` | name | a number |
//!
//! redb verifies all checksums when it opens the file here, but not when it reads a page later; a damaged page
//! may cause a panic in it. So panics are caught and count as a damaged file.

use std::collections::HashMap;
use std::fmt;
use std::fs;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use bytes::Bytes;
use redb::{Builder, Database, DatabaseError, ReadableDatabase, ReadableTable, TableDefinition};

use super::chunk::Chunk;
use super::jobs::{Commit, Load, NewChunk};
use super::log::Slot;
use super::record::{self, Decoder};
use crate::database;

const CHUNKS: TableDefinition<'_, u64, &[u8]> = TableDefinition::new("chunks");
const INDEX: TableDefinition<'_, u64, (u32, u32, u64, u64)> = TableDefinition::new("index");
const CURSORS: TableDefinition<'_, &str, u64> = TableDefinition::new("cursors");
const SEQS: TableDefinition<'_, &str, u64> = TableDefinition::new("seqs");
const STATE: TableDefinition<'_, &str, u64> = TableDefinition::new("state");

/// The version of the tables.
const VERSION: u64 = 1;
/// The name of the file.
pub(super) const FILE: &str = "buffer.redb";
/// The damaged files that are kept.
const MAX_DAMAGED: usize = 3;

/// Opens a database; tests put faults in between.
pub(super) type Opener = Arc<dyn Fn(&Builder, &Path) -> Result<Database, DatabaseError> + Send + Sync>;

/// The file, open or not.
pub(super) struct Disk {
    path: PathBuf,
    cache: usize,
    opener: Opener,
    db: Option<Database>,
    decoder: Decoder,
    /// Creates chunks without allocations.
    encoded: Vec<u8>,
}

/// Why the file cannot be used.
#[derive(Debug, thiserror::Error)]
pub(super) enum DiskError {
    /// Another process has it.
    #[error("another process uses it")]
    InUse,
    /// An error of the system. The file may be good.
    #[error("{0}")]
    Io(String),
    /// Its content is damaged.
    #[error("{0}")]
    Damaged(String),
}

/// The content of the file at the start.
#[derive(Debug, Default)]
pub(super) struct Restored {
    pub(super) chunks: Vec<Chunk>,
    pub(super) cursors: HashMap<String, u64>,
    pub(super) next_seqs: HashMap<Arc<str>, u64>,
    /// The end of the log.
    pub(super) end: u64,
    /// The buffer's time of the last commit.
    pub(super) time: u64,
    /// The clock at the last commit, in milliseconds since 1970.
    pub(super) clock: u64,
}

impl fmt::Debug for Disk {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Disk").field("path", &self.path).field("is_open", &self.db.is_some()).finish_non_exhaustive()
    }
}

impl Disk {
    /// A file that is not open yet. `cache`: the memory of redb in bytes.
    pub(super) fn new(path: PathBuf, cache: usize, opener: Opener) -> Self {
        Self { path, cache, opener, db: None, decoder: Decoder::default(), encoded: Vec::new() }
    }

    /// The opener of the program.
    pub(super) fn opener() -> Opener {
        Arc::new(|builder, path| builder.create(path))
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Opens the file, verifies all of it, and reads what is needed to go on. `None`: it is new.
    pub(super) fn open(&mut self) -> Result<Option<Restored>, DiskError> {
        self.db = None;
        let mut builder = Builder::new();
        builder.set_cache_size(self.cache).set_check_integrity_on_open(true);
        let (opener, path) = (self.opener.clone(), self.path.clone());
        let (db, restored) = guarded(move || {
            database::ensure(&path, &builder)?;
            let db = opener(&builder, &path)?;
            let restored = restore(&db)?;
            Ok((db, restored))
        })?;
        self.db = Some(db);
        match restored {
            Content::New => Ok(None),
            Content::Log(restored) => Ok(Some(restored)),
            Content::Invalid(why) => {
                self.close();
                Err(DiskError::Damaged(why))
            }
        }
    }

    /// Writes a commit and returns the length of the file. `clock`: milliseconds since 1970.
    pub(super) fn commit(&mut self, commit: &Commit, clock: u64) -> Result<u64, DiskError> {
        self.ensure_open()?;
        let encoded = &mut self.encoded;
        let db = self.db.as_ref().ok_or_else(closed)?;
        guarded(|| write(db, commit, clock, encoded))?;
        Ok(fs::metadata(&self.path).map_or(0, |metadata| metadata.len()))
    }

    /// Reads chunks back: for each of them the batches up to the first that is not good.
    pub(super) fn load(&mut self, load: &Load) -> Result<Vec<Vec<Slot>>, DiskError> {
        self.ensure_open()?;
        let decoder = &mut self.decoder;
        let db = self.db.as_ref().ok_or_else(closed)?;
        guarded(|| {
            let table = db.begin_read()?.open_table(CHUNKS)?;
            let mut read = Vec::with_capacity(load.chunks.len());
            for chunk in &load.chunks {
                let row = table.get(chunk.first)?.map(|row| Bytes::copy_from_slice(row.value()));
                read.push(row.map_or_else(Vec::new, |row| decoder.decode(&row)));
            }
            Ok(read)
        })
    }

    /// Makes the file smaller, and returns its length.
    pub(super) fn compact(&mut self) -> Result<u64, DiskError> {
        self.ensure_open()?;
        let db = self.db.as_mut().ok_or_else(closed)?;
        guarded(|| db.compact().map_err(redb::Error::from))?;
        Ok(fs::metadata(&self.path).map_or(0, |metadata| metadata.len()))
    }

    /// Closes the file. The next job opens it.
    pub(super) fn close(&mut self) {
        let db = self.db.take();
        // A damaged file may cause a panic here, too.
        let _ = catch_unwind(AssertUnwindSafe(|| drop(db)));
    }

    /// Moves a damaged file aside, and returns where it is now. At most three are kept.
    pub(super) fn move_aside(&mut self) -> Result<PathBuf, io::Error> {
        self.close();
        let place = |number: usize| self.path.with_extension(format!("damaged-{number}"));
        for number in (1..MAX_DAMAGED).rev() {
            match fs::rename(place(number), place(number.saturating_add(1))) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        fs::rename(&self.path, place(1))?;
        Ok(place(1))
    }

    fn ensure_open(&mut self) -> Result<(), DiskError> {
        if self.db.is_none() {
            // The log knows what is in it.
            self.open()?;
        }
        Ok(())
    }
}

fn closed() -> DiskError {
    DiskError::Io("the file is closed".to_owned())
}

/// Runs work on the database; a panic is a damaged file.
fn guarded<T>(work: impl FnOnce() -> Result<T, redb::Error>) -> Result<T, DiskError> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(done)) => Ok(done),
        Ok(Err(error)) => Err(classify(error)),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(|text| (*text).to_owned()));
            Err(DiskError::Damaged(text.unwrap_or_else(|| "panic".to_owned())))
        }
    }
}

fn classify(error: redb::Error) -> DiskError {
    use redb::Error::{Backend, DatabaseAlreadyOpen, DatabaseClosed, Io, LockProtocolMismatch, PreviousIo};
    if matches!(error, DatabaseAlreadyOpen | LockProtocolMismatch) {
        return DiskError::InUse;
    }
    if let Io(error) = &error {
        // redb tells so of a file that is no database, or too short.
        let is_damaged = matches!(error.kind(), io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof);
        let text = error.to_string();
        return if is_damaged { DiskError::Damaged(text) } else { DiskError::Io(text) };
    }
    if matches!(error, PreviousIo | DatabaseClosed | Backend(_)) {
        return DiskError::Io(error.to_string());
    }
    DiskError::Damaged(error.to_string())
}

/// The content of a file.
enum Content {
    New,
    Log(Restored),
    Invalid(String),
}

fn restore(db: &Database) -> Result<Content, redb::Error> {
    let transaction = db.begin_read()?;
    let state = match transaction.open_table(STATE) {
        Ok(state) => state,
        Err(redb::TableError::TableDoesNotExist(_)) => return Ok(Content::New),
        Err(error) => return Err(error.into()),
    };
    let number = |name: &str| Ok::<u64, redb::Error>(state.get(name)?.map_or(0, |row| row.value()));
    let version = number("version")?;
    if version != VERSION {
        return Ok(Content::Invalid(format!("its version is {version}, and not {VERSION}")));
    }
    let mut restored =
        Restored { end: number("end")?, time: number("time")?, clock: number("clock")?, ..Restored::default() };
    for row in transaction.open_table(INDEX)?.iter()? {
        let (first, row) = row?;
        let (count, len, oldest, newest) = row.value();
        let chunk = Chunk { first: first.value(), count, len, oldest, newest };
        let is_behind = restored.chunks.last().is_none_or(|last| last.end() <= chunk.first);
        if count == 0 || !is_behind {
            return Ok(Content::Invalid(format!("its chunk at {} overlaps another", chunk.first)));
        }
        restored.chunks.push(chunk);
    }
    for row in transaction.open_table(CURSORS)?.iter()? {
        let (name, acknowledged) = row?;
        restored.cursors.insert(name.value().to_owned(), acknowledged.value());
    }
    for row in transaction.open_table(SEQS)?.iter()? {
        let (plc, seq) = row?;
        restored.next_seqs.insert(plc.value().into(), seq.value());
    }
    Ok(Content::Log(restored))
}

fn write(db: &Database, commit: &Commit, clock: u64, encoded: &mut Vec<u8>) -> Result<(), redb::Error> {
    let transaction = db.begin_write()?;
    {
        let mut chunks = transaction.open_table(CHUNKS)?;
        let mut index = transaction.open_table(INDEX)?;
        chunks.retain_in(..commit.remove_before, |_, _| false)?;
        index.retain_in(..commit.remove_before, |_, _| false)?;
        chunks.retain_in(commit.remove_from.., |_, _| false)?;
        index.retain_in(commit.remove_from.., |_, _| false)?;
        for new in &commit.chunks {
            encode(new, &chunks, encoded)?;
            let Chunk { first, count, len, oldest, newest } = new.chunk;
            chunks.insert(first, encoded.as_slice())?;
            index.insert(first, (count, len, oldest, newest))?;
        }
        let mut cursors = transaction.open_table(CURSORS)?;
        cursors.retain(|name, _| commit.cursors.iter().any(|(known, _)| **known == *name))?;
        for (name, acknowledged) in &commit.cursors {
            cursors.insert(&**name, acknowledged)?;
        }
        let mut seqs = transaction.open_table(SEQS)?;
        if let Some(next_seqs) = &commit.next_seqs {
            seqs.retain(|_, _| false)?;
            for (plc, seq) in next_seqs {
                seqs.insert(&**plc, seq)?;
            }
        }
        let mut state = transaction.open_table(STATE)?;
        let numbers = [("version", VERSION), ("end", commit.end), ("time", commit.time), ("clock", clock)];
        for (name, number) in numbers {
            state.insert(name, number)?;
        }
    }
    transaction.commit()?;
    Ok(())
}

/// Encodes a chunk. The bytes that it keeps are read from the file.
fn encode(
    new: &NewChunk,
    chunks: &impl ReadableTable<u64, &'static [u8]>,
    encoded: &mut Vec<u8>,
) -> Result<(), redb::Error> {
    encoded.clear();
    if new.keep > 0 {
        let kept = usize::try_from(new.keep).unwrap_or(usize::MAX);
        if let Some(row) = chunks.get(new.chunk.first)? {
            encoded.extend(row.value().iter().take(kept));
        }
        // Bytes that are missing are noticed when they are read back.
        encoded.resize(kept, 0);
    }
    new.slots.iter().for_each(|slot| record::encode(slot, encoded));
    Ok(())
}
