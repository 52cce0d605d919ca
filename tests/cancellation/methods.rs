//! All methods that send requests, each with its call, its request and its result.

use bytes::BytesMut;
use fatek::command::{
    BriefStatus, ControlDiscrete, ControlPlc, DetailedStatus, DiscreteControl, ForwardedReply, LoopBack, ProgramPage,
    ReadDetailedStatus, ReadDisabled, ReadDiscretes, ReadMixed, ReadProgramPage, ReadRegisters, ReadStatus, Request,
    WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use fatek::wire::{AsciiCodec, Frame, Framing};
use fatek::{Discrete, Error, Link, Register, Station, Value};
use futures::FutureExt;
use tokio_util::codec::Encoder;

use crate::bench::{Call, station};
use crate::elements::{d, dd, double, dr, m, page, r, word, words, x};

/// A method that sends a request. Arguments depend on the turn; all turns have the same shape.
pub(crate) struct Method {
    pub(crate) name: &'static str,
    pub(crate) kind: MethodKind,
    pub(crate) call: fn(&Link, u16) -> Call,
    pub(crate) request: fn(u16) -> Request,
    pub(crate) reply: fn(u16) -> String,
}

#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum MethodKind {
    Read,
    Write,
    Broadcast,
}

/// Reads into memory of the caller, with the memory.
trait IntoMemory {
    async fn registers_into(&self, first: Register, count: usize) -> Result<Vec<u16>, Error>;
    async fn discretes_into(&self, first: Discrete, count: usize) -> Result<Vec<bool>, Error>;
}

impl IntoMemory for Station {
    async fn registers_into(&self, first: Register, count: usize) -> Result<Vec<u16>, Error> {
        let mut values = vec![0xAAAA; count];
        self.read_registers_into(first, &mut values).await.map(|()| values)
    }

    async fn discretes_into(&self, first: Discrete, count: usize) -> Result<Vec<bool>, Error> {
        let mut states = vec![true; count];
        self.read_discretes_into(first, &mut states).await.map(|()| states)
    }
}

macro_rules! methods {
    ($kind:ident by $handle:expr;
     $(|$n:ident| $name:ident($($argument:expr),*) $(seen as $view:ident)?
        => $request:ident($command:expr), $reply:expr;)*) => {
        vec![$(Method {
            name: stringify!($name),
            kind: MethodKind::$kind,
            call: |link, $n| {
                let _ = $n; // not all have arguments
                let handle = $handle(link);
                async move {
                    let reply = handle.$name($($argument),*).await?;
                    $(let reply = $view(&reply);)?
                    Ok(format!("{reply:?}"))
                }
                .boxed()
            },
            request: |$n| {
                let _ = $n;
                Request::$request($command)
            },
            reply: |$n| {
                let _ = $n;
                format!("{:?}", $reply)
            },
        }),*]
    };
}

pub(crate) fn reads() -> Vec<Method> {
    // The battery is full during the first turn only.
    let mut methods = methods! { Read by station;
        |n| read_status() seen as brief => ReadStatus(ReadStatus), n == 2;
        |n| read_detailed_status() seen as detailed => ReadDetailedStatus(ReadDetailedStatus), n == 2;
        |n| read_disabled(x(16 * n), 3)
            => ReadDisabled(ReadDisabled::new(x(16 * n), 3).unwrap()), [n == 1, n == 2, false];
        |n| read_discretes(m(16 * n), 3)
            => ReadDiscretes(ReadDiscretes::new(m(16 * n), 3).unwrap()), [n == 1, n == 2, false];
        |n| read_registers(d(100 * n), 3) => ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap()), words(100 * n);
        |n| registers_into(d(100 * n), 3) => ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap()), words(100 * n);
        |n| discretes_into(m(16 * n), 3)
            => ReadDiscretes(ReadDiscretes::new(m(16 * n), 3).unwrap()), [n == 1, n == 2, false];
        |n| call(ReadRegisters::new(d(100 * n), 3).unwrap())
            => ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap()), words(100 * n);
        |n| forward(Request::ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap())) seen as frame
            => ReadRegisters(ReadRegisters::new(d(100 * n), 3).unwrap()), data_frame(0x46, &words(100 * n));
        |n| read_registers32(dd(100 * n), 1)
            => ReadRegisters32(ReadRegisters::new(dd(100 * n), 1).unwrap()), [double(100 * n)];
        |n| read_mixed(&[d(100 * n).into(), dd(100 * n + 1).into()])
            => ReadMixed(ReadMixed::new([d(100 * n).into(), dd(100 * n + 1).into()]).unwrap()),
            [Value::Word(word(1, 100 * n)), Value::DWord(double(100 * n + 1))];
        |n| loop_back(format!("turn {n}")) => LoopBack(LoopBack::new(format!("turn {n}")).unwrap()), ();
        |n| read_program_page(n) seen as first_word => ReadProgramPage(ReadProgramPage::new(n)), n;
    };
    for method in &mut methods {
        method.name = match method.name {
            "registers_into" => "read_registers_into",
            "discretes_into" => "read_discretes_into",
            name => name,
        };
    }
    methods
}

pub(crate) fn writes() -> Vec<Method> {
    methods! { Write by station;
        |n| run() => ControlPlc(ControlPlc::Run), ();
        |n| stop() => ControlPlc(ControlPlc::Stop), ();
        |n| disable(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Disable, m(n))), ();
        |n| enable(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Enable, m(n))), ();
        |n| set(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, m(n))), ();
        |n| reset(m(n)) => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Reset, m(n))), ();
        |n| write_discretes(m(n), &[true; 3]) => WriteDiscretes(WriteDiscretes::new(m(n), [true; 3]).unwrap()), ();
        |n| write_registers(r(n), &[n; 3]) => WriteRegisters(WriteRegisters::new(r(n), [n; 3]).unwrap()), ();
        |n| write_registers32(dr(n), &[n.into()])
            => WriteRegisters32(WriteRegisters::new(dr(n), [n.into()]).unwrap()), ();
        |n| write_mixed(&[(r(n).into(), n.into())])
            => WriteMixed(WriteMixed::new([(r(n).into(), n.into())]).unwrap()), ();
        |n| forward(Request::WriteRegisters(WriteRegisters::new(r(n), [n; 2]).unwrap())) seen as frame
            => WriteRegisters(WriteRegisters::new(r(n), [n; 2]).unwrap()), data_frame(0x47, &[]);
        |n| write_program_page(n, &page(n)) => WriteProgramPage(WriteProgramPage::new(n, page(n))), ();
    }
}

pub(crate) fn broadcasts() -> Vec<Method> {
    methods! { Broadcast by Link::broadcast;
        |n| run() => ControlPlc(ControlPlc::Run), ();
        |n| stop() => ControlPlc(ControlPlc::Stop), ();
        |n| control(DiscreteControl::Set, m(n))
            => ControlDiscrete(ControlDiscrete::new(DiscreteControl::Set, m(n))), ();
        |n| write_discretes(m(n), &[true; 3]) => WriteDiscretes(WriteDiscretes::new(m(n), [true; 3]).unwrap()), ();
        |n| write_registers(r(n), &[n; 3]) => WriteRegisters(WriteRegisters::new(r(n), [n; 3]).unwrap()), ();
        |n| write_registers32(dr(n), &[n.into()])
            => WriteRegisters32(WriteRegisters::new(dr(n), [n.into()]).unwrap()), ();
        |n| write_mixed(&[(r(n).into(), n.into())])
            => WriteMixed(WriteMixed::new([(r(n).into(), n.into())]).unwrap()), ();
        |n| forward(Request::WriteRegisters(WriteRegisters::new(r(n), [n; 2]).unwrap()))
            => WriteRegisters(WriteRegisters::new(r(n), [n; 2]).unwrap()), ();
    }
}

pub(crate) fn first_word(page: &ProgramPage) -> u16 {
    page.words()[0]
}

pub(crate) fn brief(status: &BriefStatus) -> bool {
    status.flags().battery_low()
}

pub(crate) fn detailed(status: &DetailedStatus) -> bool {
    status.flags().battery_low()
}

/// Encodes a reply as a gateway does.
fn frame(answer: &ForwardedReply) -> BytesMut {
    let mut frame = BytesMut::new();
    answer.encode(Framing::Ascii, 1, &mut frame);
    frame
}

/// Encodes the same reply by hand: no error, and these words.
fn data_frame(command: u8, words: &[u16]) -> BytesMut {
    let data = words.iter().map(|word| format!("{word:04X}"));
    let data = std::iter::once("0".to_owned()).chain(data).collect::<String>();
    let mut bytes = BytesMut::new();
    AsciiCodec::new().encode(Frame { station: 1, command, data: data.into() }, &mut bytes).unwrap();
    bytes
}
