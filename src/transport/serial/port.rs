use std::io;
use std::pin::Pin;
use std::task::{Context, Poll};

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_serial::{ClearBuffer, FlowControl, SerialPort as _, SerialPortBuilder, SerialStream};

use crate::settings::{DataBits, Parity, SerialSettings, StopBits};

/// Opens the port exclusively, and discards what it has received before.
pub(in crate::transport) async fn open(path: &str, settings: SerialSettings) -> io::Result<Port> {
    let builder = builder(path, settings);
    // Opening a device can take long: some drivers look for the hardware first.
    let opening = tokio::task::spawn_blocking(move || {
        let stream = SerialStream::open(&builder)?;
        stream.clear(ClearBuffer::Input)?;
        warn_of_other_settings(&stream, settings);
        Ok(Port { stream })
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
pub(in crate::transport) struct Port {
    stream: SerialStream,
}

impl Drop for Port {
    fn drop(&mut self) {
        // Unsent bytes are discarded, since closing a port would wait for them. The error of an
        // unplugged port is ignored: it has nothing left to discard.
        let _ = self.stream.clear(ClearBuffer::Output);
    }
}

impl AsyncRead for Port {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_read(cx, buf)
    }
}

impl AsyncWrite for Port {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        Pin::new(&mut self.stream).poll_write(cx, buf)
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
