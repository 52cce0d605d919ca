use super::*;

/// A folder for one test, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("fatek-save-{}-{name}", std::process::id()));
        let _ = fs::remove_dir_all(&path);
        fs::create_dir(&path).unwrap();
        Self(path)
    }

    fn names(&self) -> Vec<String> {
        let mut names: Vec<_> =
            fs::read_dir(&self.0).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

#[test]
fn a_file_is_made_and_replaced_and_no_other_is_left() {
    let folder = Folder::new("replace");
    let path = folder.0.join("a.program");
    for content in [&b"one"[..], b"another, which is longer", b""] {
        save(&path, content).unwrap();
        assert_eq!(load(&path).unwrap(), content);
        assert_eq!(folder.names(), ["a.program"]);
    }
}

#[test]
fn a_failure_at_any_byte_leaves_the_old_file_whole() {
    let folder = Folder::new("failure");
    let path = folder.0.join("a.program");
    save(&path, b"the old one").unwrap();
    let new = b"the new one, which does not fit";
    for written in 0..=new.len() {
        let error = save_with(&path, |file| {
            file.write_all(&new[..written])?;
            // As another process sees it at this moment.
            assert_eq!(load(&path).unwrap(), b"the old one");
            Err(io::ErrorKind::StorageFull.into())
        });
        let error = error.unwrap_err().to_string();
        assert!(error.contains("a.program: cannot write it: ") && error.contains("no storage space"), "{error}");
        assert_eq!(load(&path).unwrap(), b"the old one");
        assert_eq!(folder.names(), ["a.program"]);
    }
}

#[test]
fn folders_are_not_replaced() {
    let folder = Folder::new("folder");
    let error = save(&folder.0, b"x").unwrap_err();
    assert!(matches!(error, FileError::NotAFile { .. }), "{error}");
    let error = save(folder.0.join("none").join("a"), b"x").unwrap_err().to_string();
    assert!(error.contains("cannot make a new file in its folder"), "{error}");
    assert!(load(&folder.0.join("none")).unwrap_err().to_string().contains("cannot read it"));
}

#[test]
fn checking_whether_a_file_can_be_saved_changes_nothing() {
    let folder = Folder::new("before");
    let path = folder.0.join("a");
    can_save(&path).unwrap();
    assert_eq!(folder.names().len(), 0);
    save(&path, b"old").unwrap();
    can_save(&path).unwrap();
    assert_eq!((folder.names(), load(&path).unwrap()), (vec!["a".to_owned()], b"old".to_vec()));
    assert!(matches!(can_save(&folder.0), Err(FileError::NotAFile { .. })));
    for (name, found) in [
        ("none/a", "cannot make a new file in its folder: "),
        ("a/b", "cannot find it: "),
        ("folder/", "not a regular file"),
    ] {
        let path = folder.0.join(name);
        let (before, saving) = (can_save(&path).unwrap_err().to_string(), save(&path, b"x").unwrap_err().to_string());
        assert!(before == saving && before.contains(found), "{before}, {saving}");
    }
}

#[test]
fn a_name_of_the_maximum_length_can_be_saved() {
    let folder = Folder::new("long");
    // The maximum on most systems.
    let path = folder.0.join("n".repeat(255));
    save(&path, b"one").unwrap();
    save(&path, b"two").unwrap();
    assert_eq!((load(&path).unwrap(), folder.names().len()), (b"two".to_vec(), 1));
}

/// Before: files left over by killed processes stayed for ever.
#[cfg(unix)]
#[test]
fn left_over_files_of_the_same_target_are_removed() {
    let folder = Folder::new("left");
    let path = folder.0.join("a");
    let mut others = vec!["a".to_owned()];
    for number in 0..200 {
        // Of this process, whose number a killed process had before: the names are in use.
        fs::write(folder.0.join(name_of("a".as_ref(), number)), b"half").unwrap();
        fs::write(folder.0.join(name_of("b".as_ref(), number)), b"half").unwrap();
        others.push(name_of("b".as_ref(), number));
    }
    for name in ["x", "1", "1-", "-1", "1-1x", "1-1-1"] {
        let name = name_of("a".as_ref(), 0).replace(&format!("{}-0", std::process::id()), name);
        fs::write(folder.0.join(&name), b"another program's").unwrap();
        others.push(name);
    }
    others.sort();
    save(&path, b"new").unwrap();
    assert_eq!((load(&path).unwrap(), folder.names()), (b"new".to_vec(), others));
}

#[cfg(unix)]
#[test]
fn the_file_of_a_running_save_is_not_removed() {
    let folder = Folder::new("running");
    let path = folder.0.join("a");
    save_with(&path, |file| {
        // Another save of the same file, as by another process: locks belong to open files.
        save(&path, b"other").unwrap();
        assert_eq!(folder.names().len(), 2, "{:?}", folder.names());
        file.write_all(b"slow")
    })
    .unwrap();
    assert_eq!((load(&path).unwrap(), folder.names()), (b"slow".to_vec(), vec!["a".to_owned()]));
}

/// Before: loading a pipe blocked until another program wrote to it.
#[cfg(unix)]
#[test]
fn pipes_and_devices_are_not_read() {
    let folder = Folder::new("pipe");
    let pipe = folder.0.join("pipe");
    assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    for path in [pipe.as_path(), Path::new("/dev/zero"), &folder.0] {
        let error = load(path).unwrap_err();
        assert!(matches!(error, FileError::NotAFile { .. }), "{error}");
        assert!(error.to_string().ends_with(": not a regular file"), "{error}");
        assert!(matches!(can_save(path), Err(FileError::NotAFile { .. })));
    }
}

#[cfg(unix)]
#[test]
fn permissions_and_symbolic_links_are_kept() {
    use std::os::unix::fs::{PermissionsExt, symlink};

    let folder = Folder::new("links");
    let (path, link, lost) = (folder.0.join("a"), folder.0.join("link"), folder.0.join("lost"));
    save(&path, b"old").unwrap();
    fs::set_permissions(&path, fs::Permissions::from_mode(0o600)).unwrap();
    symlink("a", &link).unwrap();
    save(&link, b"new").unwrap();
    assert_eq!(load(&path).unwrap(), b"new");
    assert!(link.is_symlink());
    save_with(&path, |file| {
        assert_eq!(file.metadata()?.permissions().mode() & 0o777, 0o600, "before the first byte");
        file.write_all(b"new")
    })
    .unwrap();
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o600);

    symlink("nothing", &lost).unwrap();
    assert!(matches!(save(&lost, b"x"), Err(FileError::NotAFile { .. })));
}

#[test]
fn a_file_that_is_too_large_is_not_read() {
    let folder = Folder::new("large");
    let path = folder.0.join("a");
    File::create(&path).unwrap().set_len(MAX_LEN + 1).unwrap();
    assert!(matches!(load(&path), Err(FileError::TooLarge { .. })));
}
