//! Log file of `fatek watch`: CSV that is appended to, and renamed when it is full.
//!
//! Files: `FILE` with the newest lines, `FILE.1` with those before, up to `FILE.N`. Each begins with
//! the header. A line is in one file as a whole.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, BufRead, BufReader, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use crate::failure::Failure;

/// Log file that is open.
#[derive(Debug)]
pub(super) struct LogFile {
    path: PathBuf,
    file: File,
    /// First line of each file.
    header: Vec<u8>,
    /// Bytes in the file.
    size: u64,
    max_size: u64,
    keep: u16,
}

impl LogFile {
    /// Opens a log file; one that exists is continued if it has this header. `max_size`: bytes of a
    /// full file. `keep`: number of full files that are kept.
    pub(super) fn open(path: &Path, header: Vec<u8>, max_size: u64, keep: u16) -> Result<Self, Failure> {
        let failure = |error: io::Error| Failure::Log { path: path.to_owned(), error };
        // A device or a pipe can neither be continued nor renamed.
        if fs::metadata(path).is_ok_and(|metadata| !metadata.is_file()) {
            return Err(failure(io::Error::other("it is not a regular file")));
        }
        let (file, size) = open(path, &header).map_err(failure)?;
        // The files that are renamed are those that a symbolic link names.
        let path = fs::canonicalize(path).map_err(failure)?;
        Ok(Self { path, file, header, size, max_size, keep })
    }

    /// Appends a line, which ends with a line feed.
    pub(super) fn line(&mut self, line: &[u8]) -> Result<(), Failure> {
        let appended = self.append(line);
        appended.map_err(|error| Failure::Log { path: self.path.clone(), error })
    }

    fn append(&mut self, line: &[u8]) -> io::Result<()> {
        if !is_at(&self.file, &self.path)? {
            // It was removed or renamed since: a new file is begun, as after a rotation by another program.
            (self.file, self.size) = open(&self.path, &self.header)?;
        }
        // A file has at least one line.
        if self.size > length(&self.header) && self.size.saturating_add(length(line)) > self.max_size {
            self.rotate()?;
        }
        // In one call: a reader sees whole lines.
        self.file.write_all(line)?;
        self.size = self.size.saturating_add(length(line));
        Ok(())
    }

    /// Renames the full files and begins a new one.
    fn rotate(&mut self) -> io::Result<()> {
        let numbered = |number: u16| match number {
            0 => self.path.clone(),
            number => {
                let mut name = OsString::from(&self.path);
                name.push(format!(".{number}"));
                name.into()
            }
        };
        let permissions = self.file.metadata()?.permissions();
        if self.keep == 0 {
            fs::remove_file(&self.path)?;
        }
        for number in (0..self.keep).rev() {
            match fs::rename(numbered(number), numbered(number + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        // Not one that another program has created in between.
        let mut file = OpenOptions::new().create_new(true).read(true).append(true).open(&self.path)?;
        file.set_permissions(permissions)?;
        lock(&file)?;
        file.write_all(&self.header)?;
        (self.file, self.size) = (file, length(&self.header));
        Ok(())
    }
}

fn length(bytes: &[u8]) -> u64 {
    u64::try_from(bytes.len()).unwrap_or(u64::MAX)
}

/// Opens or creates a file with this header. Returns its size, too.
fn open(path: &Path, header: &[u8]) -> io::Result<(File, u64)> {
    let mut file = OpenOptions::new().create(true).read(true).append(true).open(path)?;
    lock(&file)?;
    let size = continue_file(&mut file, header)?;
    Ok((file, size))
}

/// Locks a file for this process: two writers would rename it under each other.
fn lock(file: &File) -> io::Result<()> {
    match file.try_lock() {
        Ok(()) => Ok(()),
        Err(TryLockError::WouldBlock) => Err(io::Error::other("another command writes to it")),
        // Some file systems have no locks.
        Err(TryLockError::Error(_)) => Ok(()),
    }
}

/// Returns whether the path still names the open file.
#[cfg(unix)]
fn is_at(file: &File, path: &Path) -> io::Result<bool> {
    use std::os::unix::fs::MetadataExt as _;

    let open = file.metadata()?;
    match fs::metadata(path) {
        Ok(named) => Ok((named.dev(), named.ino()) == (open.dev(), open.ino())),
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
        Err(error) => Err(error),
    }
}

/// An open file can be neither removed nor renamed on other systems.
#[cfg(not(unix))]
fn is_at(_: &File, _: &Path) -> io::Result<bool> {
    Ok(true)
}

/// Writes the header if the file is empty, and checks it otherwise. Returns the size of the file.
///
/// A line that was cut when the system or the disk failed is removed.
fn continue_file(file: &mut File, header: &[u8]) -> io::Result<u64> {
    let mut first = Vec::new();
    BufReader::new(&*file).take(length(header).saturating_add(1)).read_until(b'\n', &mut first)?;
    if first != header {
        let is_cut_header = file.metadata()?.len() == length(&first) && header.starts_with(&first);
        if !is_cut_header {
            return Err(io::Error::other("it has other columns or is another kind of file; choose another name"));
        }
        file.set_len(0)?;
        file.write_all(header)?;
        return Ok(length(header));
    }
    let whole = end_of_last_line(file)?;
    file.set_len(whole)?;
    Ok(whole)
}

/// The position after the last line feed.
fn end_of_last_line(file: &mut File) -> io::Result<u64> {
    const BLOCK: u64 = 4096;
    let mut end = file.metadata()?.len();
    while end > 0 {
        let start = end.saturating_sub(BLOCK);
        let mut block = Vec::new();
        file.seek(SeekFrom::Start(start))?;
        (&*file).take(end - start).read_to_end(&mut block)?;
        if let Some(at) = block.iter().rposition(|byte| *byte == b'\n') {
            return Ok(start + length(&block[..=at]));
        }
        end = start;
    }
    Ok(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Folder of a test, removed at its end.
    struct Folder(PathBuf);

    impl Folder {
        fn new(name: &str) -> Self {
            let path = std::env::temp_dir().join(format!("fatek-log-{name}-{}", std::process::id()));
            fs::create_dir_all(&path).unwrap();
            Self(path)
        }

        fn read(&self, name: &str) -> Option<String> {
            fs::read_to_string(self.0.join(name)).ok()
        }
    }

    impl Drop for Folder {
        fn drop(&mut self) {
            let _ = fs::remove_dir_all(&self.0);
        }
    }

    fn open(folder: &Folder, keep: u16) -> Result<LogFile, Failure> {
        LogFile::open(&folder.0.join("log.csv"), b"a,b\n".to_vec(), 12, keep)
    }

    #[test]
    fn full_files_are_renamed_and_the_oldest_is_removed() {
        let folder = Folder::new("rotate");
        let mut log = open(&folder, 2).unwrap();
        for number in 1..=7 {
            log.line(format!("{number},0\n").as_bytes()).unwrap();
        }
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n7,0\n");
        assert_eq!(folder.read("log.csv.1").unwrap(), "a,b\n5,0\n6,0\n");
        assert_eq!(folder.read("log.csv.2").unwrap(), "a,b\n3,0\n4,0\n");
        assert_eq!(folder.read("log.csv.3"), None);
        // A line that is longer than a file has one of its own.
        log.line(b"123456789012,0\n").unwrap();
        log.line(b"8,0\n").unwrap();
        assert_eq!(folder.read("log.csv.1").unwrap(), "a,b\n123456789012,0\n");
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n8,0\n");
    }

    #[test]
    fn without_full_files_to_keep_the_log_begins_anew() {
        let folder = Folder::new("keep-none");
        let mut log = open(&folder, 0).unwrap();
        (1..=3).for_each(|number| log.line(format!("{number},0\n").as_bytes()).unwrap());
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n3,0\n");
        assert_eq!(fs::read_dir(&folder.0).unwrap().count(), 1);
    }

    fn append(folder: &Folder, text: &str) {
        let mut file = OpenOptions::new().append(true).open(folder.0.join("log.csv")).unwrap();
        file.write_all(text.as_bytes()).unwrap();
    }

    // Before: a line feed was added, and a cut quote took the lines after it into one cell.
    #[test]
    fn a_cut_line_is_removed_when_a_log_is_continued() {
        let folder = Folder::new("continue");
        open(&folder, 1).unwrap().line(b"1,0\n").unwrap();
        append(&folder, "2,\"a, b");
        open(&folder, 1).unwrap().line(b"3,0\n").unwrap();
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n1,0\n3,0\n");
        append(&folder, &"x".repeat(10_000));
        open(&folder, 1).unwrap().line(b"4,0\n").unwrap();
        assert_eq!(folder.read("log.csv.1").unwrap(), "a,b\n1,0\n3,0\n");
        // Before: a cut header was another kind of file for ever.
        for cut in ["", "a", "a,b"] {
            fs::write(folder.0.join("log.csv"), cut).unwrap();
            open(&folder, 1).unwrap().line(b"5,0\n").unwrap();
            assert_eq!(folder.read("log.csv").unwrap(), "a,b\n5,0\n");
        }
    }

    #[test]
    fn files_of_another_kind_are_refused() {
        let folder = Folder::new("other");
        for other in ["a,c\n1,0\n", "a,b,c\n", "a\n", "\n", "x\u{0}"] {
            fs::write(folder.0.join("log.csv"), other).unwrap();
            let failure = open(&folder, 1).unwrap_err().to_string();
            assert!(failure.contains("log.csv") && failure.contains("other columns"), "{failure}");
            assert_eq!(folder.read("log.csv").unwrap(), other, "nothing was written");
        }
        let folder_as_file = LogFile::open(&folder.0, b"a\n".to_vec(), 12, 1).unwrap_err().to_string();
        assert!(folder_as_file.contains("not a regular file"), "{folder_as_file}");
        fs::remove_file(folder.0.join("log.csv")).unwrap();
        let _first = open(&folder, 1).unwrap();
        assert!(open(&folder, 1).unwrap_err().to_string().contains("another command writes to it"));
    }

    // Before: lines went to the removed file, the link was renamed, and new files could be read by all.
    #[cfg(unix)]
    #[test]
    fn a_log_keeps_its_place_and_permissions() {
        use std::os::unix::fs::{PermissionsExt as _, symlink};

        let folder = Folder::new("place");
        fs::create_dir(folder.0.join("real")).unwrap();
        let real = folder.0.join("real/log.csv");
        fs::write(&real, "").unwrap();
        fs::set_permissions(&real, fs::Permissions::from_mode(0o600)).unwrap();
        symlink(&real, folder.0.join("log.csv")).unwrap();
        let mut log = open(&folder, 2).unwrap();
        (1..=3).for_each(|number| log.line(format!("{number},0\n").as_bytes()).unwrap());
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n3,0\n");
        assert_eq!(folder.read("real/log.csv.1").unwrap(), "a,b\n1,0\n2,0\n");
        assert_eq!(fs::metadata(&real).unwrap().permissions().mode() & 0o777, 0o600);
        fs::remove_file(&real).unwrap();
        log.line(b"4,0\n").unwrap();
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n4,0\n");
    }
}
