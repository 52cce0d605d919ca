//! Reassembly of one direction of a TCP connection: segments in, bytes in order out.
//!
//! States: before the first segment; then the position of the next byte, with segments ahead of it.
//!
//! Invariants:
//! - Each byte of the stream is given once, in order, or counted as missing.
//! - At most [`MAX_AHEAD`] bytes wait. A gap is missing when they would be more, or when the receiver
//!   has acknowledged its bytes: then the capture has lost them, and they do not come any more.

use std::collections::BTreeMap;

use bytes::Bytes;

/// Bytes that wait for a gap before them to be filled.
const MAX_AHEAD: usize = 16 * 1024;

/// Segments that wait.
const MAX_SEGMENTS: usize = 64;

/// A part of the stream.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum StreamPart {
    Bytes(Bytes),
    Missing(u64),
}

#[derive(Debug, Default)]
pub(super) struct Stream {
    /// Sequence number of the next byte; `None` before the first segment.
    next: Option<u32>,
    /// Bytes before `next`, since the first segment.
    position: u64,
    /// Position up to which the receiver has acknowledged.
    acknowledged: u64,
    /// Segments ahead of a gap, by position.
    ahead: BTreeMap<u64, Bytes>,
}

impl Stream {
    /// Returns whether a segment that begins a connection is of another one than this.
    pub(super) fn is_other_connection(&self, sequence: u32) -> bool {
        self.position > 0 && self.next.is_some_and(|next| next != sequence.wrapping_add(1))
    }

    /// Takes a segment. `begins`: it is the first (SYN). `cut`: bytes at its end that the capture does
    /// not have.
    pub(super) fn push(&mut self, sequence: u32, begins: bool, payload: &[u8], cut: usize) -> Vec<StreamPart> {
        // SYN takes a number of the sequence.
        let sequence = if begins { sequence.wrapping_add(1) } else { sequence };
        let mut parts = Vec::new();
        if begins && self.position == 0 {
            self.next = Some(sequence);
        }
        let distance = sequence.wrapping_sub(*self.next.get_or_insert(sequence)).cast_signed();
        match u64::try_from(distance) {
            Ok(0) => self.take(payload, &mut parts),
            Ok(distance) => {
                let at = self.position.saturating_add(distance);
                let waiting = self.ahead.entry(at).or_default();
                if waiting.len() < payload.len() {
                    *waiting = Bytes::copy_from_slice(payload);
                }
            }
            // Sent again: the new bytes, if there are any.
            Err(_) => {
                let known = usize::try_from(distance.unsigned_abs()).unwrap_or(usize::MAX);
                self.take(payload.get(known..).unwrap_or_default(), &mut parts);
            }
        }
        if distance == 0 && cut > 0 {
            let missing = u64::try_from(cut).unwrap_or(u64::MAX);
            self.skip(self.position.saturating_add(missing), &mut parts);
        }
        self.fill(&mut parts);
        parts
    }

    /// Takes the next byte that the receiver expects.
    pub(super) fn acknowledge(&mut self, sequence: u32) -> Vec<StreamPart> {
        let mut parts = Vec::new();
        let Some(next) = self.next else { return parts };
        if let Ok(distance) = u64::try_from(sequence.wrapping_sub(next).cast_signed()) {
            self.acknowledged = self.acknowledged.max(self.position.saturating_add(distance));
            self.fill(&mut parts);
        }
        parts
    }

    /// Ends the stream: gaps are missing.
    pub(super) fn finish(&mut self) -> Vec<StreamPart> {
        let mut parts = Vec::new();
        while let Some((&at, _)) = self.ahead.first_key_value() {
            self.skip(at, &mut parts);
            self.take_ahead(&mut parts);
        }
        parts
    }

    fn fill(&mut self, parts: &mut Vec<StreamPart>) {
        self.take_ahead(parts);
        while let Some((&at, _)) = self.ahead.first_key_value() {
            let waiting: usize = self.ahead.values().map(Bytes::len).sum();
            if at > self.acknowledged && waiting <= MAX_AHEAD && self.ahead.len() <= MAX_SEGMENTS {
                return;
            }
            self.skip(at, parts);
            self.take_ahead(parts);
        }
    }

    /// Takes the segments that are next.
    fn take_ahead(&mut self, parts: &mut Vec<StreamPart>) {
        while let Some(first) = self.ahead.first_entry()
            && let Some(known) = self.position.checked_sub(*first.key())
        {
            let known = usize::try_from(known).unwrap_or(usize::MAX);
            let segment = first.remove();
            self.take(segment.get(known..).unwrap_or_default(), parts);
        }
    }

    fn take(&mut self, bytes: &[u8], parts: &mut Vec<StreamPart>) {
        if !bytes.is_empty() {
            self.advance(u64::try_from(bytes.len()).unwrap_or(u64::MAX));
            parts.push(StreamPart::Bytes(Bytes::copy_from_slice(bytes)));
        }
    }

    fn skip(&mut self, to: u64, parts: &mut Vec<StreamPart>) {
        let missing = to.saturating_sub(self.position);
        if missing > 0 {
            self.advance(missing);
            parts.push(StreamPart::Missing(missing));
        }
    }

    fn advance(&mut self, count: u64) {
        self.position = self.position.saturating_add(count);
        // Sequence numbers wrap at 2^32.
        let low = u32::try_from(count & u64::from(u32::MAX)).unwrap_or_default();
        self.next = self.next.map(|next| next.wrapping_add(low));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Bytes in order, with `<n>` for missing ones.
    fn shown(parts: &[StreamPart]) -> String {
        let text = |part: &StreamPart| match part {
            StreamPart::Bytes(bytes) => String::from_utf8_lossy(bytes).into_owned(),
            StreamPart::Missing(count) => format!("<{count}>"),
        };
        parts.iter().map(text).collect()
    }

    #[test]
    fn retransmissions_and_overlaps_are_given_once() {
        let mut stream = Stream::default();
        assert_eq!(shown(&stream.push(99, true, b"", 0)), "");
        assert_eq!(shown(&stream.push(100, false, b"abc", 0)), "abc");
        assert_eq!(shown(&stream.push(100, false, b"abc", 0)), "");
        // A keep-alive.
        assert_eq!(shown(&stream.push(102, false, b"x", 0)), "");
        assert_eq!(shown(&stream.push(101, false, b"bcde", 0)), "de");
        assert!(!stream.is_other_connection(104) && stream.is_other_connection(5000));
    }

    #[test]
    fn segments_out_of_order_are_sorted_also_at_the_wrap() {
        let mut stream = Stream::default();
        stream.push(u32::MAX - 2, true, b"", 0);
        assert_eq!(shown(&stream.push(2, false, b"ef", 0)), "");
        assert_eq!(shown(&stream.push(0, false, b"cd", 0)), "");
        assert_eq!(shown(&stream.push(u32::MAX - 1, false, b"ab", 0)), "abcdef");
    }

    #[test]
    fn a_capture_without_the_beginning_starts_anywhere() {
        let mut stream = Stream::default();
        assert_eq!(shown(&stream.push(7000, false, b"ab", 0)), "ab");
        assert_eq!(shown(&stream.push(7002, false, b"cd", 0)), "cd");
    }

    #[test]
    fn acknowledged_gaps_are_missing() {
        let mut stream = Stream::default();
        stream.push(0, false, b"ab", 0);
        assert_eq!(shown(&stream.push(5, false, b"fg", 0)), "");
        // The receiver has it: it is lost in the capture only.
        assert_eq!(shown(&stream.acknowledge(7)), "<3>fg");
        // The acknowledgement comes first.
        assert_eq!(shown(&stream.acknowledge(9)), "");
        assert_eq!(shown(&stream.push(9, false, b"jk", 0)), "<2>jk");
        // An old one.
        assert_eq!(shown(&stream.acknowledge(3)), "");
    }

    #[test]
    fn gaps_are_missing_at_the_limit_at_the_end_and_in_cut_segments() {
        let mut stream = Stream::default();
        stream.push(0, false, b"a", 0);
        assert_eq!(shown(&stream.push(2, false, b"c", 0)), "");
        assert_eq!(shown(&stream.finish()), "<1>c");
        let long = vec![b'x'; MAX_AHEAD + 1];
        assert!(shown(&stream.push(10, false, &long, 0)).starts_with("<7>xxx"));

        let mut stream = Stream::default();
        assert_eq!(shown(&stream.push(0, false, b"ab", 3)), "ab<3>");
        assert_eq!(shown(&stream.push(5, false, b"f", 0)), "f");
    }

    proptest::proptest! {
        /// Segments of one text in any order, some of them twice, some cut: the text, and no byte twice.
        #[test]
        fn any_order_of_segments_is_the_text(
            cuts in proptest::collection::vec(1_usize..9, 1..12),
            order in proptest::collection::vec(0_usize..1000, 0..40),
            first: u32,
        ) {
            let len: usize = cuts.iter().sum();
            let text: Vec<u8> = (b'a'..=b'z').cycle().take(len).collect();
            let mut segments: Vec<(usize, usize)> = Vec::new();
            let mut at = 0;
            for cut in cuts {
                segments.push((at, cut));
                at += cut;
            }
            let mut stream = Stream::default();
            let mut given = stream.push(first.wrapping_sub(1), true, b"", 0);
            let all = segments.clone();
            let chosen = order.iter().map(|&i| all[i % all.len()]).chain(segments);
            for (at, len) in chosen {
                let sequence = first.wrapping_add(u32::try_from(at).unwrap());
                given.extend(stream.push(sequence, false, &text[at..at + len], 0));
            }
            given.extend(stream.finish());
            proptest::prop_assert_eq!(shown(&given), String::from_utf8(text).unwrap());
        }

        /// Any segments and acknowledgements: no panic, and bounded memory.
        #[test]
        fn no_segments_make_it_panic_or_grow(
            segments in proptest::collection::vec((proptest::prelude::any::<u32>(), 0_usize..2000, 0_usize..9), 0..200),
        ) {
            let mut stream = Stream::default();
            for (sequence, len, kind) in segments {
                match kind {
                    0 => drop(stream.acknowledge(sequence)),
                    1 => drop(stream.push(sequence, true, &vec![0; len], 0)),
                    2 => drop(stream.push(sequence, false, &vec![0; len], 77)),
                    _ => drop(stream.push(sequence, false, &vec![0; len], 0)),
                }
                proptest::prop_assert!(stream.ahead.values().map(Bytes::len).sum::<usize>() <= MAX_AHEAD);
                proptest::prop_assert!(stream.ahead.len() <= MAX_SEGMENTS);
            }
        }
    }
}
