//! Opens serial ports.

mod rs485_driver;
mod rts;

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_serial::{ClearBuffer, FlowControl, SerialPort as _, SerialPortBuilder, SerialStream};

use self::rts::{ControlLines, SwitchedPort, set_lines};
use crate::settings::{DataBits, Parity, Rts, SerialSettings, StopBits};

/// Opens the port exclusively, sets its lines, and discards what it has received before.
pub(in crate::transport) async fn open(path: &str, settings: SerialSettings) -> io::Result<Port> {
    let path = path.to_owned();
    // Opening a device can take long: some drivers look for the hardware first.
    let opening = tokio::task::spawn_blocking(move || {
        // An exclusive port cannot be opened again, so its driver is opened before.
        let driver = match settings.rts() {
            Rts::Unchanged => None,
            Rts::On | Rts::Off | Rts::OnWhileSending | Rts::OffWhileSending => rs485_driver::open(&path).ok(),
        };
        let mut stream = SerialStream::open(&builder(&path, settings))?;
        stream.clear(ClearBuffer::Input)?;
        warn_of_other_settings(&stream, settings);
        let switching = set_lines(&mut stream, settings, |mode| match (&driver, mode) {
            (None, _) => Ok(false),
            (Some(driver), Some(mode)) => rs485_driver::set(driver, mode),
            (Some(driver), None) => rs485_driver::clear(driver).map(|()| false),
        })?;
        Ok(match switching {
            None => Port::Plain(PlainPort { stream }),
            Some(switching) => Port::Switched(SwitchedPort::new(stream, switching)?),
        })
    });
    opening.await.map_err(io::Error::other)?
}

fn builder(path: &str, settings: SerialSettings) -> SerialPortBuilder {
    tokio_serial::new(path, settings.baud())
        .data_bits(data_bits(settings))
        .parity(parity(settings))
        .stop_bits(match settings.stop_bits() {
            StopBits::One => tokio_serial::StopBits::One,
            StopBits::Two => tokio_serial::StopBits::Two,
        })
        .flow_control(FlowControl::None)
        .exclusive(true)
}

fn data_bits(settings: SerialSettings) -> tokio_serial::DataBits {
    match settings.data_bits() {
        DataBits::Seven => tokio_serial::DataBits::Seven,
        DataBits::Eight => tokio_serial::DataBits::Eight,
    }
}

fn parity(settings: SerialSettings) -> tokio_serial::Parity {
    match settings.parity() {
        Parity::None => tokio_serial::Parity::None,
        Parity::Even => tokio_serial::Parity::Even,
        Parity::Odd => tokio_serial::Parity::Odd,
    }
}

/// Warns if the port has not kept its settings. Some adapters lack 7 data bits or parity, and their
/// drivers accept the setting all the same. Then no PLC answers, without any other sign.
fn warn_of_other_settings(stream: &SerialStream, settings: SerialSettings) {
    let (Ok(data_bits_kept), Ok(parity_kept)) = (stream.data_bits(), stream.parity()) else { return };
    if (data_bits_kept, parity_kept) != (data_bits(settings), parity(settings)) {
        let port = stream.name();
        tracing::warn!(port, asked = %settings, %data_bits_kept, %parity_kept, "the port does not keep its settings");
    }
}

/// An open port. It must never be flushed: that blocks the thread until the last bit is on the
/// line.
#[derive(Debug)]
pub(in crate::transport) enum Port {
    Plain(PlainPort),
    /// RTS follows what is written.
    Switched(SwitchedPort<SerialStream>),
}

#[derive(Debug)]
pub(in crate::transport) struct PlainPort {
    stream: SerialStream,
}

impl Drop for PlainPort {
    fn drop(&mut self) {
        // Unsent bytes are discarded, since closing a port would wait for them. The error of an
        // unplugged port is ignored: it has nothing left to discard.
        let _ = self.stream.discard_unsent();
    }
}

impl ControlLines for SerialStream {
    fn set_dtr(&mut self, on: bool) -> io::Result<()> {
        Ok(self.write_data_terminal_ready(on)?)
    }

    fn set_rts(&mut self, on: bool) -> io::Result<()> {
        Ok(self.write_request_to_send(on)?)
    }

    fn unsent(&self) -> io::Result<u32> {
        Ok(self.bytes_to_write()?)
    }

    fn discard_unsent(&self) -> io::Result<()> {
        Ok(self.clear(ClearBuffer::Output)?)
    }
}

impl AsyncRead for Port {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        match self.get_mut() {
            Self::Plain(port) => Pin::new(&mut port.stream).poll_read(cx, buf),
            Self::Switched(port) => port.poll_read(cx, buf),
        }
    }
}

impl AsyncWrite for Port {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        match self.get_mut() {
            Self::Plain(port) => Pin::new(&mut port.stream).poll_write(cx, buf),
            Self::Switched(port) => port.poll_write(cx, buf),
        }
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::Framing;

    #[cfg(target_os = "linux")]
    #[tokio::test]
    async fn unsent_bytes_are_discarded_when_a_port_is_closed() {
        // The other end reads nothing meanwhile.
        let (mut other_end, stream) = SerialStream::pair().unwrap();
        let mut port = PlainPort { stream };
        port.stream.writable().await.unwrap();
        let mut written = 0;
        while let Ok(len) = port.stream.try_write(&[7; 1024]) {
            written += len;
        }
        drop(port);
        let mut received = Vec::new();
        // The end of a closed pseudo-terminal is an error.
        let _ = tokio::io::AsyncReadExt::read_to_end(&mut other_end, &mut received).await;
        assert!(received.len() < written, "{written} bytes were written, {} received", received.len());
    }

    /// A pseudo-terminal cannot show this: it always has 8 data bits and no
    /// parity.
    #[test]
    fn ports_are_opened_with_the_settings_of_the_endpoint() {
        use tokio_serial::{DataBits as Data, Parity as Check, StopBits as Stop};

        let ascii = SerialSettings::new(Framing::Ascii);
        let odd = ascii.with_parity(Parity::Odd).with_stop_bits(StopBits::Two).with_baud(115_200).unwrap();
        for (settings, baud, data_bits, parity, stop_bits) in [
            (ascii, 9600, Data::Seven, Check::Even, Stop::One),
            (SerialSettings::new(Framing::Binary), 9600, Data::Eight, Check::None, Stop::One),
            (odd, 115_200, Data::Seven, Check::Odd, Stop::Two),
        ] {
            let asked = tokio_serial::new("COM3", baud).data_bits(data_bits).parity(parity).stop_bits(stop_bits);
            assert_eq!(builder("COM3", settings), asked.flow_control(FlowControl::None).exclusive(true));
        }
    }
}
