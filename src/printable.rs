//! Texts of files, users and PLCs in messages: control characters are escaped, long texts cut.
//!
//! Also a module of the command line, so that both escape the same characters.

use std::fmt::{self, Write};

/// Characters of a longer text that are shown at its beginning and at its end.
const HEAD: usize = 140;
const TAIL: usize = 60;

/// Displays a text of any origin, as [`printable`] or [`excerpt`].
#[derive(Clone, Copy, Debug)]
pub(crate) struct Printable<'t> {
    text: &'t str,
    is_cut: bool,
}

/// Displays a text of any length on one line. Characters that control a terminal or are invisible
/// are escaped: line feeds, ESC, bidirectional controls.
#[cfg_attr(not(test), allow(dead_code, reason = "the library quotes excerpts only"))]
pub(crate) fn printable(text: &str) -> Printable<'_> {
    Printable { text, is_cut: false }
}

/// Displays a text as [`printable`] does; of more than 200 characters, the first 140 and the last
/// 60.
pub(crate) fn excerpt(text: &str) -> Printable<'_> {
    Printable { text, is_cut: true }
}

impl fmt::Display for Printable<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let count = if self.is_cut { self.text.chars().count() } else { 0 };
        if count <= HEAD.saturating_add(TAIL) {
            return self.text.chars().try_for_each(|character| write_escaped(f, character));
        }
        let left_out = count.saturating_sub(HEAD).saturating_sub(TAIL);
        self.text.chars().take(HEAD).try_for_each(|character| write_escaped(f, character))?;
        write!(f, " ...({left_out} more)... ")?;
        self.text.chars().skip(HEAD.saturating_add(left_out)).try_for_each(|character| write_escaped(f, character))
    }
}

fn write_escaped(f: &mut fmt::Formatter<'_>, character: char) -> fmt::Result {
    match character {
        '\0' => f.write_str("\\0"),
        '\n' => f.write_str("\\n"),
        '\r' => f.write_str("\\r"),
        '\t' => f.write_str("\\t"),
        _ if is_unprintable(character) => write!(f, "{}", character.escape_unicode()),
        _ => f.write_char(character),
    }
}

/// Returns whether a character controls a terminal or the direction of text, or is invisible.
pub(crate) fn is_unprintable(character: char) -> bool {
    character.is_control()
        || matches!(
            character,
            '\u{AD}' | '\u{61C}' | '\u{180E}' | '\u{200B}'..='\u{200F}' | '\u{2028}'..='\u{202E}'
                | '\u{2060}'..='\u{206F}' | '\u{FEFF}' | '\u{FFF9}'..='\u{FFFB}' | '\u{E0000}'..='\u{E007F}'
        )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn controls_and_invisible_characters_are_escaped() {
        for (text, shown) in [
            ("plain \\ text, ä 中 é", "plain \\ text, ä 中 é"),
            ("a\x1b[31mb\x07", "a\\u{1b}[31mb\\u{7}"),
            ("two\nlines\r\t.", "two\\nlines\\r\\t."),
            ("\u{9b}2J \u{7f}", "\\u{9b}2J \\u{7f}"),
            ("gnp\u{202e}.exe\u{2066}\u{2028}", "gnp\\u{202e}.exe\\u{2066}\\u{2028}"),
            ("\u{feff}\u{200b}\0", "\\u{feff}\\u{200b}\\0"),
        ] {
            assert_eq!(printable(text).to_string(), shown);
            assert_eq!(excerpt(text).to_string(), shown);
        }
    }

    #[test]
    fn an_excerpt_has_the_ends_of_a_long_text() {
        let whole = "x".repeat(200);
        assert_eq!(excerpt(&whole).to_string(), whole);
        let long = format!("{}{}{}", "a".repeat(140), "b".repeat(1_000_000), "é".repeat(60));
        let expected = format!("{} ...(1000000 more)... {}", "a".repeat(140), "é".repeat(60));
        assert_eq!(excerpt(&long).to_string(), expected);
        assert_eq!(printable(&long).to_string(), long);
    }

    proptest::proptest! {
        #[test]
        fn no_text_is_shown_raw_or_at_length(text in "(\\PC|[\\x00-\\x1f\\x7f-\\xa0\\u202e]){0,400}") {
            let shown = excerpt(&text).to_string();
            proptest::prop_assert!(!shown.chars().any(is_unprintable), "{}", shown);
            // The longest escape has 9 characters.
            let length = shown.chars().count();
            proptest::prop_assert!(length <= 200 * 9 + 40, "{}", length);
        }
    }
}
