//! Hexadecimal dumps: lines of an offset, bytes, and the same bytes as characters, as of `xxd`,
//! `hexdump -C`, `od -A x -t x1`, `tcpdump -X`, and Wireshark's hex dump.

use crate::printable::excerpt;

/// Digits of an offset.
const OFFSET_DIGITS: std::ops::RangeInclusive<usize> = 4..=8;

/// Longest dump with repeated lines.
const MAX_LEN: usize = 1024 * 1024;

/// Parses a dump into the bytes of its blocks, each of which begins with offset 0. `None` if the text is
/// none: no line begins with offset 0, or others are before it that have bytes.
///
/// Lines without an offset are allowed before a block, such as the headers of `tcpdump`.
pub(super) fn parse(text: &str) -> Option<Result<Vec<Vec<u8>>, String>> {
    let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
    let start = lines.iter().position(|line| Line::split(line).is_some())?;
    let first = Line::split(lines.get(start)?)?;
    let is_marked = first.is_marked || first.rest.starts_with("  ");
    let is_long = start == 0 && lines.len() > 1;
    if first.offset != 0 || first.rest.trim().is_empty() || !(is_marked || is_long) {
        return None;
    }
    let (mut blocks, mut block): (Vec<Vec<u8>>, Vec<u8>) = (Vec::new(), Vec::new());
    let (mut last, mut is_repeated): (Vec<u8>, bool) = (Vec::new(), false);
    let mut len = 0_usize;
    for (at, line) in lines.iter().enumerate().skip(start) {
        let rule = |rule: &str| Err(format!("line {} of the dump, `{}`: {rule}", at + 1, excerpt(line.trim())));
        if line.trim() == "*" && !last.is_empty() {
            is_repeated = true;
            continue;
        }
        let Some(split) = Line::split(line) else {
            let mut behind = lines.iter().skip(at).filter_map(|line| Line::split(line));
            if behind.next().is_some_and(|next| next.offset == 0) {
                continue;
            }
            return Some(rule("it does not begin with an offset"));
        };
        // `*` stands for lines equal to the last one.
        while std::mem::take(&mut is_repeated) && block.len() + last.len() <= split.offset && len <= MAX_LEN {
            len += last.len();
            block.extend_from_slice(&last);
            is_repeated = true;
        }
        if split.offset == 0 {
            blocks.push(std::mem::take(&mut block));
        } else if split.offset != block.len() && split.octal != Some(block.len()) {
            return Some(rule(&format!("its offset is not that of the next byte, {:04x}", block.len())));
        }
        match of_line(split.rest) {
            Some(of_line) => {
                block.extend_from_slice(&of_line);
                last = of_line;
            }
            None => return Some(rule("behind the offset, it has no pairs of hexadecimal digits")),
        }
    }
    blocks.push(block);
    blocks.retain(|block| !block.is_empty());
    Some(Ok(blocks))
}

/// A line behind its offset.
struct Line<'l> {
    offset: usize,
    /// The offset if its digits are octal, as of `od` without `-A x`.
    octal: Option<usize>,
    /// There is a colon, or 0x.
    is_marked: bool,
    rest: &'l str,
}

impl<'l> Line<'l> {
    fn split(line: &'l str) -> Option<Self> {
        let line = line.trim_start();
        let digits = line.strip_prefix("0x").unwrap_or(line);
        let end = digits.find(|character: char| !character.is_ascii_hexdigit()).unwrap_or(digits.len());
        let (offset, rest) = digits.split_at(end);
        let behind = rest.strip_prefix(':');
        let is_marked = behind.is_some();
        let rest = behind.unwrap_or(rest);
        if !OFFSET_DIGITS.contains(&offset.len()) || !(rest.is_empty() || rest.starts_with([' ', '\t'])) {
            return None;
        }
        let octal = usize::from_str_radix(offset, 8).ok();
        Some(Self { offset: usize::from_str_radix(offset, 16).ok()?, octal, is_marked, rest })
    }
}

/// Bytes of a line, without the characters behind them.
fn of_line(text: &str) -> Option<Vec<u8>> {
    // `hexdump -C` has the characters between bars, which may be characters themselves.
    if let Some(barred) = text.trim_end().strip_suffix('|') {
        let bars = barred.match_indices('|').map(|(at, _)| at);
        let parts = bars.filter_map(|at| Some((pairs(barred.get(..at)?)?, barred.get(at + 1..)?)));
        let found = parts.filter(|(bytes, _)| !bytes.is_empty());
        if let Some((bytes, _)) = { found }.find(|(bytes, characters)| is_characters_of(characters, bytes)) {
            return Some(bytes);
        }
    }
    // Two blanks are before the characters, which are as many as the bytes, and perhaps one more blank
    // in their middle. Two blanks can be in the middle of the bytes, too.
    let columns = text.char_indices().filter(|&(at, _)| text.get(at..).is_some_and(|rest| rest.starts_with("  ")));
    for (at, _) in columns {
        let (before, behind) = text.split_at(at);
        if let Some(bytes) = pairs(before).filter(|bytes| !bytes.is_empty())
            && is_characters_of(behind.trim_start_matches(' '), &bytes)
        {
            return Some(bytes);
        }
        if let Some(bytes) = pairs(before).filter(|bytes| !bytes.is_empty())
            && is_characters_of(behind.get(2..).unwrap_or_default(), &bytes)
        {
            return Some(bytes);
        }
    }
    pairs(text)
}

/// Returns whether a text has these bytes as characters: letters and digits for themselves.
fn is_characters_of(text: &str, bytes: &[u8]) -> bool {
    let is_shown = |text: &str| {
        let mut characters = text.chars();
        let same = bytes.iter().all(|&byte| match characters.next() {
            Some(character) => !byte.is_ascii_alphanumeric() || character == char::from(byte),
            // Blanks at the end of a line are lost in many places.
            None => !byte.is_ascii_graphic(),
        });
        same && characters.next().is_none()
    };
    let middle = text.char_indices().nth(8).map(|(at, _)| at);
    let without_middle = middle.and_then(|at| Some(format!("{}{}", text.get(..at)?, text.get(at + 1..)?)));
    is_shown(text) || without_middle.is_some_and(|text| is_shown(&text))
}

/// Bytes of groups of pairs of digits.
fn pairs(text: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    for group in text.split_ascii_whitespace() {
        let (digits, rest) = group.as_bytes().as_chunks::<2>();
        if !rest.is_empty() {
            return None;
        }
        for pair in digits {
            let pair = std::str::from_utf8(pair).ok().filter(|pair| pair.bytes().all(|b| b.is_ascii_hexdigit()))?;
            bytes.push(u8::from_str_radix(pair, 16).ok()?);
        }
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::parse;

    /// A request and its reply, of 16 and of 21 bytes.
    const FRAMES: &[u8] = b"\x02014603R0001275\x03\x0201460A5F0  DEADBE12\x03";

    #[track_caller]
    fn assert_is_dump(text: &str, bytes: &[u8]) {
        let blocks = parse(text).unwrap().unwrap();
        assert_eq!(blocks.len(), 1, "{text}");
        assert_eq!(blocks.concat().escape_ascii().to_string(), bytes.escape_ascii().to_string(), "{text}");
    }

    #[test]
    fn dumps_of_common_tools_have_the_same_bytes() {
        // xxd
        assert_is_dump(
            "00000000: 0230 3134 3630 3352 3030 3031 3237 3503  .014603R0001275.\n\
             00000010: 0230 3134 3630 4135 4630 2020 4445 4144  .01460A5F0  DEAD\n\
             00000020: 4245 3132 03                             BE12.\n",
            FRAMES,
        );
        // hexdump -C
        assert_is_dump(
            "00000000  02 30 31 34 36 30 33 52  30 30 30 31 32 37 35 03  |.014603R0001275.|\n\
             00000010  02 30 31 34 36 30 41 35  46 30 20 20 44 45 41 44  |.01460A5F0  DEAD|\n\
             00000020  42 45 31 32 03                                    |BE12.|\n00000025\n",
            FRAMES,
        );
        // od -A x -t x1, and od -t x1
        for (second, last, end) in [("000010", "000020", "000025"), ("0000020", "0000040", "0000045")] {
            assert_is_dump(
                &format!(
                    "000000 02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03\n\
                     {second} 02 30 31 34 36 30 41 35 46 30 20 20 44 45 41 44\n{last} 42 45 31 32 03\n{end}\n"
                ),
                FRAMES,
            );
        }
        // Wireshark, with a blank in the middle of the characters.
        assert_is_dump(
            "0000   02 30 31 34 36 30 33 52 30 30 30 31 32 37 35 03   .014603R 0001275.\n\
             0010   02 30 31 34 36 30 41 35 46 30 20 20 44 45 41 44   .01460A5 F0  DEAD\n\
             0020   42 45 31 32 03                                    BE12.\n",
            FRAMES,
        );
        // tcpdump -X
        assert_is_dump(
            "\t0x0000:  0230 3134 3630 3352 3030 3031 3237 3503  .014603R0001275.\n\
             \t0x0010:  0230 3134 3630 4135 4630 2020 4445 4144  .01460A5F0..DEAD\n\
             \t0x0020:  4245 3132 03                             BE12.\n",
            FRAMES,
        );
    }

    #[test]
    fn a_star_stands_for_equal_lines() {
        let dump = "00000000  41 41 41 41 41 41 41 41  41 41 41 41 41 41 41 41  |AAAAAAAAAAAAAAAA|\n*\n\
                    00000040  03                                                |.|\n00000041\n";
        assert_is_dump(dump, &[&[b'A'; 64][..], b"\x03"].concat());
        // A hostile offset.
        assert!(parse("0000: 41\n*\nffffffff: 41").unwrap().is_err());
    }

    #[test]
    fn characters_that_look_like_digits_are_no_bytes() {
        // The characters of a line are pairs of digits: 38 and 39 are `8` and `9`.
        assert_is_dump("00000000: 3839 3839  8989\n", b"8989");
        assert_is_dump("0000  38 39  89\n", b"89");
        assert_is_dump("00000000: 38393839  8989", b"8989");
    }

    #[test]
    fn packets_of_a_dump_begin_with_offset_0() {
        let expected = Ok(vec![b"\x02\x03".to_vec(), b"\x02\x03\x06".to_vec()]);
        assert_eq!(parse("0000  02 03  ..\n\n0000  02 03  ..\n0002  06  .\n"), Some(expected.clone()));
        // Before: `line 1 of the dump … is not hexadecimal`, as no dump.
        let headers = "12:00:00.5 IP 10.0.0.9.4000 > 10.0.0.3.500: Flags [P.], length 2\n\t0x0000:  0203  ..\n\
                       12:00:00.6 IP 10.0.0.3.500 > 10.0.0.9.4000: Flags [P.], length 3\n\t0x0000:  0203  ..\n\
                       \t0x0002:  06  .\n";
        assert_eq!(parse(headers), Some(expected));
    }

    /// Before: 61 62 7C AB for the first, and the last was refused.
    #[test]
    fn bars_can_be_bytes() {
        assert_is_dump("00000000: 6162 7c                                  ab|\n", b"ab|");
        assert_is_dump("00000000: 7c61 627c                                |ab|\n", b"|ab|");
        assert_is_dump("00000000  51 10 7c 02  |Q.|.|\n", b"\x51\x10\x7c\x02");
        assert_is_dump("0000  51 7c 10 7c  Q|.|\n", b"\x51\x7c\x10\x7c");
    }

    #[test]
    fn wrong_lines_of_a_dump_are_named() {
        for (text, rule) in [
            ("0000: 0230\n0004: 31", "line 2 of the dump, `0004: 31`: its offset is not that of the next byte, 0002"),
            ("0000: 0230\nabc", "line 2 of the dump, `abc`: it does not begin with an offset"),
            ("0000: 02 3\n", "line 1 of the dump, `0000: 02 3`: behind the offset"),
        ] {
            let error = parse(text).unwrap().unwrap_err();
            assert!(error.starts_with(rule), "{error} should begin: {rule}");
        }
    }

    #[test]
    fn plain_digits_are_no_dump() {
        for text in
            ["", "00 02 30", "0000 0230", "02303134", "0010: 02", "0000", "00000000:", "0x02, 0x30", "0000:0230"]
        {
            assert!(parse(text).is_none(), "{text}");
        }
    }
}
