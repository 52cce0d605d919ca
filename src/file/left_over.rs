//! Names and locks of new files, and removal of those left over by killed processes.
//!
//! Invariants:
//! - A process holds an exclusive lock on its new file from its creation until it is renamed or
//!   removed. The system releases the lock when the process ends, however it ends.
//! - A new file is removed by another process only while that process holds the lock.

use std::ffi::OsStr;
use std::fs::{self, File, TryLockError};
use std::path::Path;
use std::time::Duration;

use crc::{CRC_32_ISO_HDLC, Crc};

const CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Age from which a left-over file is removed. On Unix the lock is enough. Elsewhere a new file is
/// closed just before it is renamed, and has no lock in between.
const MIN_AGE: Duration = if cfg!(unix) { Duration::ZERO } else { Duration::from_secs(60) };

/// Name of the `n`th new file of this process for a target with this name.
///
/// The target's name is not a part of it: that may have the maximum length.
pub(super) fn name_of(target: &OsStr, n: u64) -> String {
    format!("{}{}-{n}.new", prefix(target), std::process::id())
}

fn prefix(target: &OsStr) -> String {
    format!(".fatek-{:08x}-", CRC.checksum(target.as_encoded_bytes()))
}

/// Returns whether a file has the name of a new file of the target: prefix, process and number.
fn is_new_file_of(prefix: &str, name: &OsStr) -> bool {
    let numbers = name.to_str().and_then(|name| name.strip_prefix(prefix)?.strip_suffix(".new"));
    let is_number = |text: &str| !text.is_empty() && text.bytes().all(|byte| byte.is_ascii_digit());
    numbers.and_then(|numbers| numbers.split_once('-')).is_some_and(|(process, n)| is_number(process) && is_number(n))
}

/// Locks a file that was just created. `false` if another process is removing it.
///
/// On a file system without locks it stays unlocked: no process can lock it to remove it.
pub(super) fn lock(file: &File) -> bool {
    match file.try_lock() {
        Ok(()) => is_linked(file),
        Err(TryLockError::WouldBlock) => false,
        Err(TryLockError::Error(_)) => true,
    }
}

/// Returns whether the file still has a name.
#[cfg(unix)]
fn is_linked(file: &File) -> bool {
    use std::os::unix::fs::MetadataExt;

    file.metadata().is_ok_and(|metadata| metadata.nlink() > 0)
}

/// Returns whether the file still has a name: it is too young to be removed.
#[cfg(not(unix))]
fn is_linked(_: &File) -> bool {
    true
}

/// Removes the new files of the target that were left over by processes that have ended.
///
/// Errors are ignored: the file can be saved without this.
pub(super) fn remove(target: &Path) {
    let Some(name) = target.file_name() else { return };
    let prefix = prefix(name);
    let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten().filter(|entry| is_new_file_of(&prefix, &entry.file_name())) {
        // Not of a symbolic link: `DirEntry` does not follow it.
        let Ok(metadata) = entry.metadata() else { continue };
        let is_old = metadata.modified().is_ok_and(|at| at.elapsed().unwrap_or_default() >= MIN_AGE);
        if !metadata.is_file() || !is_old {
            continue;
        }
        let Ok(file) = File::open(entry.path()) else { continue };
        if file.try_lock().is_ok() {
            let _ = fs::remove_file(entry.path());
        }
    }
}
