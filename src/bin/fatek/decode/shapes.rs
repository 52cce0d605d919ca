//! Bytes in a text of any usual shape: digits with separators, escapes, arrays of programming
//! languages, and hexadecimal dumps.

use super::{dump, hex};
use crate::printable::excerpt;
use crate::traffic::unescape;

/// Parses a text into strings of bytes: one, or each packet of a dump. The error names the place and the
/// rule.
pub(super) fn parse(text: &str) -> Result<Vec<Vec<u8>>, String> {
    if let Some(dump) = dump::parse(text) {
        return dump;
    }
    let bytes = if is_escaped(text) {
        escaped(text)
    } else {
        match arrays(text) {
            Some(digits) => hex::parse(&digits?),
            None => hex::parse(text),
        }
    };
    Ok(vec![bytes?])
}

/// Joins arguments to one text. Each one with escapes is a line of its own, since a blank would be a byte.
pub(super) fn join(arguments: &[String]) -> String {
    let separator = if arguments.iter().any(|argument| is_escaped(argument)) { "\n" } else { " " };
    arguments.join(separator)
}

fn is_escaped(text: &str) -> bool {
    text.contains(r"\x") || text.contains(r"\0")
}

/// Parses escapes, in quotes or without, of each line without its end. Between escapes without quotes,
/// separators are allowed.
fn escaped(text: &str) -> Result<Vec<u8>, String> {
    if let Some(strings) = quoted(text) {
        return strings.iter().map(|string| unescape(string)).collect::<Result<Vec<_>, _>>().map(|all| all.concat());
    }
    let text = text.trim();
    let digits = text.replace(r"\x", " 0x");
    // `\x02 \x30` has separators only; in `\x0201 A`, the blank is a byte.
    if hex::parse(&digits).is_ok() && text.split_ascii_whitespace().all(|word| word.starts_with(r"\x")) {
        let is_only_escapes =
            text.split(r"\x").skip(1).all(|part| part.trim_matches([' ', ',', '\t', '\n']).len() == 2);
        if is_only_escapes {
            return hex::parse(&digits);
        }
    }
    let lines = text.lines().map(|line| line.trim_matches([' ', '\t', '\r']));
    let bytes = lines.map(|line| match quoted(line) {
        Some(strings) => strings.iter().map(|string| unescape(string)).collect::<Result<Vec<_>, _>>(),
        None => unescape(line).map(|bytes| vec![bytes]),
    });
    bytes.collect::<Result<Vec<_>, _>>().map(|all| all.concat().concat())
}

/// Contents of strings in double or single quotes, with nothing else between them than blanks, `+`,
/// `;` and `\` at the end of a line. A `b` may stand before each.
fn quoted(text: &str) -> Option<Vec<String>> {
    let mut strings = Vec::new();
    let mut rest = text.trim_start();
    while !rest.is_empty() {
        let string = rest.strip_prefix('b').unwrap_or(rest);
        let quote = string.chars().next().filter(|quote| matches!(quote, '"' | '\''))?;
        let mut is_escaped = false;
        let end = string.char_indices().skip(1).find(|&(_, character)| {
            let ends = character == quote && !is_escaped;
            is_escaped = character == '\\' && !is_escaped;
            ends
        });
        let (end, _) = end?;
        strings.push(string.get(1..end)?.to_owned());
        rest = string.get(end + 1..)?.trim_start_matches(|c: char| c.is_whitespace() || matches!(c, '+' | '\\' | ';'));
    }
    (!strings.is_empty()).then_some(strings)
}

/// Digits of the arrays of a program: the content of each `{…}`, or of each `[…]` with nothing but digits
/// and separators, without comments. `None` if there is no array. The error is that of a number without
/// 0x, which is a decimal one in all these languages.
fn arrays(text: &str) -> Option<Result<String, String>> {
    let code = without_comments(text);
    let contents = |open, close| -> Vec<String> {
        let begun = code.split(open).skip(1);
        begun.filter_map(|part: &str| part.split_once(close)).map(|(content, _)| content.to_owned()).collect()
    };
    let is_digits = |content: &String| {
        content.chars().all(|c| c.is_ascii_hexdigit() || c.is_whitespace() || matches!(c, 'x' | 'X' | ',' | '\''))
    };
    let braces = contents('{', '}');
    let arrays = if braces.is_empty() { contents('[', ']') } else { braces.clone() };
    let is_array = !arrays.is_empty() && (!braces.is_empty() || arrays.iter().all(is_digits));
    if !is_array {
        return None;
    }
    let digits = arrays.join(" ").replace('\'', " ");
    let mut items = digits.split(|c: char| c == ',' || c.is_whitespace()).filter(|item| !item.is_empty());
    let decimal = items.find(|item| !item.starts_with("0x") && !item.starts_with("0X"));
    let rule = |item| format!("`{}` in an array: bytes of an array are written as 0x02", excerpt(item));
    Some(decimal.map(rule).map_or(Ok(digits.clone()), Err))
}

/// The text without `/* … */`, and without `//` to the end of its line.
fn without_comments(text: &str) -> String {
    let mut code = String::with_capacity(text.len());
    let mut rest = text;
    while let Some((before, comment)) = rest.split_once("/*") {
        code.push_str(before);
        code.push(' ');
        rest = comment.split_once("*/").map_or("", |(_, behind)| behind);
    }
    code.push_str(rest);
    code.lines().map(|line| line.split_once("//").map_or(line, |(code, _)| code)).collect::<Vec<_>>().join("\n")
}

#[cfg(test)]
mod tests {
    use super::parse;

    const FRAME: &[u8] = b"\x02014603R0001275\x03";

    #[test]
    fn every_usual_shape_is_the_same_frame() {
        for text in [
            "0230313436303352303030313237 3503",
            "02:30:31:34:36:30:33:52:30:30:30:31:32:37:35:03",
            "0x02, 0x30, 0x31, 0x34, 0x36, 0x30, 0x33, 0x52, 0x30, 0x30, 0x30, 0x31, 0x32, 0x37, 0x35, 0x03",
            r"\x02014603R0001275\x03",
            r#""\x02014603R0001275\x03""#,
            r"b'\x02014603R0001275\x03'",
            r"\x02 \x30\x31 \x34,\x36 \x30\x33\x52\x30\x30\x30\x31\x32\x37\x35\x03",
            "\"\\x02\\x30\\x31\\x34\\x36\\x30\\x33\\x52\" \\\n\"\\x30\\x30\\x30\\x31\\x32\\x37\\x35\\x03\"",
            "unsigned char f[16] = { /* a {frame} */\n 0x02, 0x30, 0x31, 0x34, 0x36, 0x30, 0x33, 0x52, // of 16\n \
             0x30, 0x30, 0x30, 0x31, 0x32, 0x37, 0x35, 0x03 };",
            "[0x02, 0x30, 0x31, 0x34, 0x36, 0x30, 0x33, 0x52, 0x30, 0x30, 0x30, 0x31, 0x32, 0x37, 0x35, 0x03]",
            "char a[] = {\n0x02, 0x30, 0x31, 0x34, 0x36, 0x30, 0x33, 0x52 };\nchar b[] = {\n0x30, 0x30, 0x30, 0x31, \
             0x32, 0x37, 0x35, 0x03 };",
            "00000000: 0230 3134 3630 3352 3030 3031 3237 3503  .014603R0001275.",
        ] {
            assert_eq!(parse(text).map(|strings| strings.concat()).as_deref(), Ok(FRAME), "{text}");
        }
    }

    #[test]
    fn wrong_texts_are_refused_with_a_rule() {
        for (text, rule) in [
            (r"\x0201\q", r"`\q` is no escape"),
            // Before: the bytes 00 30 32, and 48 49 52.
            (r"\002014603", r"`\0` is followed by a digit"),
            ("{ 48, 49, 52 }", "`48` in an array: bytes of an array are written as 0x02"),
            ("[2, 48]", "`2` in an array"),
            ("{ 0x02, 0xZZ }", "is not a hexadecimal digit"),
            ("{}", "has no bytes"),
            ("[31m 0x02", "`[31m 0x02` is not hexadecimal: character 1"),
            ("2026-11-29 hello", "'-', is not a hexadecimal digit"),
            ("", "has no bytes"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.contains(rule), "{text}: {error} should say: {rule}");
        }
    }

    /// Before: a line feed or a blank between them was a byte of no frame.
    #[test]
    fn escaped_frames_of_lines_and_arguments_are_parsed_each() {
        let frame = r"\x02014603R0001275\x03".to_owned();
        let quoted = format!("\"{frame}\"");
        for [first, second] in [[&frame, &frame], [&quoted, &frame], [&frame, &quoted], [&quoted, &quoted]] {
            let joined = super::join(&[first.clone(), second.clone()]);
            for text in [joined, format!("{first}\r\n\r\n {second} \n")] {
                assert_eq!(parse(&text), Ok(vec![[FRAME, FRAME].concat()]), "{text}");
            }
        }
        assert_eq!(super::join(&["02".to_owned(), "30".to_owned()]), "02 30");
    }

    proptest::proptest! {
        #[test]
        fn any_text_is_parsed_or_refused(text in "\\PC{0,80}", digits in "[0-9a-fx\\\\{}\\[\\]\"'| :\n/*]{0,80}") {
            let _ = parse(&text);
            let _ = parse(&digits);
        }
    }
}
