//! Steps of a case.

/// A step of a case. Small numbers select among what exists at that moment.
#[derive(Clone, Debug)]
pub(crate) enum Op {
    /// Starts a call. Bits of the options: 0 and 1 retries, 2 `retry_writes`, 3 double response
    /// timeout, 4 short deadline.
    Call { station: u8, kind: CallKind, option_bits: u8 },
    /// Drops one of the calls in progress.
    Cancel(u8),
    /// The PLC answers the last request, or the one `late` requests before it.
    Answer { late: u8, refusal: u8 },
    /// The PLC answers the last request with a corrupt frame.
    Corrupt(Corruption),
    /// Arbitrary bytes arrive.
    Noise(Vec<u8>),
    /// The rest of a partial frame arrives.
    Release,
    /// The line echoes the last request.
    Echo,
    /// Time passes, in milliseconds.
    Wait(u16),
    /// The connection is lost.
    Lose,
    /// The next write fails, and with it the connection.
    LoseOnWrite,
    /// Outcome of the next connection attempts.
    Connecting(ConnectOutcome),
    /// A copy of the last answer, or of an earlier one, arrives.
    Copy(u8),
    /// A second answer to the last answered request: a refusal after a value, or a value after a
    /// refusal.
    SecondAnswer(u8),
    /// A reply to a request of an earlier process. It matches the newest call of the station.
    LeftOver { station: u8, refusal: u8 },
    /// A station answers the last broadcast, under its own number or as station 0.
    AnswerBroadcast { station: u8, refusal: u8 },
    /// Sets the commands that the PLC does not support, as bits of [`UNSUPPORTED`].
    Unsupported(u8),
    /// Several frames arrive in one read.
    Coalesced(Coalesced),
    /// The PLC answers and closes the connection.
    AnswerAndLose,
}

/// Commands that a PLC may not support, by the bits of [`Op::Unsupported`].
pub(crate) const UNSUPPORTED: [u8; 4] = [0x4E, 0x48, 0x49, 0x40];

/// Frames that arrive in one read.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Coalesced {
    /// A copy of the last answer, and the next answer.
    CopyFirst,
    /// An answer, and a different second one.
    SecondBehind,
    /// An answer, and a copy of the one before it.
    CopyBehind,
}

#[derive(Clone, Copy, Debug)]
pub(crate) enum CallKind {
    /// Reads `n % 8 + 1` registers.
    Read(u8),
    Write,
    Run,
    Stop,
    Broadcast,
    /// Broadcasts RUN.
    BroadcastRun,
    /// Reads a list of `n % 8 + 1` scattered registers.
    Mixed(u8),
    /// Reads a program page; all odd ones have equal content. In the binary framing, reads a
    /// register.
    Page(u8),
}

/// How an answer is corrupted.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Corruption {
    Station(u8),
    Command(u8),
    Shorter,
    Longer,
    Checksum,
    /// Only the first bytes arrive; the rest is held back.
    Begun(u8),
    /// The frame arrives twice in one piece.
    Doubled,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ConnectOutcome {
    Accepted,
    Refused,
    Unanswered,
}

impl Op {
    /// Decodes a step from fuzzer input. Every input is valid; `None` at its end.
    #[allow(dead_code, reason = "for the fuzzer, whose runs are bytes")]
    pub(crate) fn from_bytes(bytes: &mut impl Iterator<Item = u8>) -> Option<Self> {
        let choice = bytes.next()?;
        let mut next = || bytes.next().unwrap_or_default();
        Some(match choice % 32 {
            0..=2 => {
                let (shape, option_bits) = (next(), next());
                let kind = match shape >> 2 & 7 {
                    0..=2 => CallKind::Read(shape >> 5),
                    3 | 4 => CallKind::Write,
                    5 => CallKind::Run,
                    6 => CallKind::Stop,
                    _ if shape >> 7 == 1 => CallKind::BroadcastRun,
                    _ => CallKind::Broadcast,
                };
                Self::Call { station: shape & 3, kind, option_bits }
            }
            3 => Self::Cancel(next()),
            4 | 5 => Self::Answer { late: 0, refusal: 0 },
            6 => {
                let shape = next();
                Self::Answer { late: shape & 7, refusal: shape >> 4 }
            }
            7 => Self::Corrupt(match choice >> 5 & 7 {
                0 => Corruption::Station(next()),
                1 => Corruption::Command(next()),
                2 => Corruption::Shorter,
                3 => Corruption::Longer,
                4 => Corruption::Checksum,
                5 => Corruption::Doubled,
                _ => Corruption::Begun(next()),
            }),
            8 => {
                let len = next() % 24;
                Self::Noise((0..len).map(|_| next()).collect())
            }
            9 => Self::Release,
            10 => Self::Echo,
            11 => Self::Wait(u16::from(next() % 32)),
            12 => Self::Wait(u16::from(next()) * 4),
            13 => Self::Lose,
            14 => Self::LoseOnWrite,
            15 => Self::Connecting(match choice >> 5 & 3 {
                0 => ConnectOutcome::Refused,
                1 => ConnectOutcome::Unanswered,
                _ => ConnectOutcome::Accepted,
            }),
            16..=18 => Self::Copy(choice >> 5 & 1),
            19 | 20 => Self::SecondAnswer(next()),
            21 | 22 => {
                let shape = next();
                let (station, refusal) = (shape & 3, shape >> 4);
                if choice % 32 == 21 {
                    Self::LeftOver { station, refusal }
                } else {
                    Self::AnswerBroadcast { station, refusal }
                }
            }
            23 => Self::Unsupported(next() & 15),
            24 | 25 => Self::Coalesced(match choice >> 5 & 3 {
                0 | 1 => Coalesced::CopyFirst,
                2 => Coalesced::SecondBehind,
                _ => Coalesced::CopyBehind,
            }),
            26 => Self::AnswerAndLose,
            27 | 28 => {
                let (shape, option_bits) = (next(), next());
                let number = shape >> 3;
                let kind = if shape >> 2 & 1 == 0 { CallKind::Mixed(number) } else { CallKind::Page(number) };
                Self::Call { station: shape & 3, kind, option_bits }
            }
            _ => Self::Answer { late: 0, refusal: 0 },
        })
    }
}
