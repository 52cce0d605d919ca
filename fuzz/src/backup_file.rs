//! Backup files. Invariant: a backup has one form, all other input is refused.

use fatek::Backup;

use crate::saved;

pub fn run(input: &[u8]) {
    let file = saved::file("backup", input);
    match Backup::from_file(&file) {
        Ok(backup) => {
            let again = Backup::from_file(backup.to_file().as_bytes()).expect("a file of this version");
            assert!(again.elements().eq(backup.elements()) && again.unknown_fields().is_empty());
            assert_eq!(again.to_file(), backup.to_file());
            assert_eq!(backup.elements().count(), backup.element_count());
            assert!(backup.value_count() <= backup.element_count());
        }
        Err(error) => assert_ne!(error.to_string(), ""),
    }
}
