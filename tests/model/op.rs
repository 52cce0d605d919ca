//! What a run is made of.

/// A step of a run. Small numbers choose among what there is.
#[derive(Clone, Debug)]
pub(crate) enum Op {
    Call {
        station: u8,
        kind: Kind,
        patience: u8,
    },
    /// Drops one of the calls that have not ended.
    Cancel(u8),
    /// The PLC answers what was asked last, or so many requests before that.
    Answer {
        late: u8,
        refusal: u8,
    },
    /// Something like the answer to what was asked last.
    Spoilt(Spoilt),
    /// Bytes, whatever they are.
    Noise(Vec<u8>),
    /// What has been held back comes.
    Rest,
    /// The line sends back what was asked last.
    Echo,
    /// So many milliseconds pass.
    Wait(u16),
    /// The connection is lost.
    Lose,
    /// The next write fails, and with it the connection.
    LoseOnWrite,
    /// What becomes of the next attempts to connect.
    Connecting(Connecting),
}

#[derive(Clone, Copy, Debug)]
pub(crate) enum Kind {
    /// So many registers, at least one.
    Read(u8),
    Write,
    Run,
    Stop,
    Broadcast,
}

/// How an answer is wrong.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Spoilt {
    Station(u8),
    Command(u8),
    Shorter,
    Longer,
    Checksum,
    /// The first so many bytes; the others are held back.
    Begun(u8),
    /// It comes twice.
    Doubled,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Connecting {
    Accepted,
    Refused,
    Unanswered,
}

impl Op {
    /// The step that these bytes stand for: any do, and at the end of the input there is none.
    #[allow(dead_code, reason = "for the fuzzer, whose runs are bytes")]
    pub(crate) fn from_bytes(bytes: &mut impl Iterator<Item = u8>) -> Option<Self> {
        let choice = bytes.next()?;
        let mut next = || bytes.next().unwrap_or_default();
        Some(match choice % 16 {
            0..=2 => {
                let (shape, patience) = (next(), next());
                let kind = match shape >> 2 & 7 {
                    0..=2 => Kind::Read(shape >> 5),
                    3 | 4 => Kind::Write,
                    5 => Kind::Run,
                    6 => Kind::Stop,
                    _ => Kind::Broadcast,
                };
                Self::Call { station: shape & 3, kind, patience }
            }
            3 => Self::Cancel(next()),
            4 | 5 => Self::Answer { late: 0, refusal: 0 },
            6 => {
                let shape = next();
                Self::Answer { late: shape & 7, refusal: shape >> 4 }
            }
            7 => Self::Spoilt(match choice >> 4 & 7 {
                0 => Spoilt::Station(next()),
                1 => Spoilt::Command(next()),
                2 => Spoilt::Shorter,
                3 => Spoilt::Longer,
                4 => Spoilt::Checksum,
                5 => Spoilt::Doubled,
                _ => Spoilt::Begun(next()),
            }),
            8 => {
                let len = next() % 24;
                Self::Noise((0..len).map(|_| next()).collect())
            }
            9 => Self::Rest,
            10 => Self::Echo,
            11 => Self::Wait(u16::from(next() % 32)),
            12 => Self::Wait(u16::from(next()) * 4),
            13 => Self::Lose,
            14 => Self::LoseOnWrite,
            _ => Self::Connecting(match choice >> 4 & 3 {
                0 => Connecting::Refused,
                1 => Connecting::Unanswered,
                _ => Connecting::Accepted,
            }),
        })
    }
}
