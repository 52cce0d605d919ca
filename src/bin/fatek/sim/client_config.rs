//! Copies of plant configurations for clients of a simulator: the same file with other links.

use std::fs;
use std::io::{self, Read};
use std::ops::Range;
use std::path::Path;

use fatek::Endpoint;
use toml::de::DeTable;

/// First line of a copy. A file without it is not replaced.
const HEADER: &str = "# Copy of a plant configuration by `fatek sim`: its links lead to simulated PLCs.\n";

/// The text of the copy. `link`: the endpoint in place of another; tables of tags are those beside the
/// original, in `folder`.
pub(super) fn copy(text: &str, folder: &Path, link: impl Fn(&Endpoint) -> Option<Endpoint>) -> String {
    // The original can be a copy.
    let text = text.strip_prefix(HEADER).unwrap_or(text);
    let mut replacements: Vec<(Range<usize>, String)> = Vec::new();
    // The syntax has been checked: the plant was loaded.
    if let Ok(table) = DeTable::parse(text) {
        let sections = table.get_ref().iter().filter(|(key, _)| ["plc", "bus"].contains(&&**key.get_ref()));
        let entries = sections.filter_map(|(_, value)| value.get_ref().as_table()).flat_map(|section| section.iter());
        for (key, value) in entries.filter_map(|(_, entry)| entry.get_ref().as_table()).flat_map(|entry| entry.iter()) {
            let Some(old) = value.get_ref().as_str() else { continue };
            let new = match &**key.get_ref() {
                "link" => old.parse().ok().and_then(|old| link(&old)).map(|new| new.to_string()),
                "tags" => Some(folder.join(old).to_string_lossy().into_owned()),
                _ => None,
            };
            replacements.extend(new.map(|new| (value.span(), quoted(&new))));
        }
    }
    replacements.sort_by_key(|(span, _)| span.start);
    let mut copy = HEADER.to_owned();
    let mut copied = 0;
    for (span, new) in replacements {
        copy.push_str(text.get(copied..span.start).unwrap_or_default());
        copy.push_str(&new);
        copied = span.end;
    }
    copy.push_str(text.get(copied..).unwrap_or_default());
    copy
}

/// Checks that the file is missing, or a copy that may be replaced.
pub(super) fn check(path: &Path) -> io::Result<()> {
    let file = match fs::metadata(path) {
        Ok(metadata) if metadata.is_file() => fs::File::open(path)?,
        Ok(_) => return Err(io::Error::other("it is not a file")),
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
    };
    let mut start = Vec::new();
    file.take(HEADER.len() as u64).read_to_end(&mut start)?;
    if start == HEADER.as_bytes() {
        Ok(())
    } else {
        Err(io::Error::other("it exists, and is not a copy of this command: remove it, or choose another name"))
    }
}

/// Writes the copy. A client sees the old or the new file, never a part.
pub(super) fn save(path: &Path, copy: &str) -> io::Result<()> {
    check(path)?;
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.new", std::process::id()));
    let saved = fs::write(&temporary, copy).and_then(|()| fs::rename(&temporary, path));
    if saved.is_err() {
        // Left over if it cannot be removed; the error of the write is the one to report.
        let _ = fs::remove_file(&temporary);
    }
    saved
}

/// A basic string of TOML.
fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for character in text.chars() {
        match character {
            '"' | '\\' => quoted.extend(['\\', character]),
            control if control.is_control() => quoted.push_str(&format!("\\u{:04X}", u32::from(control))),
            other => quoted.push(other),
        }
    }
    quoted.push('"');
    quoted
}

#[cfg(test)]
mod tests {
    use super::*;
    use fatek::plant::Plant;

    #[test]
    fn copies_differ_in_links_and_paths_of_tables_only() {
        let text = "# Gr\u{fc}n\n[class]\nfast = { every = '1s' }\n[plc.mixer] # first\nlink = 'tcp://10.0.0.3' # old\n\
                    station = 1\ntag.link = 'R5'\n[plc]\nboiler = { link = \"\"\"udp://10.0.0.4\"\"\", station = 1 }\n\
                    [bus.line]\nlink = \"serial:/dev/ttyUSB0?baud=19200\"\nstations = { a = 1 }\n[mqtt]\nlink = 'x'\n";
        let new = |old: &Endpoint| match old.to_string().as_str() {
            "udp://10.0.0.4:500" => Some("udp://127.0.0.1:7?framing=binary".parse().unwrap()),
            "tcp://10.0.0.3:500" => Some("tcp://127.0.0.1:5".parse().unwrap()),
            _ => None,
        };
        let expected = text
            .replace("'tcp://10.0.0.3'", "\"tcp://127.0.0.1:5\"")
            .replace("\"\"\"udp://10.0.0.4\"\"\"", "\"udp://127.0.0.1:7?framing=binary\"");
        let copied = copy(text, Path::new("/plants"), new);
        assert_eq!(copied, format!("{HEADER}{expected}"));
        assert_eq!(copy(&copied, Path::new("/plants"), |_| None), copied, "a copy of a copy");
        assert_eq!(Plant::from_toml(&copied).unwrap().plcs().count(), 3);
        let tables =
            copy("[plc.a]\nlink = 'tcp://h'\nstation = 1\ntags = 'a\"\\b.csv'\n", Path::new("/plants"), |_| None);
        assert!(tables.ends_with("tags = \"/plants/a\\\"\\\\b.csv\"\n"), "{tables}");
    }

    #[test]
    fn texts_are_quoted_for_toml() {
        let text = "a\"\\\n\t\u{7f}\u{9b}ü";
        let document = format!("x = {}", quoted(text));
        let table = DeTable::parse(&document).unwrap();
        let (_, value) = table.get_ref().iter().next().unwrap();
        assert_eq!(value.get_ref().as_str(), Some(text));
    }
}
