//! A strict reader of OpenMetrics text, for tests.

use std::collections::{BTreeMap, HashSet};

/// Samples by name and labels, as they are written: `fatek_tag_value{plc="mixer",tag="level"}`.
pub type Samples = BTreeMap<String, f64>;

/// Reads a text, and panics where it breaks a rule of OpenMetrics.
///
/// Rules: families are not interleaved and have type and help; names, labels and suffixes are those of the
/// type; a unit ends the name; samples are unique and are numbers; the last line is `# EOF`.
pub fn parse(text: &str) -> Samples {
    let mut samples = Samples::new();
    let mut families = HashSet::new();
    let (mut family, mut kind, mut unit, mut has_help) = (String::new(), String::new(), None, false);
    let mut is_ended = false;
    assert!(text.ends_with('\n'), "the last line ends");
    for line in text.lines() {
        assert!(!is_ended, "{line} after # EOF");
        if line == "# EOF" {
            is_ended = true;
        } else if let Some(rest) = line.strip_prefix("# ") {
            let (keyword, rest) = rest.split_once(' ').expect(line);
            let (name, rest) = rest.split_once(' ').expect(line);
            if name != family {
                assert!(families.insert(name.to_owned()), "{name} comes twice");
                (family, kind, unit, has_help) = (name.to_owned(), String::new(), None, false);
            }
            match keyword {
                "TYPE" => kind = rest.to_owned(),
                "HELP" => has_help = !rest.is_empty(),
                "UNIT" => {
                    assert!(name.ends_with(&format!("_{rest}")), "{line}");
                    unit = Some(rest.to_owned());
                }
                _ => panic!("{line}"),
            }
        } else {
            let (series, value) = line.rsplit_once(' ').expect(line);
            let name = series.split('{').next().expect(line);
            let suffix = match kind.as_str() {
                "counter" => "_total",
                "info" => "_info",
                "gauge" => "",
                other => panic!("type {other} of {line}"),
            };
            assert!(has_help, "{family} has a help text");
            assert_eq!(name, format!("{family}{suffix}"), "{line}");
            assert!(!(family.contains("seconds") || family.contains("bytes")) || unit.is_some(), "unit of {family}");
            check_labels(series.strip_prefix(name).expect(line));
            let value: f64 = value.parse().expect(line);
            assert!(kind != "counter" || value >= 0.0, "{line}");
            assert!(samples.insert(series.to_owned(), value).is_none(), "{series} comes twice");
        }
    }
    assert!(is_ended, "no # EOF");
    samples
}

/// Checks labels: none, or `{name="text",…}` with escapes.
fn check_labels(labels: &str) {
    if labels.is_empty() {
        return;
    }
    let mut rest = labels.strip_prefix('{').and_then(|labels| labels.strip_suffix('}')).expect(labels);
    let mut names = HashSet::new();
    while !rest.is_empty() {
        let (name, text) = rest.split_once("=\"").expect(labels);
        assert!(!name.is_empty() && name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_'), "{labels}");
        assert!(names.insert(name), "{name} comes twice in {labels}");
        let mut chars = text.char_indices();
        let end = loop {
            match chars.next().expect(labels) {
                (_, '\\') => assert!(matches!(chars.next(), Some((_, '\\' | '"' | 'n'))), "escape in {labels}"),
                (end, '"') => break end,
                _ => {}
            }
        };
        rest = &text[end + 1..];
        rest = rest.strip_prefix(',').unwrap_or(rest);
    }
}
