use super::FormatError;
use super::frame::{ADDED, AddedField, Content, MINOR};

/// The lines of a content, one field each: `name value`.
///
/// In a content of a newer version, lines with an unknown name are skipped.
#[derive(Debug)]
pub(crate) struct Lines<'a> {
    rest: &'a str,
    /// The number of the last line in the file.
    number: usize,
    is_known: fn(&str) -> bool,
    minor: usize,
    added: &'static [AddedField],
    unknown: Vec<String>,
}

/// Lines of the frame before the content.
const LINES_BEFORE: usize = 2;
/// The field for people. It follows from other fields by rules that differ between versions.
const ABOUT: &str = "about";

impl<'a> Lines<'a> {
    pub(crate) fn new(content: Content<'a>, is_known: fn(&str) -> bool) -> Self {
        let Content { text, minor } = content;
        Self { rest: text, number: LINES_BEFORE, is_known, minor, added: ADDED, unknown: Vec::new() }
    }

    /// Takes the next line, which must have this name, and returns its value.
    pub(crate) fn field(&mut self, name: &str) -> Result<&'a str, FormatError> {
        let line = self.line().ok_or_else(|| self.error(format!("`{name}` was expected, and the content ends")))?;
        match line.split_once(' ') {
            Some((found, value)) if found == name => Ok(value),
            Some(_) | None => Err(self.error(format!("`{name}` was expected"))),
        }
    }

    /// Takes the next line, which must have this name, and parses its value; `-` is `None`, and so
    /// is a field that files of this version do not have yet.
    pub(crate) fn optional<T>(
        &mut self,
        name: &str,
        rule: &str,
        parse: impl FnOnce(&str) -> Option<T>,
    ) -> Result<Option<T>, FormatError> {
        if self.is_later(name) {
            return Ok(None);
        }
        let text = self.field(name)?;
        if text == UNKNOWN {
            return Ok(None);
        }
        parse(text).map(Some).ok_or_else(|| self.error(format!("`{name}`: {rule}, or `{UNKNOWN}`, was expected")))
    }

    /// Takes the next line, split into name and value; `None` at the end.
    pub(crate) fn any_field(&mut self) -> Result<Option<(&'a str, &'a str)>, FormatError> {
        let Some(line) = self.line() else { return Ok(None) };
        line.split_once(' ').map(Some).ok_or_else(|| self.error("a name, a blank and a value were expected"))
    }

    /// Checks that no line is left.
    pub(crate) fn end(&mut self) -> Result<(), FormatError> {
        match self.line() {
            None => Ok(()),
            Some(_) => Err(self.error("the content should end before this line")),
        }
    }

    /// Checks that the content has its only form: the same fields, written again.
    ///
    /// Returns the names of the fields that were skipped.
    pub(crate) fn in_form(self, content: Content<'_>, form: &str) -> Result<Vec<String>, FormatError> {
        let mut lines = Lines { added: self.added, ..Lines::new(content, self.is_known) };
        for expected in form.lines() {
            if expected.split_once(' ').is_some_and(|(name, _)| self.is_later(name)) {
                continue;
            }
            let (found, wanted) = (lines.any_field()?, expected.split_once(' '));
            let is_about = |field: Option<(&str, &str)>| field.is_some_and(|(name, _)| name == ABOUT);
            if found != wanted && !(is_about(found) && is_about(wanted)) {
                return Err(lines.error(format!("`{expected}` was expected")));
            }
        }
        lines.end()?;
        if content.text.ends_with('\n') {
            Ok(self.unknown)
        } else {
            Err(lines.error("the last line should end with a line feed"))
        }
    }

    /// Returns whether a field was added in a later version than that of the file.
    fn is_later(&self, name: &str) -> bool {
        self.added.iter().any(|&(added, since)| added == name && self.minor < since)
    }

    /// An error of the line that was taken last.
    pub(crate) fn error(&self, rule: impl Into<String>) -> FormatError {
        FormatError::line(self.number, rule)
    }

    fn line(&mut self) -> Option<&'a str> {
        loop {
            // A file has fewer lines than bytes.
            self.number = self.number.saturating_add(1);
            if self.rest.is_empty() {
                return None;
            }
            let (line, rest) = self.rest.split_once('\n').unwrap_or((self.rest, ""));
            self.rest = rest;
            let (name, _) = line.split_once(' ').unwrap_or((line, ""));
            let is_newer = self.minor.checked_sub(MINOR).is_some_and(|later| later > 0);
            if !is_newer || (self.is_known)(name) {
                return Some(line);
            }
            if !self.unknown.iter().any(|unknown| unknown == name) {
                self.unknown.push(name.to_owned());
            }
        }
    }
}

/// Stands for a value that is not known.
pub(crate) const UNKNOWN: &str = "-";

#[cfg(test)]
mod tests {
    use super::*;

    fn content(text: &str) -> Content<'_> {
        Content { text, minor: MINOR }
    }

    fn lines(text: &str) -> Lines<'_> {
        Lines::new(content(text), |name| name.len() == 1)
    }

    fn in_form(text: &str, form: &str) -> Result<Vec<String>, FormatError> {
        lines(text).in_form(content(text), form)
    }

    #[test]
    fn lines_are_counted_as_in_the_file() {
        let mut three = lines("a 1\nb two words\nc\n");
        assert_eq!(three.field("a"), Ok("1"));
        assert_eq!(three.any_field(), Ok(Some(("b", "two words"))));
        assert_eq!(three.field("c").unwrap_err().to_string(), "line 5: `c` was expected");
        assert_eq!(three.end(), Ok(()));
        let error = lines("x y\n").end().unwrap_err();
        assert_eq!(error.to_string(), "line 3: the content should end before this line");
        assert!(lines("").field("a").unwrap_err().to_string().contains("`a` was expected, and the content ends"));
    }

    #[test]
    fn a_content_in_another_form_is_refused_by_line() {
        let form = "a 1\nb two words\n";
        assert_eq!(in_form(form, form), Ok(vec![]));
        for (text, message) in [
            ("a 01\nb two words\n", "line 3: `a 1` was expected"),
            ("a 1\nb two  words\n", "line 4: `b two words` was expected"),
            ("a 1\n", "line 4: `b two words` was expected"),
            ("a 1\nb two words\nc 3\n", "line 5: the content should end before this line"),
            ("a 1\nb two words", "line 5: the last line should end with a line feed"),
        ] {
            assert_eq!(in_form(text, form).unwrap_err().to_string(), message);
        }
        // The field for people may differ, but not be missing.
        assert_eq!(in_form("about x\na 1\n", "about y\na 1\n"), Ok(vec![]));
        assert_eq!(in_form("a 1\n", "about y\na 1\n").unwrap_err().to_string(), "line 3: `about y` was expected");
    }

    #[test]
    fn a_field_added_later_is_unknown_in_an_older_content() {
        let (old, new) = ("a 1\nc 3\n", "a 1\nb 2\nc 3\n");
        let added: &[AddedField] = &[("b", 1)];
        let read = |text, minor| {
            let content = Content { text, minor };
            let mut lines = Lines { added, ..Lines::new(content, |_| true) };
            lines.field("a")?;
            let b = lines.optional("b", "a number", |text| text.parse::<u8>().ok())?;
            lines.field("c")?;
            let form = format!("a 1\nb {}\nc 3\n", b.map_or(UNKNOWN.to_owned(), |b| b.to_string()));
            lines.in_form(content, &form).map(|_| b)
        };
        assert_eq!(read(old, 0), Ok(None));
        assert_eq!(read(new, 1), Ok(Some(2)));
        assert_eq!(read(old, 1).unwrap_err().to_string(), "line 4: `b` was expected");
        assert_eq!(read(new, 0).unwrap_err().to_string(), "line 4: `c` was expected");
    }

    #[test]
    fn unknown_fields_are_skipped_in_a_newer_content_only() {
        let text = "new\na 1\nnewer 2\nnewer 3\nb 2\nlast 4\n";
        let newer = Content { text, minor: MINOR + 1 };
        let mut skipping = Lines::new(newer, |name| name.len() == 1);
        assert_eq!((skipping.field("a"), skipping.field("b")), (Ok("1"), Ok("2")));
        assert_eq!(skipping.error("x").to_string(), "line 7: x");
        assert_eq!(skipping.end(), Ok(()));
        let unknown = skipping.in_form(newer, "a 1\nb 2\n").unwrap();
        assert_eq!(unknown, ["new", "newer", "last"]);
        assert_eq!(lines(text).field("a").unwrap_err().to_string(), "line 3: `a` was expected");
        let wrong = Lines::new(newer, |name| name.len() == 1);
        assert_eq!(wrong.in_form(newer, "a 1\nb 3\n").unwrap_err().to_string(), "line 7: `b 3` was expected");
    }
}
