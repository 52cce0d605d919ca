//! The records of batches in a chunk. No I/O.
//!
//! | bytes | content |
//! |---|---|
//! | 0–3 | CRC-32C of all that follows in the record |
//! | 4–7 | length of the record |
//! | 8–15 | position |
//! | 16–23 | when the batch was pushed, in milliseconds of the buffer's time |
//! | 24–31 | sequence number |
//! | 32–39 | time of the reply |
//! | 40–43 | number of samples |
//! | 44–45 | length of the name of the PLC; the highest bit is set if there is a revision |
//! | 46– | name of the PLC, the revision of 8 bytes if there is one, and then the data |
//!
//! Numbers are little-endian. Only batches of a fleet have a revision: the others are as before there were fleets.
//! redb has checksums, but it does not verify them when it reads a page. So each
//! record has its own, and one that does not match is never delivered.

use std::collections::HashMap;
use std::sync::Arc;

use bytes::Bytes;
use crc::{CRC_32_ISCSI, Crc, Table};

use super::log::Slot;
use crate::batch::Batch;

const HEADER: usize = 46;
/// The length of a revision.
const REVISION: usize = 8;
/// In the length of the name: a revision follows the name.
const HAS_REVISION: u16 = 0x8000;
static CHECKSUM: Crc<u32, Table<16>> = Crc::<u32, Table<16>>::new(&CRC_32_ISCSI);
/// The names that a decoder keeps, so that batches of one PLC share theirs.
const MAX_NAMES: usize = 4096;

/// The length of the record of a batch.
pub(super) fn size(batch: &Batch) -> usize {
    let revision = if batch.revision == 0 { 0 } else { REVISION };
    HEADER.saturating_add(batch.plc.len()).saturating_add(revision).saturating_add(batch.data.len())
}

/// Appends the record of a batch.
pub(super) fn encode(slot: &Slot, out: &mut Vec<u8>) {
    let batch = &*slot.batch;
    let start = out.len();
    let name = batch.plc.as_bytes();
    out.extend_from_slice(&[0; 4]);
    out.extend_from_slice(&u32::try_from(size(batch)).unwrap_or(u32::MAX).to_le_bytes());
    for number in [slot.position, slot.pushed, batch.seq, batch.ts] {
        out.extend_from_slice(&number.to_le_bytes());
    }
    out.extend_from_slice(&batch.samples.to_le_bytes());
    // Names have at most 64 characters.
    let length = u16::try_from(name.len()).unwrap_or(u16::MAX) & !HAS_REVISION;
    let has_revision = batch.revision != 0;
    out.extend_from_slice(&(if has_revision { length | HAS_REVISION } else { length }).to_le_bytes());
    out.extend_from_slice(name);
    if has_revision {
        out.extend_from_slice(&batch.revision.to_le_bytes());
    }
    out.extend_from_slice(&batch.data);
    let checksum = CHECKSUM.checksum(out.get(start.saturating_add(4)..).unwrap_or_default());
    if let Some(place) = out.get_mut(start..start.saturating_add(4)) {
        place.copy_from_slice(&checksum.to_le_bytes());
    }
}

/// Decodes chunks.
#[derive(Debug, Default)]
pub(super) struct Decoder {
    names: HashMap<Box<str>, Arc<str>>,
}

impl Decoder {
    /// The batches of a chunk, up to the first record that is not good. They share the memory of the chunk.
    pub(super) fn decode(&mut self, chunk: &Bytes) -> Vec<Slot> {
        let mut slots = Vec::new();
        let mut at = 0;
        while let Some((slot, end)) = self.record(chunk, at) {
            slots.push(slot);
            at = end;
        }
        slots
    }

    /// The record that begins here, and where it ends.
    fn record(&mut self, chunk: &Bytes, start: usize) -> Option<(Slot, usize)> {
        let rest = chunk.get(start..)?;
        let length = usize::try_from(u32::from_le_bytes(field(rest, 4)?)).ok()?;
        let record = rest.get(..length).filter(|record| record.len() >= HEADER)?;
        let checksum = u32::from_le_bytes(field(record, 0)?);
        if CHECKSUM.checksum(record.get(4..)?) != checksum {
            return None;
        }
        let number = |at| field(record, at).map(u64::from_le_bytes);
        let name_length = u16::from_le_bytes(field(record, 44)?);
        let name_end = HEADER.saturating_add((name_length & !HAS_REVISION).into());
        let has_revision = name_length & HAS_REVISION != 0;
        let data = if has_revision { name_end.saturating_add(REVISION) } else { name_end };
        let end = start.saturating_add(length);
        let batch = Batch {
            plc: self.name(std::str::from_utf8(record.get(HEADER..name_end)?).ok()?),
            revision: if has_revision { number(name_end)? } else { 0 },
            seq: number(24)?,
            ts: number(32)?,
            samples: u32::from_le_bytes(field(record, 40)?),
            data: chunk.slice(start.saturating_add(data)..end),
        };
        Some((Slot { position: number(8)?, pushed: number(16)?, batch: Arc::new(batch) }, end))
    }

    fn name(&mut self, name: &str) -> Arc<str> {
        if let Some(known) = self.names.get(name) {
            return known.clone();
        }
        if self.names.len() >= MAX_NAMES {
            self.names.clear();
        }
        let shared: Arc<str> = name.into();
        self.names.insert(name.into(), shared.clone());
        shared
    }
}

fn field<const N: usize>(record: &[u8], at: usize) -> Option<[u8; N]> {
    record.get(at..at.checked_add(N)?)?.try_into().ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn slot(position: u64) -> Slot {
        let data = format!("{{\"level\":{position}}}").into();
        let (plc, revision) = ("mixer".into(), u64::MAX - position);
        let batch = Batch { plc, revision, seq: position + 7, ts: 1_700_000_000_000, samples: 3, data };
        Slot { position, pushed: position * 10, batch: Arc::new(batch) }
    }

    fn chunk() -> Vec<u8> {
        let mut chunk = Vec::new();
        (1..=3).for_each(|position| encode(&slot(position), &mut chunk));
        chunk
    }

    fn positions(chunk: Vec<u8>) -> Vec<u64> {
        Decoder::default().decode(&chunk.into()).iter().map(|slot| slot.position).collect()
    }

    #[test]
    fn records_are_read_as_they_were_written() {
        let chunk = chunk();
        assert_eq!(chunk.len(), 3 * size(&slot(1).batch));
        let read = Decoder::default().decode(&chunk.into());
        let expected: Vec<Slot> = (1..=3).map(slot).collect();
        assert_eq!(read, expected);
        assert!(Arc::ptr_eq(&read[0].batch.plc, &read[2].batch.plc));
    }

    #[test]
    fn a_batch_without_a_revision_has_no_room_for_one() {
        let mut chunk = Vec::new();
        let with = slot(1);
        let without = Slot { batch: Arc::new(Batch { revision: 0, ..(*with.batch).clone() }), ..with.clone() };
        [&without, &with, &without].into_iter().for_each(|slot| encode(slot, &mut chunk));
        assert_eq!(size(&without.batch), HEADER + 5 + without.batch.data.len());
        assert_eq!(chunk.len(), 2 * size(&without.batch) + size(&with.batch));
        assert_eq!(Decoder::default().decode(&chunk.into()), [without.clone(), with, without]);
    }

    #[test]
    fn a_flipped_bit_ends_the_chunk_before_its_record() {
        let good = chunk();
        let length = good.len() / 3;
        for bit in 0..good.len() * 8 {
            let mut bad = good.clone();
            bad[bit / 8] ^= 1 << (bit % 8);
            let intact = u64::try_from(bit / 8 / length).unwrap();
            assert_eq!(positions(bad), (1..=intact).collect::<Vec<_>>(), "bit {bit}");
        }
    }

    #[test]
    fn a_chunk_that_was_cut_gives_its_whole_records() {
        let good = chunk();
        for length in 0..good.len() {
            let whole = u64::try_from(length / (good.len() / 3)).unwrap();
            assert_eq!(positions(good[..length].to_vec()), (1..=whole).collect::<Vec<_>>());
        }
        assert!(positions(vec![0xFF; 4096]).is_empty());
        assert!(positions(vec![0; 4096]).is_empty());
    }
}
