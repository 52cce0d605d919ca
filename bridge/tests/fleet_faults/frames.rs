//! Frames of the NATS protocol, as far as a proxy must know them.

/// A whole frame, with its payload.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Frame {
    pub(crate) bytes: Vec<u8>,
    pub(crate) kind: Kind,
}

/// The kind of a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    /// `PUB` or `HPUB` of a client.
    Publish { subject: String, payload: Vec<u8> },
    /// `MSG` or `HMSG` of a consumer of JetStream: an entry of a watch.
    Entry,
    /// Another `MSG` or `HMSG`: a reply.
    Message,
    /// A line without a payload.
    Other,
}

/// Cuts a stream of bytes into frames.
#[derive(Debug, Default)]
pub(crate) struct Frames {
    buffer: Vec<u8>,
}

impl Frames {
    pub(crate) fn push(&mut self, bytes: &[u8]) {
        self.buffer.extend_from_slice(bytes);
    }

    /// The next whole frame.
    pub(crate) fn next(&mut self) -> Option<Frame> {
        let end = self.buffer.windows(2).position(|pair| pair == b"\r\n")?;
        let line = String::from_utf8_lossy(&self.buffer[..end]).into_owned();
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        let operation = words.first().map(|word| word.to_ascii_uppercase()).unwrap_or_default();
        let number = |from_end: usize| words[words.len() - from_end].parse::<usize>().unwrap();
        // The length of the payload with its headers, and that of the headers.
        let (total, headers) = match operation.as_str() {
            "PUB" | "MSG" => (number(1), 0),
            "HPUB" | "HMSG" => (number(1), number(2)),
            _ => return Some(Frame { bytes: self.buffer.drain(..end + 2).collect(), kind: Kind::Other }),
        };
        let start = end + 2;
        let length = start + total + 2;
        if self.buffer.len() < length {
            return None;
        }
        let bytes: Vec<u8> = self.buffer.drain(..length).collect();
        let is_entry = words.iter().any(|word| word.starts_with("$JS.ACK."));
        let kind = match operation.as_str() {
            "PUB" | "HPUB" => {
                Kind::Publish { subject: words[1].to_owned(), payload: bytes[start + headers..start + total].to_vec() }
            }
            _ if is_entry => Kind::Entry,
            _ => Kind::Message,
        };
        Some(Frame { bytes, kind })
    }
}

#[test]
fn frames_are_cut_at_their_ends() {
    let stream: &[u8] = b"CONNECT {}\r\nPING\r\nPUB a.b _INBOX.1 5\r\n\r\n\r\nx\r\n\
        HPUB $KV.leases.l.p r 12 15\r\nNATS/1.0\r\n\r\nabc\r\nPUB e 0\r\n\r\n\
        MSG _INBOX.1 7 $JS.ACK.KV.x 2\r\nok\r\nHMSG _INBOX.2 7 12 12\r\nNATS/1.0\r\n\r\n\r\n+OK\r\n";
    let publish = |subject: &str, payload: &[u8]| Kind::Publish { subject: subject.into(), payload: payload.into() };
    let kinds = [
        Kind::Other,
        Kind::Other,
        publish("a.b", b"\r\n\r\nx"),
        publish("$KV.leases.l.p", b"abc"),
        publish("e", b""),
        Kind::Entry,
        Kind::Message,
        Kind::Other,
    ];
    // In any pieces.
    for size in 1..40 {
        let (mut frames, mut all) = (Frames::default(), Vec::new());
        for piece in stream.chunks(size) {
            frames.push(piece);
            all.extend(std::iter::from_fn(|| frames.next()));
        }
        assert_eq!(all.iter().map(|frame| frame.kind.clone()).collect::<Vec<_>>(), kinds);
        assert_eq!(all.into_iter().flat_map(|frame| frame.bytes).collect::<Vec<_>>(), stream);
    }
}
