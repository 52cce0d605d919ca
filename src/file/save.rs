use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf, is_separator};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::left_over::{self, lock, name_of};
use super::{FileError, FormatError};

/// The largest file that is read; those of this library are smaller.
const MAX_LEN: u64 = 16 * 1024 * 1024;

/// Replaces the content of a file, or makes the file.
///
/// The bytes are written to a new file in the same folder, which is renamed when all of them are on
/// the disk. So the file has the old or the new content at any time, and never a part. The file
/// keeps its permissions; a symbolic link to it stays.
///
/// # Errors
/// [`FileError`]; the file has its old content then.
pub fn save(path: impl AsRef<Path>, content: &[u8]) -> Result<(), FileError> {
    save_with(path.as_ref(), |file| file.write_all(content))
}

/// Reads the bytes of a regular file.
pub(crate) fn load(path: &Path) -> Result<Vec<u8>, FileError> {
    let failed = failed(path, "read it");
    // Checked before it is opened: that blocks for a pipe without a writer, and devices react to it.
    if !fs::metadata(path).map_err(&failed)?.is_file() {
        return Err(FileError::NotAFile { path: path.to_owned() });
    }
    let file = File::open(path).map_err(&failed)?;
    let mut content = Vec::new();
    file.take(MAX_LEN.saturating_add(1)).read_to_end(&mut content).map_err(&failed)?;
    if u64::try_from(content.len()).is_ok_and(|len| len <= MAX_LEN) {
        Ok(content)
    } else {
        Err(FileError::TooLarge { path: path.to_owned(), limit: MAX_LEN })
    }
}

/// Reads a file and parses its content.
pub(crate) fn load_as<T>(path: &Path, parse: impl FnOnce(&[u8]) -> Result<T, FormatError>) -> Result<T, FileError> {
    parse(&load(path)?).map_err(|source| FileError::Format { path: path.to_owned(), source })
}

/// Checks whether a file can be saved there: nothing but a file has this name, and a new file can be
/// made beside it. Call this before a long transfer.
///
/// The file and its folder stay as they are.
///
/// # Errors
/// [`FileError`], as saving would return.
pub fn can_save(path: impl AsRef<Path>) -> Result<(), FileError> {
    NewFile::create(path.as_ref()).map(drop)
}

fn save_with(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> Result<(), FileError> {
    let NewFile { target, old, mut temporary, mut file } = NewFile::create(path)?;
    // Before the first byte is written: they may fill the disk.
    left_over::remove(&target);
    // Before the first byte: a secret of the old file must not be readable in the new one.
    let permitted = old.map_or(Ok(()), |old| file.set_permissions(old.permissions()));
    let written = permitted.and_then(|()| write(&mut file)).and_then(|()| file.sync_all());
    // Closed later on Unix: until it is renamed, the lock keeps other processes from removing it.
    let locked = cfg!(unix).then_some(file);
    written.map_err(failed(path, "write it"))?;
    fs::rename(&temporary.path, &target).map_err(failed(path, "replace it"))?;
    drop(locked);
    temporary.renamed = true;
    sync_folder(&target);
    Ok(())
}

/// A new file that has still to replace another one, if there is one.
struct NewFile {
    /// The file to replace; of a symbolic link, the file that it points to.
    target: PathBuf,
    old: Option<Metadata>,
    temporary: Temporary,
    file: File,
}

impl NewFile {
    fn create(path: &Path) -> Result<Self, FileError> {
        let (target, old) = match fs::metadata(path) {
            Ok(old) if old.is_file() => (fs::canonicalize(path).map_err(failed(path, "find it"))?, Some(old)),
            Ok(_) => return Err(FileError::NotAFile { path: path.to_owned() }),
            // A broken link cannot be followed, and must not be replaced.
            Err(_) if path.is_symlink() => return Err(FileError::NotAFile { path: path.to_owned() }),
            // Only a folder can have such a name.
            Err(_) if path.as_os_str().as_encoded_bytes().last().is_some_and(|&last| is_separator(last.into())) => {
                return Err(FileError::NotAFile { path: path.to_owned() });
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => (path.to_owned(), None),
            Err(error) => return Err(failed(path, "find it")(error)),
        };
        let (temporary, file) = Temporary::create(&target).map_err(failed(path, "make a new file in its folder"))?;
        Ok(Self { target, old, temporary, file })
    }
}

fn failed(path: &Path, doing: &'static str) -> impl Fn(io::Error) -> FileError {
    move |source| FileError::Io { path: path.to_owned(), doing, source: Arc::new(source) }
}

/// The number of names to try for a new file.
const NAMES: u32 = 1000;

/// A file that is removed when this is dropped, unless it was renamed.
struct Temporary {
    path: PathBuf,
    renamed: bool,
}

impl Temporary {
    fn create(target: &Path) -> io::Result<(Self, File)> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        let target_name = target.file_name().ok_or(io::ErrorKind::InvalidFilename)?;
        for _ in 0..NAMES {
            let path = target.with_file_name(name_of(target_name, NEXT.fetch_add(1, Ordering::Relaxed)));
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                // Left by a killed process with this number: in containers numbers repeat.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(error),
                // Otherwise another process is removing it: it was not locked for a moment.
                Ok(file) if lock(&file) => return Ok((Self { path, renamed: false }, file)),
                Ok(_) => {}
            }
        }
        Err(io::ErrorKind::AlreadyExists.into())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.renamed {
            // A file that cannot be removed stays until the next save.
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Writes the new name to the disk. Not all systems can do that; the file is whole without it.
fn sync_folder(target: &Path) {
    let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if let Ok(folder) = File::open(folder) {
        let _ = folder.sync_all();
    }
}

#[cfg(test)]
mod tests;
