//! Steps of a run.

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
    /// The last answer, or one before it, comes once more.
    Copy(u8),
    /// A second answer to the request that was answered last: a refusal after a value, and the other way round.
    Second(u8),
    /// The reply to a request that an earlier process made before this connection was opened: one that fits the newest call
    /// of this station.
    LeftOver {
        station: u8,
        refusal: u8,
    },
    /// A station answers the last broadcast, under its own number or as station 0.
    Broadcasted {
        station: u8,
        refusal: u8,
    },
    /// Commands that the PLC does not know from now on: see [`LACKS`].
    Lacks(u8),
    /// Several frames in one read.
    Together(Together),
    /// The PLC answers, and the connection is closed.
    AnswerAndLose,
}

/// Commands that a PLC may lack, by the bits of [`Op::Lacks`].
pub(crate) const LACKS: [u8; 4] = [0x4E, 0x48, 0x49, 0x40];

/// Frames of one read.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Together {
    /// A copy of the last answer, then the next answer.
    CopyFirst,
    /// An answer, then a second one that differs.
    SecondBehind,
    /// An answer, then a copy of the one before it.
    CopyBehind,
}

#[derive(Clone, Copy, Debug)]
pub(crate) enum Kind {
    /// So many registers, at least one.
    Read(u8),
    Write,
    Run,
    Stop,
    Broadcast,
    /// RUN to all stations.
    BroadcastRun,
    /// A list of so many registers, at least one.
    Mixed(u8),
    /// A page of the program; all odd ones have the same content. In the binary framing, which has none, a read.
    Page(u8),
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
        Some(match choice % 32 {
            0..=2 => {
                let (shape, patience) = (next(), next());
                let kind = match shape >> 2 & 7 {
                    0..=2 => Kind::Read(shape >> 5),
                    3 | 4 => Kind::Write,
                    5 => Kind::Run,
                    6 => Kind::Stop,
                    _ if shape >> 7 == 1 => Kind::BroadcastRun,
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
            7 => Self::Spoilt(match choice >> 5 & 7 {
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
            15 => Self::Connecting(match choice >> 5 & 3 {
                0 => Connecting::Refused,
                1 => Connecting::Unanswered,
                _ => Connecting::Accepted,
            }),
            16..=18 => Self::Copy(choice >> 5 & 1),
            19 | 20 => Self::Second(next()),
            21 | 22 => {
                let shape = next();
                let (station, refusal) = (shape & 3, shape >> 4);
                if choice % 32 == 21 {
                    Self::LeftOver { station, refusal }
                } else {
                    Self::Broadcasted { station, refusal }
                }
            }
            23 => Self::Lacks(next() & 15),
            24 | 25 => Self::Together(match choice >> 5 & 3 {
                0 | 1 => Together::CopyFirst,
                2 => Together::SecondBehind,
                _ => Together::CopyBehind,
            }),
            26 => Self::AnswerAndLose,
            27 | 28 => {
                let (shape, patience) = (next(), next());
                let number = shape >> 3;
                let kind = if shape >> 2 & 1 == 0 { Kind::Mixed(number) } else { Kind::Page(number) };
                Self::Call { station: shape & 3, kind, patience }
            }
            _ => Self::Answer { late: 0, refusal: 0 },
        })
    }
}
