//! Values of one encoding in bulk, in loops that the compiler can vectorise.

use bytes::BytesMut;

/// Appends values, each encoded in `N` bytes.
pub(super) fn put<T: Copy, const N: usize>(dst: &mut BytesMut, values: &[T], encode: impl Fn(T) -> [u8; N]) {
    // The buffer is grown once a block, not once a value.
    for values in values.chunks(BLOCK) {
        let mut block = [[0; N]; BLOCK];
        for (place, &value) in block.iter_mut().zip(values) {
            *place = encode(value);
        }
        dst.extend_from_slice(block.get(..values.len()).unwrap_or_default().as_flattened());
    }
}

/// Decodes values of `N` bytes each. The data must have that many bytes for each value.
pub(super) fn fill<T, const N: usize>(values: &mut [T], data: &[u8], decode: impl Fn([u8; N]) -> T) {
    let (encoded, _) = data.as_chunks();
    debug_assert!(encoded.len() == values.len(), "the caller has taken the bytes of all values");
    for (place, &bytes) in values.iter_mut().zip(encoded) {
        *place = decode(bytes);
    }
}

/// The registers of the longest request.
const BLOCK: usize = 64;
