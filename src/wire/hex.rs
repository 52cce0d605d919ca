//! Hexadecimal digits and what they stand for.
//!
//! All digits of a word at once, without tables and branches: of a loop over this the compiler makes vector
//! instructions.

/// The digit of 0 to 15, upper case.
pub(super) fn digit(value: u8) -> u8 {
    match value {
        0..=9 => b'0'.wrapping_add(value),
        _ => b'A'.wrapping_add(value.wrapping_sub(10)),
    }
}

/// The two digits of a byte.
pub(super) fn of_byte(byte: u8) -> [u8; 2] {
    [digit(byte >> 4), digit(byte & 0x0F)]
}

/// The four digits of a word.
pub(super) fn of_word(word: u16) -> [u8; 4] {
    let word = u32::from(word);
    // Four bits a byte, the highest four in the lowest byte, which goes first.
    let values = word >> 12 | word & 0x0F00 | (word & 0x00F0) << 12 | (word & 0x000F) << 24;
    // From 10 on, 6 more are over 15. Letters stand 7 behind the place where digits would go on.
    let letters = values.wrapping_add(0x0606_0606) >> 4 & 0x0101_0101;
    values.wrapping_add(0x3030_3030).wrapping_add(letters.wrapping_mul(7)).to_le_bytes()
}

/// The eight digits of a double.
pub(super) fn of_double(double: u32) -> [u8; 8] {
    let [h1, h0, l1, l0] = double.to_be_bytes();
    let ([a, b, c, d], [e, f, g, h]) = (of_word(u16::from_be_bytes([h1, h0])), of_word(u16::from_be_bytes([l1, l0])));
    [a, b, c, d, e, f, g, h]
}

/// Whether all of them are digits, of either case.
pub(super) fn are_digits(characters: &[u8]) -> bool {
    // Without a way out in the middle: nearly always all are.
    characters.iter().fold(true, |all, character| all & character.is_ascii_hexdigit())
}

/// What a digit stands for; of anything else, any value.
pub(super) fn value(digit: u8) -> u8 {
    // Letters have this bit, and their lowest four count from 1.
    let letter = digit >> 6 & 1;
    (digit & 0x0F).wrapping_add(letter.wrapping_mul(9)) & 0x0F
}

/// What two digits stand for.
pub(super) fn byte([high, low]: [u8; 2]) -> u8 {
    value(high) << 4 | value(low)
}

/// What four digits stand for.
pub(super) fn word(digits: [u8; 4]) -> u16 {
    let digits = u32::from_le_bytes(digits);
    let letters = digits >> 6 & 0x0101_0101;
    let values = (digits & 0x0F0F_0F0F).wrapping_add(letters.wrapping_mul(9));
    let word = (values & 0x000F) << 12 | values & 0x0F00 | values >> 12 & 0x00F0 | values >> 24 & 0x000F;
    let [low, high, ..] = word.to_le_bytes();
    u16::from_le_bytes([low, high])
}

/// What eight digits stand for.
pub(super) fn double([a, b, c, d, e, f, g, h]: [u8; 8]) -> u32 {
    u32::from(word([a, b, c, d])) << 16 | u32::from(word([e, f, g, h]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_words_have_the_digits_of_the_standard_library_and_back() {
        for word_ in 0..=u16::MAX {
            let upper = format!("{word_:04X}");
            assert_eq!(of_word(word_), upper.as_bytes(), "{upper}");
            assert_eq!(word(of_word(word_)), word_, "{upper}");
            assert_eq!(word(format!("{word_:04x}").as_bytes().try_into().unwrap()), word_, "{upper} in lower case");
        }
    }

    #[test]
    fn all_bytes_have_the_digits_of_the_standard_library_and_back() {
        for byte_ in 0..=u8::MAX {
            assert_eq!(of_byte(byte_), format!("{byte_:02X}").as_bytes());
            assert_eq!(byte(of_byte(byte_)), byte_);
        }
    }

    #[test]
    fn doubles_have_the_digits_of_the_standard_library_and_back() {
        for n in 0..=u16::MAX {
            let double_ = u32::from(n).wrapping_mul(0x9E37_79B9);
            assert_eq!(of_double(double_), format!("{double_:08X}").as_bytes());
            assert_eq!(double(of_double(double_)), double_);
        }
    }

    #[test]
    fn all_characters_are_the_digits_that_the_standard_library_takes() {
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
