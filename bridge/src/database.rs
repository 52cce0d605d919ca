//! Database files: a file of the right name is a whole database, or it is damaged.
//!
//! redb makes a database in an empty file, so a file that lost its content would pass as a new one: ids of
//! commands would be executed again, and data would be lost without a word. So a new database is made under another
//! name and renamed. A crash in between leaves nothing but that other file.

use std::fs::{self, File};
use std::io;
use std::path::Path;

use redb::Builder;

/// Makes the database of this file if there is no file. The builder opens it then. Blocks.
///
/// # Errors
/// [`redb::Error`] if it cannot be made, or if the file is empty.
pub(crate) fn ensure(path: &Path, builder: &Builder) -> Result<(), redb::Error> {
    match fs::metadata(path) {
        Ok(metadata) if metadata.len() == 0 => Err(damaged("the file is empty").into()),
        Ok(_) => Ok(()),
        Err(error) if error.kind() == io::ErrorKind::NotFound => create(path, builder),
        Err(error) => Err(error.into()),
    }
}

fn create(path: &Path, builder: &Builder) -> Result<(), redb::Error> {
    let new = path.with_extension("new");
    match fs::remove_file(&new) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error.into()),
        Ok(()) | Err(_) => {}
    }
    drop(builder.create(&new)?);
    fs::rename(&new, path)?;
    // The name itself is on disk.
    if let Some(folder) = path.parent().filter(|folder| !folder.as_os_str().is_empty()) {
        File::open(folder)?.sync_all()?;
    }
    Ok(())
}

fn damaged(why: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, why)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_database_is_made_once_and_never_in_an_empty_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("ids.redb");
        // Left by a crash.
        fs::write(folder.path().join("ids.new"), [0; 4096]).unwrap();
        ensure(&path, &Builder::new()).unwrap();
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1);
        drop(Builder::new().open(&path).unwrap());
        let content = fs::read(&path).unwrap();
        ensure(&path, &Builder::new()).unwrap();
        assert_eq!(fs::read(&path).unwrap(), content);
        fs::write(&path, "").unwrap();
        let error = ensure(&path, &Builder::new()).unwrap_err();
        assert_eq!(error.to_string(), "I/O error: the file is empty");
        assert_eq!(fs::read(&path).unwrap(), b"");
    }
}
