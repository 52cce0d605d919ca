//! Texts with escaped bytes, as Rust, C and Python write them: `\x02014603R0001275\x03`.

/// Parses a text without quotes: escapes, and characters of ASCII for themselves. The error is the
/// rule that it breaks.
pub(crate) fn unescape(text: &str) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::with_capacity(text.len());
    let mut characters = text.chars();
    while let Some(character) = characters.next() {
        if character != '\\' {
            let byte = u8::try_from(character).ok().filter(u8::is_ascii);
            bytes.push(byte.ok_or_else(|| format!("{character:?} is no character of ASCII"))?);
            continue;
        }
        bytes.push(match characters.next() {
            Some('x') => {
                let mut digit = || characters.next().and_then(|digit| digit.to_digit(16)).map(|digit| digit as u8);
                let (high, low) = (digit(), digit());
                let (high, low) = high.zip(low).ok_or("`\\x` is not followed by two hexadecimal digits")?;
                high << 4 | low
            }
            Some('n') => b'\n',
            Some('r') => b'\r',
            Some('t') => b'\t',
            // Octal in C, and `\0` with a digit behind it in other languages.
            Some('0') if characters.as_str().starts_with(|next: char| next.is_ascii_digit()) => {
                return Err("`\\0` is followed by a digit, which C reads as octal: write \\x02".to_owned());
            }
            Some('0') => 0,
            Some(quoted @ ('\\' | '"' | '\'')) => quoted as u8,
            Some(other) => {
                return Err(format!("`\\{}` is no escape; bytes are written as \\x02", other.escape_default()));
            }
            None => return Err("it ends with a single `\\`".to_owned()),
        });
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::unescape;

    #[test]
    fn escapes_and_characters_are_bytes() {
        for (text, bytes) in [
            (r"\x02014603R0001275\x03", &b"\x02014603R0001275\x03"[..]),
            (r"Q\x10\x00\n\x01N\xaa\xFF", b"Q\x10\x00\n\x01N\xaa\xFF"),
            (r#"\\\"\'\t\r\0"#, b"\\\"'\t\r\0"),
            ("", b""),
        ] {
            assert_eq!(unescape(text).as_deref(), Ok(bytes), "{text}");
            assert_eq!(unescape(&bytes.escape_ascii().to_string()).as_deref(), Ok(bytes), "{text}");
        }
    }

    #[test]
    fn wrong_escapes_are_named() {
        for (text, rule) in [
            (r"a\x0", "two hexadecimal digits"),
            (r"\xg0", "two hexadecimal digits"),
            (r"\q", r"`\q` is no escape"),
            (r"\002", r"`\0` is followed by a digit"),
            ("\\", "ends with a single"),
            ("é", "'é' is no character of ASCII"),
        ] {
            let error = unescape(text).unwrap_err();
            assert!(error.contains(rule), "{error} should say: {rule}");
        }
    }
}
