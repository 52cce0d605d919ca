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

/// Sets the RS-485 mode; an error if the driver has none.
#[cfg(target_os = "linux")]
pub(super) fn set(driver: &Driver, rts: WhileSending) -> io::Result<()> {
    use serial2::rs4xx::{Rs485Config, TransceiverMode};

    let mut config = Rs485Config::new();
    config.set_invert_rts(rts == WhileSending::Off);
    driver.set_rs4xx_mode(config)?;
    // Some drivers accept the mode and do not have it.
    match driver.get_rs4xx_mode()? {
        TransceiverMode::Rs485(kept) if kept.get_invert_rts() == (rts == WhileSending::Off) => Ok(()),
        TransceiverMode::Rs485(_) | TransceiverMode::Rs422 | TransceiverMode::Default => {
            Err(io::Error::new(io::ErrorKind::Unsupported, "the driver has not kept the RS-485 mode"))
        }
    }
}

#[cfg(not(target_os = "linux"))]
pub(super) fn set(driver: &Driver, _: WhileSending) -> io::Result<()> {
    match *driver {}
}
