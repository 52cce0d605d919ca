use std::io;

use crate::settings::SerialSettings;

/// Replaces serial ports in a build without them.
pub(in crate::transport) async fn open(_: &str, _: SerialSettings) -> io::Result<tokio::io::Empty> {
    Err(io::Error::new(io::ErrorKind::Unsupported, "the crate `fatek` is built without its feature `serial`"))
}
