//! CRC-16/MODBUS without tables: a table that takes 16 bytes a step has 8 KiB, which is a quarter of
//! the processor's first-level cache.
//!
//! The bytes are a polynomial over GF(2) with the first bit as the highest power. The CRC is this
//! polynomial times `x^16` modulo `P`, with the first 16 bits inverted. The first bit is the lowest
//! one of its byte. So in a little-endian word a shift to the right multiplies by a power of `x`.
//!
//! `P = x^16 + x^15 + x^2 + 1` is `(x + 1) * Q`, with `Q = x^15 + x + 1`.
//!
//! - Modulo `x + 1` the remainder is the parity of all bits.
//! - Modulo `Q`, `x^(15 * n) = x^n + 1` for each `n` that is a power of two, because squaring is linear over GF(2).
//!   With `n = 64`, a word is added to those 14 and 15 places behind it, so that 15 words are left
//!   of any number. With `n` of 32, 16 and 8, they become 8, 4 and 2 words, and with 4, 2 and 1 the
//!   15 bits of the remainder.
//!
//! Both remainders give the one modulo `P`.

/// CRC-16/MODBUS of these bytes.
pub(super) fn checksum(bytes: &[u8]) -> u16 {
    match bytes.len() {
        // The inverted bits are those of the power `x^16`, in part or all.
        0 => 0xFFFF,
        1 => of_2(Folded::new(bytes)) ^ 0x00FF,
        2..=16 => of_2(Folded::new(bytes)),
        17..=32 => of_4(Folded::new(bytes)),
        33..=64 => of_8(Folded::new(bytes)),
        _ => of_15(fold(bytes)),
    }
}

/// Bytes as the last ones of `N` words, the first 16 bits inverted, and the exclusive or of the
/// words before that. The inverted bits do not change the parity.
struct Folded<const N: usize> {
    words: [u64; N],
    sum: u64,
}

/// Words of a longer message before it is folded further.
const WORDS: usize = 15;
const BLOCK: usize = 8 * WORDS;

impl<const N: usize> Folded<N> {
    #[inline]
    fn new(bytes: &[u8]) -> Self {
        let (odd, whole) = bytes.as_rchunks();
        let mut words = [0; N];
        let mut places = words.iter_mut().rev();
        for (bytes, place) in whole.iter().rev().zip(&mut places) {
            *place = u64::from_le_bytes(*bytes);
        }
        if let (Some(place), false) = (places.next(), odd.is_empty()) {
            let shift = 64 - 8 * odd.len();
            *place = match bytes.first_chunk() {
                Some(word) => u64::from_le_bytes(*word) << shift,
                None => odd.iter().rev().fold(0, |word, &byte| word << 8 | u64::from(byte)) << shift,
            };
        }
        let sum = sum(&words);
        let unused = 8 * N - bytes.len();
        let masks = inverted(unused % 8);
        for (word, mask) in words.iter_mut().skip(unused / 8).zip(masks) {
            *word ^= mask;
        }
        Self { words, sum }
    }
}

/// Folds more than 64 bytes.
fn fold(bytes: &[u8]) -> Folded<WORDS> {
    // The first word may be incomplete.
    let begin = (bytes.len() - 1) % 8 + 1;
    let (Some((head, tail)), Some(first)) = (bytes[begin..].split_first_chunk(), bytes.first_chunk()) else {
        return Folded::new(bytes);
    };
    let head: &[u8; BLOCK - 8] = head;
    let mut words = [0; WORDS];
    words[0] = u64::from_le_bytes(*first) << (64 - 8 * begin);
    words[1..].copy_from_slice(&words_of::<{ WORDS - 1 }>(head));
    let mut total = sum(&words);
    let [to_first, to_second] = inverted(8 - begin);
    (words[0], words[1]) = (words[0] ^ to_first, words[1] ^ to_second);

    let (blocks, rest) = tail.as_chunks::<BLOCK>();
    for block in blocks {
        let mut next: [u64; WORDS] = words_of(block);
        total ^= sum(&next);
        for at in 0..WORDS - 1 {
            next[at] ^= words[at] ^ words[at + 1];
        }
        next[13] ^= words[0];
        next[14] ^= words[14] ^ words[0];
        words = next;
    }
    let (rest, _) = rest.as_chunks();
    if !rest.is_empty() {
        let mut all = [0; 2 * WORDS];
        all[..WORDS].copy_from_slice(&words);
        for (at, word) in rest.iter().enumerate() {
            let word = u64::from_le_bytes(*word);
            total ^= word;
            all[at + 15] = word ^ all[at];
            all[at + 14] ^= all[at];
        }
        words.copy_from_slice(&all[rest.len()..rest.len() + WORDS]);
    }
    Folded { words, sum: total }
}

/// With `x^480 = x^32 + 1`.
#[inline]
fn of_15(Folded { words, sum }: Folded<WORDS>) -> u16 {
    let mut low = [0; 8];
    low.copy_from_slice(&words[7..]);
    for at in 0..7 {
        low[at] ^= words[at] ^ words[at] << 32;
        low[at + 1] ^= words[at] >> 32;
    }
    of_8(Folded { words: low, sum })
}

/// With `x^240 = x^16 + 1`.
#[inline]
fn of_8(Folded { words, sum }: Folded<8>) -> u16 {
    let before = |word: u64| word << 32 ^ word << 48;
    let behind = |word: u64| word >> 32 ^ word >> 16;
    let [a, b, c, d, e, f, g, h] = words;
    let d = d ^ before(a);
    let words = [e ^ behind(a) ^ before(b), f ^ behind(b) ^ before(c), g ^ behind(c) ^ before(d), h ^ behind(d)];
    of_4(Folded { words, sum })
}

/// With `x^120 = x^8 + 1`.
#[inline]
fn of_4(Folded { words, sum }: Folded<4>) -> u16 {
    let before = |word: u64| word << 48 ^ word << 56;
    let behind = |word: u64| word >> 16 ^ word >> 8;
    let [a, b, c, d] = words;
    let b = b ^ before(a);
    of_2(Folded { words: [c ^ behind(a) ^ before(b), d ^ behind(b)], sum })
}

/// With `x^60 = x^4 + 1`, `x^30 = x^2 + 1` and `x^15 = x + 1`.
#[inline]
fn of_2(Folded { words: [a, b], sum }: Folded<2>) -> u16 {
    let overflow = a << 56 ^ a << 60;
    let word = b ^ a >> 8 ^ a >> 4 ^ overflow >> 8 ^ overflow >> 4;

    let high = word & LOW_34;
    let shifted = high << 30 ^ high << 28;
    let overflow = shifted & LOW_34;
    let bits = (word ^ shifted ^ overflow << 30 ^ overflow << 28) >> 34;

    let high = bits & 0x7FFF;
    let overflow = high & 1;
    let remainder = bits >> 15 ^ high ^ high >> 1 ^ overflow << 14 ^ overflow << 13;

    // Times x^16, which is x^2 + x.
    let product = remainder ^ remainder << 1;
    let overflow = product & 3;
    let modulo_q = product >> 2 ^ overflow << 12 ^ overflow << 13;

    // The remainder modulo P is this one or this one plus Q, by the parity of the bits.
    let odd = (sum ^ modulo_q).count_ones() & 1 == 1;
    let crc = modulo_q << 1 ^ if odd { Q } else { 0 };
    let [low, high, ..] = crc.to_le_bytes();
    u16::from_le_bytes([low, high])
}

const LOW_34: u64 = (1 << 34) - 1;

/// `Q` with the highest power as the lowest bit, `x^15`.
const Q: u64 = 0xC001;

/// The inverted bits of two words, of which the first has this many bytes before the message.
#[inline]
fn inverted(unused: usize) -> [u64; 2] {
    let first = 0xFFFF << (8 * unused);
    [first, if unused == 7 { 0x00FF } else { 0 }]
}

#[inline]
fn sum<const N: usize>(words: &[u64; N]) -> u64 {
    words.iter().fold(0, |sum, word| sum ^ word)
}

#[inline]
fn words_of<const N: usize>(bytes: &[u8]) -> [u64; N] {
    let mut words = [0; N];
    let (all, _) = bytes.as_chunks();
    for (place, word) in words.iter_mut().zip(all) {
        *place = u64::from_le_bytes(*word);
    }
    words
}

#[cfg(test)]
mod tests {
    use crc::{CRC_16_MODBUS, Crc};

    use super::*;
    use crate::random::Random;

    #[test]
    fn it_equals_the_crc_by_table_at_all_lengths() {
        let by_table = Crc::<u16>::new(&CRC_16_MODBUS);
        for seed in 0..20 {
            let mut random = Random::new(seed);
            let bytes: Vec<u8> = (0..1500).flat_map(|_| random.next().to_le_bytes().into_iter().take(1)).collect();
            for len in 0..=bytes.len() {
                assert_eq!(checksum(&bytes[..len]), by_table.checksum(&bytes[..len]), "seed {seed}, {len} bytes");
            }
        }
    }

    #[test]
    fn each_bit_of_a_message_counts() {
        let by_table = Crc::<u16>::new(&CRC_16_MODBUS);
        for len in [1, 2, 7, 8, 15, 16, 17, 64, 65, 120, 121, 255, 300, 65_535] {
            let mut bytes = vec![0; len];
            for at in (0..len).step_by(len.div_ceil(300)).chain([len - 1]) {
                for bit in 0..8 {
                    bytes[at] = 1 << bit;
                    assert_eq!(checksum(&bytes), by_table.checksum(&bytes), "bit {bit} of byte {at} of {len}");
                }
                bytes[at] = 0;
            }
        }
    }
}
