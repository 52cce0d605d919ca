//! Parser of hexadecimal bytes: `0246`, `02 46`, `02:46`, `0x02, 0x46`.

use crate::printable::excerpt;

/// Parses groups of digits, each a number of whole bytes. Errors name the character, from 1 on.
pub(super) fn parse(text: &str) -> Result<Vec<u8>, String> {
    let mut bytes = Vec::new();
    let mut high = None;
    let mut previous = ' ';
    for (position, character) in (1..).zip(text.chars()) {
        let rule =
            |rule: &str| format!("`{}` is not hexadecimal: character {position}, {character:?}, {rule}", excerpt(text));
        match (character.to_digit(16).and_then(|digit| u8::try_from(digit).ok()), high) {
            (Some(digit), None) => high = Some(digit),
            (Some(digit), Some(first)) => {
                bytes.push(first << 4 | digit);
                high = None;
            }
            // The 0 of 0x is not a digit of the byte.
            (None, Some(0)) if matches!(character, 'x' | 'X') && previous == '0' => high = None,
            (None, Some(_)) if is_separator(character) => {
                return Err(rule("follows a single digit; a byte has two"));
            }
            (None, None) if is_separator(character) => {}
            (None, _) => return Err(rule("is not a hexadecimal digit; separators are space, comma, colon and 0x")),
        }
        previous = character;
    }
    match high {
        Some(_) => Err(format!("`{}` is not hexadecimal: it ends with a single digit; a byte has two", excerpt(text))),
        None if bytes.is_empty() => {
            Err(format!("`{}` has no bytes: expected two hexadecimal digits per byte", excerpt(text)))
        }
        None => Ok(bytes),
    }
}

fn is_separator(character: char) -> bool {
    character.is_whitespace() || matches!(character, ',' | ':')
}

#[cfg(test)]
mod tests {
    use super::parse;

    #[test]
    fn all_separators_are_accepted() {
        for text in ["02aBff", "02 ab FF", "02:AB:FF", "0x02,0xAB, 0XFF", "02,ab\tff\n", "0x02abff", "  02ab ff "] {
            assert_eq!(parse(text), Ok(vec![0x02, 0xAB, 0xFF]), "{text}");
        }
        assert_eq!(parse("00"), Ok(vec![0]));
    }

    #[test]
    fn errors_name_the_position_and_the_rule() {
        for (text, rule) in [
            ("02 4G", "character 5, 'G', is not a hexadecimal digit"),
            ("02 4 6", "character 5, ' ', follows a single digit"),
            ("02-46", "character 3, '-', is not a hexadecimal digit"),
            ("1x46", "character 2, 'x', is not a hexadecimal digit"),
            ("0x00x0", "character 5, 'x', is not a hexadecimal digit"),
            ("x46", "character 1, 'x', is not a hexadecimal digit"),
            ("02 46 5", "it ends with a single digit"),
            ("", "has no bytes"),
            (" : ", "has no bytes"),
            ("02 é", "character 4, 'é', is not a hexadecimal digit"),
        ] {
            let error = parse(text).unwrap_err();
            assert!(error.starts_with(&format!("`{text}`")), "{error}");
            assert!(error.contains(rule), "{error} should say: {rule}");
        }
    }
}
