use std::fs::{self, File, Metadata, OpenOptions};
use std::io::{self, Read, Write};
use std::path::{Path, PathBuf, is_separator};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::{FileError, FormatError};

/// More than any file of this library takes.
const MAX_LEN: u64 = 16 * 1024 * 1024;

/// Puts these bytes into a file, in the place of what it held.
///
/// They go into a new file in the same folder first, and only when all of them are on the disk does that take the other's
/// name. So whoever opens the file finds the old content or the new, whole, whatever happens in between. It keeps the
/// permissions of the old one, and a symbolic link goes on pointing to it.
pub(crate) fn save(path: &Path, content: &[u8]) -> Result<(), FileError> {
    save_with(path, |file| file.write_all(content))
}

/// The bytes of a file.
pub(crate) fn load(path: &Path) -> Result<Vec<u8>, FileError> {
    let failed = failed(path, "read it");
    let file = File::open(path).map_err(&failed)?;
    let mut content = Vec::new();
    file.take(MAX_LEN.saturating_add(1)).read_to_end(&mut content).map_err(&failed)?;
    if u64::try_from(content.len()).is_ok_and(|len| len <= MAX_LEN) {
        Ok(content)
    } else {
        Err(FileError::TooLarge { path: path.to_owned(), limit: MAX_LEN })
    }
}

/// What the content of a file stands for.
pub(crate) fn load_as<T>(path: &Path, parse: impl FnOnce(&[u8]) -> Result<T, FormatError>) -> Result<T, FileError> {
    parse(&load(path)?).map_err(|source| FileError::Format { path: path.to_owned(), source })
}

/// Finds out whether something could be saved there: that nothing but a file has this name, and that a new file can be made
/// beside it. Whoever is to work long for what he saves wants to know that before.
///
/// Nothing is left there, and what is in the file stays in it.
///
/// # Errors
/// [`FileError`], the same that saving would meet.
pub fn can_save(path: impl AsRef<Path>) -> Result<(), FileError> {
    Begun::at(path.as_ref()).map(drop)
}

fn save_with(path: &Path, write: impl FnOnce(&mut File) -> io::Result<()>) -> Result<(), FileError> {
    let Begun { target, old, mut temporary, mut file } = Begun::at(path)?;
    // First of all: what the old one hides is never to be seen in the new one.
    let permitted = old.map_or(Ok(()), |old| file.set_permissions(old.permissions()));
    let written = permitted.and_then(|()| write(&mut file)).and_then(|()| file.sync_all());
    drop(file);
    written.map_err(failed(path, "write it"))?;
    fs::rename(&temporary.path, &target).map_err(failed(path, "replace it"))?;
    temporary.gone = true;
    sync_folder(&target);
    Ok(())
}

/// The empty file that is to take the place of another, or of none.
struct Begun {
    /// What is replaced: behind symbolic links the file, not the link to it.
    target: PathBuf,
    old: Option<Metadata>,
    temporary: Temporary,
    file: File,
}

impl Begun {
    fn at(path: &Path) -> Result<Self, FileError> {
        let (target, old) = match fs::metadata(path) {
            Ok(old) if old.is_file() => (fs::canonicalize(path).map_err(failed(path, "find it"))?, Some(old)),
            Ok(_) => return Err(FileError::NotAFile { path: path.to_owned() }),
            // A link to nothing cannot be followed, and must not be replaced.
            Err(_) if path.is_symlink() => return Err(FileError::NotAFile { path: path.to_owned() }),
            // Nothing but a folder can have such a name.
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

/// How many names are tried for a new file.
const NAMES: u32 = 1000;

/// A file that is not there any more when this is dropped, unless it has been given another name.
struct Temporary {
    path: PathBuf,
    gone: bool,
}

impl Temporary {
    fn create(target: &Path) -> io::Result<(Self, File)> {
        static NEXT: AtomicU64 = AtomicU64::new(0);
        target.file_name().ok_or(io::ErrorKind::InvalidFilename)?;
        for _ in 0..NAMES {
            // Without the target's name, which may be as long as names can be.
            let hidden = format!(".fatek-{}-{}.new", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
            let path = target.with_file_name(hidden);
            match OpenOptions::new().write(true).create_new(true).open(&path) {
                // Left by a process of this number that was killed: in a container they are often the same.
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
                result => return result.map(|file| (Self { path, gone: false }, file)),
            }
        }
        Err(io::ErrorKind::AlreadyExists.into())
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        if !self.gone {
            // If it cannot be removed, nothing is to be done about that; it is nobody's file.
            let _ = fs::remove_file(&self.path);
        }
    }
}

/// Has the new name on the disk, too. Not all systems can do that, and none needs it for the file to be whole.
fn sync_folder(target: &Path) {
    let folder = target.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if let Ok(folder) = File::open(folder) {
        let _ = folder.sync_all();
    }
}

#[cfg(test)]
mod tests;
