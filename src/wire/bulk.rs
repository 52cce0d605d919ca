//! Many values of one form, one after the other.

use bytes::{BufMut, BytesMut};

/// Appends values, each in its form of `N` bytes.
pub(super) fn put<T: Copy, const N: usize>(dst: &mut BytesMut, values: &[T], form: impl Fn(T) -> [u8; N]) {
    // A buffer is asked for room once a block, not once a value.
    for values in values.chunks(BLOCK) {
        let mut block = [[0; N]; BLOCK];
        for (place, &value) in block.iter_mut().zip(values) {
            *place = form(value);
        }
        dst.put_slice(block.get(..values.len()).unwrap_or_default().as_flattened());
    }
}

/// Makes values of data, each of `N` bytes; the data has that many.
pub(super) fn fill<T, const N: usize>(values: &mut [T], data: &[u8], value: impl Fn([u8; N]) -> T) {
    let (forms, _) = data.as_chunks();
    for (place, &form) in values.iter_mut().zip(forms) {
        *place = value(form);
    }
}

/// As many registers as a request takes.
const BLOCK: usize = 64;
