//! Log file of `fatek watch`: CSV that is appended to, and renamed when it is full.
//!
//! Files: `FILE` with the newest lines, `FILE.1` with those before, up to `FILE.N`. Each begins with
//! the header. A line is in one file as a whole.

use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
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
        let mut file = OpenOptions::new().create(true).read(true).append(true).open(path).map_err(failure)?;
        let size = continue_file(&mut file, &header).map_err(failure)?;
        Ok(Self { path: path.to_owned(), file, header, size, max_size, keep })
    }

    /// Appends a line, which ends with a line feed.
    pub(super) fn line(&mut self, line: &[u8]) -> Result<(), Failure> {
        let appended = self.append(line);
        appended.map_err(|error| Failure::Log { path: self.path.clone(), error })
    }

    fn append(&mut self, line: &[u8]) -> io::Result<()> {
        let length = |bytes: &[u8]| u64::try_from(bytes.len()).unwrap_or(u64::MAX);
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
        if self.keep == 0 {
            fs::remove_file(&self.path)?;
        }
        for number in (0..self.keep).rev() {
            match fs::rename(numbered(number), numbered(number + 1)) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                Ok(()) | Err(_) => {}
            }
        }
        // Not created by another program in between.
        self.file = OpenOptions::new().create_new(true).append(true).open(&self.path)?;
        self.file.write_all(&self.header)?;
        self.size = u64::try_from(self.header.len()).unwrap_or(u64::MAX);
        Ok(())
    }
}

/// Writes the header if the file is empty, and checks it otherwise. Returns the size of the file.
fn continue_file(file: &mut File, header: &[u8]) -> io::Result<u64> {
    let size = file.metadata()?.len();
    if size == 0 {
        file.write_all(header)?;
        return file.metadata().map(|metadata| metadata.len());
    }
    let mut first = Vec::new();
    let longest = u64::try_from(header.len()).unwrap_or(u64::MAX).saturating_add(1);
    BufReader::new(&*file).take(longest).read_until(b'\n', &mut first)?;
    if first != header {
        let other = "it has other columns or is another kind of file; choose another name";
        return Err(io::Error::other(other));
    }
    // The last line may be cut: the system failed while it was written.
    let mut last = [0];
    file.seek(SeekFrom::End(-1))?;
    file.read_exact(&mut last)?;
    if last != *b"\n" {
        file.write_all(b"\n")?;
    }
    file.metadata().map(|metadata| metadata.len())
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

    #[test]
    fn a_log_is_continued_also_behind_a_cut_line_and_no_other_file_is() {
        let folder = Folder::new("continue");
        open(&folder, 1).unwrap().line(b"1,0\n").unwrap();
        fs::OpenOptions::new().append(true).open(folder.0.join("log.csv")).unwrap().write_all(b"2,").unwrap();
        open(&folder, 1).unwrap().line(b"3,0\n").unwrap();
        // The cut line has filled the file.
        assert_eq!(folder.read("log.csv.1").unwrap(), "a,b\n1,0\n2,\n");
        assert_eq!(folder.read("log.csv").unwrap(), "a,b\n3,0\n");
        for other in ["a,c\n1,0\n", "a,b,c\n", "a", "\n", "x\u{0}"] {
            fs::write(folder.0.join("log.csv"), other).unwrap();
            let failure = open(&folder, 1).unwrap_err().to_string();
            assert!(failure.contains("log.csv") && failure.contains("other columns"), "{failure}");
            assert_eq!(folder.read("log.csv").unwrap(), other, "nothing was written");
        }
        let folder_as_file = LogFile::open(&folder.0, b"a\n".to_vec(), 12, 1).unwrap_err().to_string();
        assert!(folder_as_file.contains("not a regular file"), "{folder_as_file}");
    }
}
