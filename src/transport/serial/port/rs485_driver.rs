//! The RS-485 mode of a serial port's driver: `TIOCSRS485` of Linux.

use std::io;

use super::rts::WhileSending;

#[cfg(target_os = "linux")]
pub(super) type Driver = serial2::SerialPort;

#[cfg(not(target_os = "linux"))]
pub(super) type Driver = std::convert::Infallible;

/// Opens the port beside its users, and changes nothing.
#[cfg(target_os = "linux")]
pub(super) fn open(path: &str) -> io::Result<Driver> {
    Driver::open(path, serial2::KeepSettings)
}

#[cfg(not(target_os = "linux"))]
pub(super) fn open(_: &str) -> io::Result<Driver> {
    Err(io::ErrorKind::Unsupported.into())
}

/// Sets the RS-485 mode. Returns `false` if the driver has none: then no such mode is set.
///
/// # Errors
/// The driver keeps a mode that was not asked for, in which RTS cannot be set.
#[cfg(target_os = "linux")]
pub(super) fn set(driver: &Driver, rts: WhileSending) -> io::Result<bool> {
    use serial2::rs4xx::{Rs485Config, TransceiverMode};

    let mut config = Rs485Config::new();
    config.set_invert_rts(rts == WhileSending::Off);
    if driver.set_rs4xx_mode(config).is_err() {
        return Ok(false);
    }
    // Some drivers accept the mode and keep another, or none.
    match driver.get_rs4xx_mode() {
        Ok(TransceiverMode::Rs485(kept)) if kept.get_invert_rts() == (rts == WhileSending::Off) => Ok(true),
        Ok(TransceiverMode::Default) => Ok(false),
        Ok(TransceiverMode::Rs485(_) | TransceiverMode::Rs422) | Err(_) => {
            driver.set_rs4xx_mode(TransceiverMode::Default)?;
            Ok(false)
        }
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn set(driver: &Driver, _: WhileSending) -> io::Result<bool> {
    match *driver {}
}

/// Ends an RS-485 mode that was set before, in which RTS cannot be set.
#[cfg(target_os = "linux")]
pub(super) fn clear(driver: &Driver) -> io::Result<()> {
    use serial2::rs4xx::TransceiverMode;

    match driver.get_rs4xx_mode() {
        Ok(TransceiverMode::Rs485(_) | TransceiverMode::Rs422) => driver.set_rs4xx_mode(TransceiverMode::Default),
        Ok(TransceiverMode::Default) | Err(_) => Ok(()),
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn clear(driver: &Driver) -> io::Result<()> {
    match *driver {}
}
