use std::io;

use crate::endpoint::SerialSettings;

/// Replaces serial ports in a build without them.
pub(super) async fn open(_: &str, _: SerialSettings) -> io::Result<tokio::io::Empty> {
    Err(io::Error::new(io::ErrorKind::Unsupported, "the crate `fatek` is built without its feature `serial`"))
}
