//! Hexadecimal digits.
//!
//! The functions for words handle all digits at once, without tables and branches, so that the
//! compiler can vectorise loops over them.

/// The digit of 0 to 15, upper case.
pub(crate) fn digit(value: u8) -> u8 {
    match value {
        0..=9 => b'0'.wrapping_add(value),
        _ => b'A'.wrapping_add(value.wrapping_sub(10)),
    }
}

/// The two digits of a byte.
pub(crate) fn of_byte(byte: u8) -> [u8; 2] {
    [digit(byte >> 4), digit(byte & 0x0F)]
}

/// The four digits of a word.
pub(crate) fn of_word(word: u16) -> [u8; 4] {
    let word = u32::from(word);
    // One digit a byte, the most significant digit in the least significant byte, which is stored
    // first.
    let values = word >> 12 | word & 0x0F00 | (word & 0x00F0) << 12 | (word & 0x000F) << 24;
    // Digits from 10 on overflow 4 bits when 6 is added. In ASCII, `A` is 7 beyond the character
    // after `9`.
    let letters = values.wrapping_add(0x0606_0606) >> 4 & 0x0101_0101;
    values.wrapping_add(0x3030_3030).wrapping_add(letters.wrapping_mul(7)).to_le_bytes()
}

/// The eight digits of a double word.
pub(crate) fn of_dword(dword: u32) -> [u8; 8] {
    let [h1, h0, l1, l0] = dword.to_be_bytes();
    let ([a, b, c, d], [e, f, g, h]) = (of_word(u16::from_be_bytes([h1, h0])), of_word(u16::from_be_bytes([l1, l0])));
    [a, b, c, d, e, f, g, h]
}

/// Returns whether all characters are digits, of either case.
pub(crate) fn are_digits(characters: &[u8]) -> bool {
    // No early exit: nearly always all are digits, and a plain loop is vectorised.
    characters.iter().fold(true, |all, character| all & character.is_ascii_hexdigit())
}

/// The value of a digit; unspecified for other characters.
pub(crate) fn value(digit: u8) -> u8 {
    // Letters have bit 6, and their low four bits count from 1.
    let letter = digit >> 6 & 1;
    (digit & 0x0F).wrapping_add(letter.wrapping_mul(9)) & 0x0F
}

/// The byte of two digits.
pub(crate) fn byte([high, low]: [u8; 2]) -> u8 {
    value(high) << 4 | value(low)
}

/// The word of four digits.
pub(crate) fn word(digits: [u8; 4]) -> u16 {
    let digits = u32::from_le_bytes(digits);
    let letters = digits >> 6 & 0x0101_0101;
    let values = (digits & 0x0F0F_0F0F).wrapping_add(letters.wrapping_mul(9));
    let word = (values & 0x000F) << 12 | values & 0x0F00 | values >> 12 & 0x00F0 | values >> 24 & 0x000F;
    let [low, high, ..] = word.to_le_bytes();
    u16::from_le_bytes([low, high])
}

/// The double word of eight digits.
pub(crate) fn dword([a, b, c, d, e, f, g, h]: [u8; 8]) -> u32 {
    u32::from(word([a, b, c, d])) << 16 | u32::from(word([e, f, g, h]))
}

/// Bytes as upper-case digits, two each.
pub(crate) fn encode(bytes: &[u8]) -> String {
    bytes.iter().flat_map(|&byte| of_byte(byte)).map(char::from).collect()
}

/// The bytes of upper-case digits, two each; `None` for anything else.
///
/// Lower case is refused, so that bytes have one form in a file.
pub(crate) fn decode(digits: &str) -> Option<Vec<u8>> {
    let pairs = digits.as_bytes().chunks(2).map(|pair| match *pair {
        [high, low] if [high, low].iter().all(|digit| matches!(digit, b'0'..=b'9' | b'A'..=b'F')) => {
            Some(byte([high, low]))
        }
        _ => None,
    });
    pairs.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_have_the_digits_of_the_standard_library() {
        for word_ in 0..=u16::MAX {
            let upper = format!("{word_:04X}");
            assert_eq!(of_word(word_), upper.as_bytes(), "{upper}");
            assert_eq!(word(of_word(word_)), word_, "{upper}");
            assert_eq!(word(format!("{word_:04x}").as_bytes().try_into().unwrap()), word_, "{upper} in lower case");
        }
    }

    #[test]
    fn bytes_have_the_digits_of_the_standard_library() {
        for byte_ in 0..=u8::MAX {
            assert_eq!(of_byte(byte_), format!("{byte_:02X}").as_bytes());
            assert_eq!(byte(of_byte(byte_)), byte_);
        }
    }

    #[test]
    fn double_words_have_the_digits_of_the_standard_library() {
        for n in 0..=u16::MAX {
            let dword_ = u32::from(n).wrapping_mul(0x9E37_79B9);
            assert_eq!(of_dword(dword_), format!("{dword_:08X}").as_bytes());
            assert_eq!(dword(of_dword(dword_)), dword_);
        }
    }

    #[test]
    fn text_is_pairs_of_upper_case_digits() {
        assert_eq!(encode(&[0, 0xFF, 0xA5]), "00FFA5");
        assert_eq!(decode("00FFA5"), Some(vec![0, 0xFF, 0xA5]));
        assert_eq!(decode(""), Some(vec![]));
        for bad in ["0", "0G", "ff", "+1", " 1", "é"] {
            assert_eq!(decode(bad), None, "{bad}");
        }
    }

    #[test]
    fn digits_are_those_of_the_standard_library() {
        for character in 0..=u8::MAX {
            let expected = char::from(character).to_digit(16);
            assert_eq!(are_digits(&[character]), expected.is_some(), "{character:02X}");
            if let Some(expected) = expected {
                assert_eq!(u32::from(value(character)), expected, "{character:02X}");
            }
            for place in 0..40 {
                let mut characters = *b"0123456789ABCDEFabcdef0123456789ABCDEFab";
                characters[place] = character;
                assert_eq!(are_digits(&characters), expected.is_some(), "{character:02X} at {place}");
            }
        }
    }
}
