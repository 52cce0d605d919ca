//! A buffer that all links of a thread share, for what is in their hands for a moment: a request while it is written, bytes
//! while they are understood. A link waits most of the time, and there may be thousands, so none keeps its own.

use std::cell::Cell;

use bytes::BytesMut;

/// The longest reply fits.
pub(crate) const LEN: usize = 1024;

thread_local! {
    static BUFFER: Cell<BytesMut> = Cell::new(BytesMut::new());
}

/// Borrows it, empty; if it is out already, this is another one.
pub(crate) fn borrow() -> BytesMut {
    // A thread that is about to end has none any more.
    let mut buffer = BUFFER.try_with(Cell::take).unwrap_or_default();
    buffer.clear();
    buffer.reserve(LEN);
    buffer
}

/// Gives it back.
pub(crate) fn give_back(buffer: BytesMut) {
    let _ = BUFFER.try_with(|place| place.set(buffer));
}
