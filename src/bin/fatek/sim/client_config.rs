//! Copies of plant configurations for clients of a simulator: the same file with other links.

use std::fs::{self, File};
use std::io::{self, Read, Write};
use std::ops::Range;
use std::path::Path;

use fatek::Endpoint;
use toml::Spanned;
use toml::de::DeTable;

/// First line of a copy. A file without it is not replaced.
const HEADER: &str = "# Copy of a plant configuration by `fatek sim`: its links lead to simulated PLCs.\n";

/// The text of the copy. `link`: the endpoint in place of another; the files that it names are those beside
/// the original, in `folder`.
pub(super) fn copy(text: &str, folder: &Path, link: impl Fn(&Endpoint) -> Option<Endpoint>) -> io::Result<String> {
    // Allowed at the beginning of a file only.
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    // The original can be a copy.
    let text = text.strip_prefix(HEADER).unwrap_or(text);
    let mut replacements: Vec<(Range<usize>, String)> = Vec::new();
    let table = parse(text)?;
    for (section, value) in table.get_ref() {
        let entries = value.get_ref().as_table().into_iter().flat_map(|section| section.iter());
        for (key, value) in entries.filter_map(|(_, entry)| entry.get_ref().as_table()).flat_map(|entry| entry.iter()) {
            let Some(old) = value.get_ref().as_str() else { continue };
            let new = match (&**section.get_ref(), &**key.get_ref()) {
                ("plc" | "bus", "link") => old.parse().ok().and_then(|old| link(&old)).map(|new| new.to_string()),
                ("plc", "tags") | ("sim", "memory" | "program") => {
                    Some(folder.join(old).to_string_lossy().into_owned())
                }
                (_, _) => None,
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
    parse(&copy)?;
    Ok(copy)
}

/// Parses a text that must be TOML: the original has been loaded. An error keeps real links out of a copy.
fn parse(text: &str) -> io::Result<Spanned<DeTable<'_>>> {
    DeTable::parse(text).map_err(|error| io::Error::other(format!("the copy would not be TOML: {}", error.message())))
}

/// Checks that the file is missing, or a copy that may be replaced.
pub(super) fn check(path: &Path) -> io::Result<()> {
    let file = match fs::metadata(path) {
        Ok(metadata) if metadata.is_file() => File::open(path)?,
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

/// Writes the copy. A client sees the old or the new file, never a part. It has the permissions of the original,
/// since it has its secrets.
pub(super) fn save(path: &Path, copy: &str, original: &Path) -> io::Result<()> {
    check(path)?;
    let permissions = fs::metadata(original)?.permissions();
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(format!(".{}.new", std::process::id()));
    let mut file = File::options().write(true).create_new(true).open(&temporary)?;
    // Before the first byte. On other systems permissions are only a flag that keeps the copy from being replaced.
    let permitted = if cfg!(unix) { file.set_permissions(permissions) } else { Ok(()) };
    let written = permitted.and_then(|()| file.write_all(copy.as_bytes())).and_then(|()| file.sync_all());
    drop(file);
    let saved = written.and_then(|()| fs::rename(&temporary, path));
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
        let copied = copy(text, Path::new("/plants"), new).unwrap();
        assert_eq!(copied, format!("{HEADER}{expected}"));
        assert_eq!(copy(&copied, Path::new("/plants"), |_| None).unwrap(), copied, "a copy of a copy");
        assert_eq!(Plant::from_toml(&copied).unwrap().plcs().count(), 3);
    }

    #[test]
    fn copies_name_the_files_beside_the_original() {
        let copied = |text: &str| copy(text, Path::new("/plants"), |_| None).unwrap();
        let tables = copied("[plc.a]\nlink = 'tcp://h'\nstation = 1\ntags = 'a\"\\b.csv'\n");
        assert!(tables.ends_with("tags = \"/plants/a\\\"\\\\b.csv\"\n"), "{tables}");
        let saved = copied("[sim.all]\nmemory = 'a.backup'\n[sim]\nb.program = '/b.program'\n[mqtt.x]\nmemory = 'm'\n");
        let expected =
            "[sim.all]\nmemory = \"/plants/a.backup\"\n[sim]\nb.program = \"/b.program\"\n[mqtt.x]\nmemory = 'm'\n";
        assert_eq!(saved, format!("{HEADER}{expected}"));
    }

    #[test]
    fn copies_are_toml_or_an_error() {
        let copied = copy("\u{feff}[plc.a]\nlink = 'tcp://h'\n", Path::new("/plants"), |_| None).unwrap();
        assert_eq!(copied, format!("{HEADER}[plc.a]\nlink = 'tcp://h'\n"));
        let error = copy("[plc.a\n", Path::new("/plants"), |_| None).unwrap_err().to_string();
        assert!(error.starts_with("the copy would not be TOML: "), "{error}");
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
