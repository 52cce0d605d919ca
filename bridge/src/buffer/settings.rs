//! The settings of the buffer, and errors at its start.

use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use super::chunk;
use super::jobs::DiskLimits;
use crate::config::BufferSection;

/// Settings of a [`Buffer`](super::Buffer).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BufferSettings {
    /// The folder of the file; without it the buffer is in memory alone.
    pub dir: Option<PathBuf>,
    /// The largest size on disk, in bytes; 1 MiB at least.
    pub max: u64,
    /// The largest age of a batch.
    pub max_age: Duration,
    /// The largest size in memory, in bytes; with a folder 256 KiB at least.
    pub memory: usize,
    /// `true`: each batch is on disk before it is delivered.
    pub sync: bool,
}

/// A buffer that cannot be opened.
#[derive(Debug, thiserror::Error)]
pub enum BufferError {
    /// Another process has it open.
    #[error("buffer {}: another process uses it; each bridge needs its own `buffer.dir`", path.display())]
    InUse {
        /// The file.
        path: PathBuf,
    },
    /// The folder or the file cannot be used.
    #[error("buffer {}: {why}", path.display())]
    Io {
        /// The folder or the file.
        path: PathBuf,
        /// The error of the system.
        why: String,
    },
    /// A limit is too small.
    #[error("buffer.{key} is {bytes} bytes: it is at least {least} bytes")]
    Limit {
        /// The key of the configuration.
        key: &'static str,
        /// Its value.
        bytes: u64,
        /// The least value.
        least: u64,
    },
}

const LEAST_MAX: u64 = 1 << 20;
const LEAST_MEMORY: usize = 256 << 10;
/// The lengths of chunks: the least and the largest.
const CHUNK: (u32, u32) = (16 << 10, 256 << 10);
/// The chunks of a full file, if the length of a chunk allows it.
const CHUNKS: u64 = 65_536;
/// The largest commit in bytes.
const LARGEST_JOB: usize = 4 << 20;
/// The largest memory of redb in bytes.
const LARGEST_CACHE: usize = 16 << 20;

impl BufferSettings {
    /// The settings of a configuration.
    #[must_use]
    pub fn of(section: &BufferSection) -> Self {
        Self {
            dir: section.dir.clone(),
            max: section.max.0,
            max_age: section.max_age.0,
            memory: usize::try_from(section.memory.0).unwrap_or(usize::MAX),
            sync: section.sync,
        }
    }

    /// Checks the limits.
    ///
    /// # Errors
    /// [`BufferError::Limit`] if one is too small.
    pub fn check(&self) -> Result<(), BufferError> {
        let memory = u64::try_from(self.memory).unwrap_or(u64::MAX);
        let least_memory = u64::try_from(LEAST_MEMORY).unwrap_or(u64::MAX);
        if self.dir.is_some() && self.memory < LEAST_MEMORY {
            return Err(BufferError::Limit { key: "memory", bytes: memory, least: least_memory });
        }
        if self.dir.is_some() && self.max < LEAST_MAX {
            return Err(BufferError::Limit { key: "max", bytes: self.max, least: LEAST_MAX });
        }
        Ok(())
    }

    /// The largest age in milliseconds.
    pub(super) fn max_age_ms(&self) -> u64 {
        u64::try_from(self.max_age.as_millis()).unwrap_or(u64::MAX)
    }

    /// The bytes of batches in memory, if there is a disk: the other half is for what is written, what is
    /// read back, and redb.
    pub(super) fn slots(&self) -> usize {
        self.memory / 2
    }

    /// The memory of redb.
    pub(super) fn cache(&self) -> usize {
        (self.memory / 8).min(LARGEST_CACHE)
    }

    pub(super) fn disk_limits(&self, outputs: usize) -> DiskLimits {
        let chunk = u32::try_from((self.max / CHUNKS).next_power_of_two()).unwrap_or(u32::MAX);
        let sixteenth = self.max / 16;
        let job = usize::try_from(sixteenth).unwrap_or(usize::MAX).min(self.memory / 8).min(LARGEST_JOB);
        DiskLimits {
            // The rest is for the pages above the chunks, and for those that are not free yet.
            max: self.max.saturating_sub(sixteenth).saturating_sub(chunk::cost(CHUNK.0)),
            chunk: chunk.clamp(CHUNK.0, CHUNK.1),
            job,
            read_ahead: self.memory / 8 / outputs.max(1),
            sync: self.sync,
        }
    }
}

impl BufferError {
    pub(super) fn io(path: &Path, error: &io::Error) -> Self {
        Self::Io { path: path.to_owned(), why: error.to_string() }
    }
}
