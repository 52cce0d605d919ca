//! Pseudo-terminals have no control lines: a port double records what is asked of it.

use std::sync::mpsc::{Receiver, Sender, channel};

use tokio::io::{AsyncReadExt, AsyncWriteExt};

use super::*;
use crate::wire::Framing;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Asked {
    Dtr(bool),
    Rts(bool),
    Write(usize),
    Unsent,
    Discard,
    Dropped,
}

/// A port double.
struct Double {
    asked: Sender<(Asked, Instant)>,
    /// The number of questions that are answered with unsent bytes.
    unsent: Mutex<u32>,
    /// The number of bytes that a write takes.
    room: usize,
    /// It has no line RTS.
    no_rts: bool,
}

impl Double {
    fn new() -> (Self, Record) {
        let (asked, record) = channel();
        (Self { asked, unsent: Mutex::new(0), room: usize::MAX, no_rts: false }, Record(record))
    }

    fn note(&self, asked: Asked) {
        let _ = self.asked.send((asked, Instant::now()));
    }
}

struct Record(Receiver<(Asked, Instant)>);

impl Record {
    fn next(&self) -> (Asked, Instant) {
        self.0.recv_timeout(Duration::from_secs(30)).expect("something is asked of the port")
    }

    fn all(&self) -> Vec<Asked> {
        self.0.try_iter().map(|(asked, _)| asked).collect()
    }
}

impl ControlLines for Double {
    fn set_dtr(&mut self, on: bool) -> io::Result<()> {
        self.note(Asked::Dtr(on));
        Ok(())
    }

    fn set_rts(&mut self, on: bool) -> io::Result<()> {
        self.note(Asked::Rts(on));
        if self.no_rts { Err(io::ErrorKind::Unsupported.into()) } else { Ok(()) }
    }

    fn unsent(&self) -> io::Result<u32> {
        self.note(Asked::Unsent);
        let mut unsent = self.unsent.lock().unwrap();
        *unsent = unsent.saturating_sub(1);
        Ok(*unsent)
    }

    fn discard_unsent(&self) -> io::Result<()> {
        self.note(Asked::Discard);
        Ok(())
    }
}

impl AsyncRead for Double {
    fn poll_read(self: Pin<&mut Self>, _: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        buf.put_slice(b"?");
        Poll::Ready(Ok(()))
    }
}

impl AsyncWrite for Double {
    fn poll_write(self: Pin<&mut Self>, _: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        let bytes = buf.len().min(self.room);
        self.note(Asked::Write(bytes));
        Poll::Ready(Ok(bytes))
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        panic!("a serial port must not be flushed");
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        panic!("shutting a serial port down flushes it");
    }
}

impl Drop for Double {
    fn drop(&mut self) {
        self.note(Asked::Dropped);
    }
}

/// The port as a stream.
struct Stream(SwitchedPort<Double>);

impl AsyncRead for Stream {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.0.poll_read(cx, buf)
    }
}

impl AsyncWrite for Stream {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.0.poll_write(cx, buf)
    }

    fn poll_flush(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }

    fn poll_shutdown(self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<io::Result<()>> {
        Poll::Ready(Ok(()))
    }
}

fn settings(rts: Rts) -> SerialSettings {
    SerialSettings::new(Framing::Ascii).with_rts(rts)
}

fn no_driver_mode(_: Option<WhileSending>) -> io::Result<bool> {
    Ok(false)
}

/// A port whose driver has no RS-485 mode; what was asked when it was opened is taken off the
/// record.
fn switched(rts: Rts, change: impl FnOnce(&mut Double)) -> (Stream, Record) {
    switched_at(9600, rts, change)
}

fn switched_at(baud: u32, rts: Rts, change: impl FnOnce(&mut Double)) -> (Stream, Record) {
    let (mut port, record) = Double::new();
    change(&mut port);
    let settings = settings(rts).with_baud(baud).unwrap();
    let switching = set_lines(&mut port, settings, no_driver_mode).unwrap().expect("switched by the port");
    assert_eq!(record.all(), [Asked::Rts(rts == Rts::OffWhileSending)], "it receives");
    (Stream(SwitchedPort::new(port, switching).unwrap()), record)
}

#[test]
fn lines_are_set_when_the_port_is_opened() {
    let plain = settings(Rts::Unchanged);
    for (settings, expected) in [
        (plain, &[][..]),
        (plain.with_dtr(true), &[Asked::Dtr(true)]),
        (plain.with_dtr(false).with_rts(Rts::On), &[Asked::Dtr(false), Asked::Rts(true)]),
        (plain.with_rts(Rts::Off), &[Asked::Rts(false)]),
    ] {
        let (mut port, record) = Double::new();
        let switching = set_lines(&mut port, settings, |mode| {
            assert_eq!(mode, None, "an RS-485 mode is ended");
            Ok(false)
        });
        assert_eq!((switching.unwrap(), record.all().as_slice()), (None, expected));
    }
}

#[test]
fn the_mode_of_the_driver_is_used_where_there_is_one() {
    for (rts, mode) in [(Rts::OnWhileSending, WhileSending::On), (Rts::OffWhileSending, WhileSending::Off)] {
        let (mut port, record) = Double::new();
        let mut asked = None;
        let switching = set_lines(&mut port, settings(rts), |mode| {
            asked = mode;
            Ok(true)
        });
        assert_eq!((switching.unwrap(), asked, record.all()), (None, Some(mode), vec![]));
        // The driver is in another mode, in which RTS has no effect.
        let stuck = |_| Err(io::ErrorKind::InvalidInput.into());
        let error = set_lines(&mut port, settings(rts), stuck).unwrap_err();
        assert!(error.to_string().starts_with("the line RTS of the port cannot be set"), "{error}");
    }
}

#[test]
fn a_line_that_the_port_does_not_have_is_named() {
    for rts in [Rts::On, Rts::OnWhileSending] {
        let (mut port, _record) = Double::new();
        port.no_rts = true;
        let error = set_lines(&mut port, settings(rts), no_driver_mode).unwrap_err();
        let text = error.to_string();
        assert!(text.starts_with("the line RTS of the port cannot be set: "), "{text}");
    }
}

#[tokio::test]
async fn rts_is_set_before_the_first_byte_and_set_back_after_the_last() {
    for (rts, sending) in [(Rts::OnWhileSending, true), (Rts::OffWhileSending, false)] {
        let (mut port, record) = switched(rts, |_| ());
        for _ in 0..2 {
            port.write_all(b"0123456789").await.unwrap();
            let (first, _) = record.next();
            let (second, written) = record.next();
            assert_eq!((first, second), (Asked::Rts(sending), Asked::Write(10)));
            assert_eq!(record.next().0, Asked::Unsent);
            let (third, back) = record.next();
            assert_eq!(third, Asked::Rts(!sending));
            // Ten characters of ten bits at 9600 baud.
            assert!(back - written >= Duration::from_micros(10_416), "{:?}", back - written);
        }
        assert_eq!(port.read_u8().await.unwrap(), b'?');
    }
}

#[tokio::test]
async fn a_frame_in_several_writes_is_one_transmission() {
    // Slow enough for a pause of this thread between two writes.
    let (mut port, record) = switched_at(300, Rts::OnWhileSending, |port| port.room = 4);
    port.write_all(b"0123456789").await.unwrap();
    let begin = record.next();
    assert_eq!(begin.0, Asked::Rts(true));
    let writes: Vec<Asked> = (0..3).map(|_| record.next().0).collect();
    assert_eq!(writes, [Asked::Write(4), Asked::Write(4), Asked::Write(2)]);
    assert_eq!(record.next().0, Asked::Unsent);
    let (back, at) = record.next();
    assert!(back == Asked::Rts(false) && at - begin.1 >= Duration::from_millis(333));
}

#[tokio::test]
async fn rts_is_not_set_back_while_bytes_are_unsent() {
    let (mut port, record) = switched(Rts::OnWhileSending, |port| *port.unsent.get_mut().unwrap() = 5);
    port.write_all(b"0").await.unwrap();
    let asked: Vec<(Asked, Instant)> = (0..9).map(|_| record.next()).collect();
    let mut expected = vec![Asked::Rts(true), Asked::Write(1)];
    // The last two times none is unsent: the second time is after that of the hardware's buffer.
    expected.extend([Asked::Unsent; 6]);
    expected.push(Asked::Rts(false));
    assert_eq!(asked.iter().map(|(asked, _)| *asked).collect::<Vec<_>>(), expected);
    let waited = asked[7].1 - asked[6].1;
    assert!(waited >= Duration::from_millis(64), "64 characters, not {waited:?}");
}

#[tokio::test]
async fn a_dropped_port_is_closed_at_once_with_rts_at_rest() {
    let (mut port, record) = switched(Rts::OnWhileSending, |_| ());
    port.write_all(&[0; 1000]).await.unwrap();
    drop(port);
    // Also if the thread was faster; 1000 bytes take a second.
    let mut asked = record.all();
    asked.retain(|asked| *asked != Asked::Unsent);
    let closed = [Asked::Rts(true), Asked::Write(1000), Asked::Discard, Asked::Rts(false), Asked::Dropped];
    assert_eq!(asked, closed);
}

#[tokio::test]
async fn a_write_fails_if_rts_cannot_be_set() {
    let (mut port, record) = switched(Rts::OnWhileSending, |_| ());
    port.0.shared.lock().port.as_mut().unwrap().no_rts = true;
    let error = port.write_all(b"0").await.unwrap_err();
    assert!(error.to_string().contains("RTS"), "{error}");
    assert_eq!(record.all(), [Asked::Rts(true)], "nothing is written while RTS is at rest");
}
