use super::FormatError;

/// The lines of a file's content, one field each: `name value`.
#[derive(Debug)]
pub(crate) struct Lines<'a> {
    rest: &'a str,
    /// Of the line that was taken last, in the whole file.
    number: usize,
}

/// The content begins behind the two lines of the frame.
const LINES_BEFORE: usize = 2;

impl<'a> Lines<'a> {
    pub(crate) fn new(content: &'a str) -> Self {
        Self { rest: content, number: LINES_BEFORE }
    }

    /// Takes the next line, which must have this name, and gives its value.
    pub(crate) fn field(&mut self, name: &str) -> Result<&'a str, FormatError> {
        let line = self.line().ok_or_else(|| self.error(format!("`{name}` was expected, and the content ends")))?;
        match line.split_once(' ') {
            Some((found, value)) if found == name => Ok(value),
            _ => Err(self.error(format!("`{name}` was expected"))),
        }
    }

    /// Takes the next line whatever its name, split into name and value; `None` at the end.
    pub(crate) fn any_field(&mut self) -> Result<Option<(&'a str, &'a str)>, FormatError> {
        let Some(line) = self.line() else { return Ok(None) };
        line.split_once(' ').map(Some).ok_or_else(|| self.error("a name, a blank and a value were expected"))
    }

    /// Nothing may be left.
    pub(crate) fn end(&mut self) -> Result<(), FormatError> {
        match self.line() {
            None => Ok(()),
            Some(_) => Err(self.error("the content should end before this line")),
        }
    }

    /// What is wrong with the line that was taken last.
    pub(crate) fn error(&self, rule: impl Into<String>) -> FormatError {
        FormatError::line(self.number, rule)
    }

    fn line(&mut self) -> Option<&'a str> {
        self.number = self.number.saturating_add(1);
        if self.rest.is_empty() {
            return None;
        }
        let (line, rest) = self.rest.split_once('\n').unwrap_or((self.rest, ""));
        self.rest = rest;
        Some(line)
    }
}

/// That a content stands in the one form that it has: what has been read of it, written again, is this.
pub(crate) fn in_form(content: &str, form: &str) -> Result<(), FormatError> {
    let mut lines = Lines::new(content);
    for expected in form.lines() {
        if lines.any_field()? != expected.split_once(' ') {
            return Err(lines.error(format!("`{expected}` was expected")));
        }
    }
    lines.end()?;
    if content == form { Ok(()) } else { Err(lines.error("the last line should end with a line feed")) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_counted_as_in_the_file() {
        let mut lines = Lines::new("a 1\nb two words\nc\n");
        assert_eq!(lines.field("a"), Ok("1"));
        assert_eq!(lines.any_field(), Ok(Some(("b", "two words"))));
        assert_eq!(lines.field("c").unwrap_err().to_string(), "line 5: `c` was expected");
        assert_eq!(lines.end(), Ok(()));
        assert_eq!(
            Lines::new("x y\n").end().unwrap_err().to_string(),
            "line 3: the content should end before this line"
        );
        assert!(Lines::new("").field("a").unwrap_err().to_string().contains("`a` was expected, and the content ends"));
    }

    #[test]
    fn a_content_in_another_form_is_refused_by_line() {
        let form = "a 1\nb two words\n";
        assert_eq!(in_form(form, form), Ok(()));
        for (content, message) in [
            ("a 01\nb two words\n", "line 3: `a 1` was expected"),
            ("a 1\nb two  words\n", "line 4: `b two words` was expected"),
            ("a 1\n", "line 4: `b two words` was expected"),
            ("a 1\nb two words\nc 3\n", "line 5: the content should end before this line"),
            ("a 1\nb two words", "line 5: the last line should end with a line feed"),
        ] {
            assert_eq!(in_form(content, form).unwrap_err().to_string(), message);
        }
    }
}
