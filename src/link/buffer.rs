//! A buffer per thread, shared by its links for bytes in use: a request being written, received
//! bytes being decoded. Most links are idle most of the time, so none of thousands keeps a buffer
//! of its own.

use std::cell::Cell;

use bytes::BytesMut;

/// Size of the buffer: the longest reply fits.
pub(crate) const LEN: usize = 1024;

thread_local! {
    static BUFFER: Cell<Option<BytesMut>> = const { Cell::new(None) };
}

/// Takes the thread's buffer, empty. If it is taken already, returns a new one.
pub(crate) fn borrow() -> BytesMut {
    // A thread that is ending has none.
    let mut buffer = BUFFER.try_with(Cell::take).ok().flatten().unwrap_or_default();
    buffer.clear();
    buffer.reserve(LEN);
    buffer
}

/// Returns a buffer to the thread.
pub(crate) fn give_back(buffer: BytesMut) {
    let _ = BUFFER.try_with(|place| place.set(Some(buffer)));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_returned_buffer_is_used_again_and_empty() {
        let mut first = borrow();
        assert!(first.capacity() >= LEN);
        first.extend_from_slice(&[7; 3 * LEN]);
        let (memory, capacity) = (first.as_ptr(), first.capacity());
        let second = borrow();
        assert!(second.as_ptr() != memory && second.capacity() < capacity, "the first is in use");
        give_back(first);
        let third = borrow();
        assert_eq!((third.as_ptr(), third.capacity(), third.len()), (memory, capacity, 0));
    }
}
