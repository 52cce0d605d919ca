//! The requests of the model: real commands with their real spellings, in the ASCII framing.

use crate::command::{
    Candidates, Class, Code, Command, ControlPlc, ReadProgramPage, ReadRegisters, ReadStatus, Run, Spelling,
    WriteRegisters,
};
use crate::element::Register;
use crate::link::in_step::{Kind, Shape, Spelled};
use crate::wire::Framing;

/// A call of the model.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Name {
    /// 64 registers of a longer read: 46/64, 46/63, 48/64.
    Read,
    /// One register: 46/1, 46/2 if the second was answered before, 48/1.
    One,
    /// Two registers: 47, 49.
    Write,
    /// 4F: one spelling, and two possible contents.
    Page,
    /// 41: one spelling.
    Run,
    /// 40: one spelling, and the check that replaces a refused 4E.
    Status,
}

impl Name {
    pub(super) const ALL: [Self; 6] = [Self::Read, Self::One, Self::Write, Self::Page, Self::Run, Self::Status];
}

/// A request as the core describes it to the rule.
#[derive(Debug)]
pub(in crate::link::in_step) struct Request {
    kind: Kind,
    plain: Spelling,
    candidates: Candidates,
    shapes: Vec<(Spelling, Shape)>,
    pub(in crate::link::in_step) run: Option<Run>,
}

impl Request {
    pub(super) fn of(name: Name) -> Self {
        let first = Register::r(0);
        match name {
            Name::Read => Self::new(&ReadRegisters::new(first, 64).unwrap(), true),
            Name::One => Self::new(&ReadRegisters::new(first, 1).unwrap(), false),
            Name::Write => Self::new(&WriteRegisters::new(first, [1, 2]).unwrap(), false),
            Name::Page => Self::new(&ReadProgramPage::new(0), false),
            Name::Run => Self::new(&ControlPlc::Run, false),
            Name::Status => Self::new(&ReadStatus, false),
        }
    }

    pub(in crate::link::in_step) fn new<C: Command>(command: &C, longer: bool) -> Self {
        let framing = Framing::Ascii;
        let (plain, candidates) = (command.plain(), command.candidates(longer, framing));
        let spellings = [plain].into_iter().chain(candidates.iter().flatten().map(|candidate| candidate.spelling));
        let shape = |spelling: Spelling| Shape { code: spelling.code, size: command.reply_size(spelling, framing) };
        let is_read = C::CODE.class() == Class::Read;
        let kind = match C::CODE {
            Code::ReadProgramPage => Kind::Page,
            _ if is_read && !command.is_like_a_refusal() => Kind::Read,
            _ => Kind::Once,
        };
        let shapes = spellings.map(|spelling| (spelling, shape(spelling))).collect();
        Self { kind, plain, candidates, shapes, run: command.run().filter(|_| is_read) }
    }
}

impl Spelled for Request {
    fn kind(&self) -> Kind {
        self.kind
    }

    fn plain(&self) -> Spelling {
        self.plain
    }

    fn candidates(&self) -> Candidates {
        self.candidates
    }

    fn shape(&self, spelling: Spelling) -> Shape {
        self.shapes.iter().find(|(known, _)| *known == spelling).unwrap().1
    }
}
