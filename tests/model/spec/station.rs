//! The rule of docs/DESIGN.md, "In step", for one station.

use std::collections::BTreeSet;

use super::super::state::{Held, Micros, Probe, Rules, Sort, Wire};

/// What is known of a station.
#[derive(Debug)]
pub(crate) struct Station {
    /// Any frame may come: only a check goes out, and only its echo or silence ends it.
    pub(crate) suspect: bool,
    /// 4E was refused without proof since the last proof.
    pub(crate) refused: bool,
    /// The reply that was taken last, while a copy of it may come.
    owed: Option<Owed>,
    /// Commands of broadcasts that the station may answer.
    broadcasts: BTreeSet<u8>,
    /// Command and data of the reply that was taken last.
    last: Option<(u8, Vec<u8>)>,
    /// Registers that the station has shown to have.
    pub(crate) answered: BTreeSet<u16>,
    /// The latest event that restarts the silence: a frame, a timeout, a new connection.
    pub(crate) heard: Micros,
    /// The slowest of recent exchanges.
    slowest: Micros,
    pub(crate) timeouts: u32,
    pub(crate) offline: Option<Probe>,
    /// The longest response timeout that it was ever given.
    pub(crate) allowed: Micros,
}

/// The shape of a positive reply. A refusal fits every size of its command.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Shape {
    pub(crate) command: u8,
    pub(crate) size: usize,
}

#[derive(Debug)]
struct Owed {
    shape: Shape,
    refused: bool,
    data: Vec<u8>,
    heard: Micros,
    window: Micros,
}

/// What of the owed frames could answer a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Threat {
    None,
    Refusal,
    Reply,
}

impl Default for Station {
    fn default() -> Self {
        Self {
            suspect: true,
            refused: false,
            owed: None,
            broadcasts: BTreeSet::new(),
            last: None,
            answered: BTreeSet::new(),
            heard: 0,
            slowest: 0,
            timeouts: 0,
            offline: None,
            allowed: 0,
        }
    }
}

impl Station {
    /// Anything may come from now on.
    pub(crate) fn doubt(&mut self, at: Micros) {
        self.suspect = true;
        self.heard = at;
    }

    pub(crate) fn reconnected(&mut self, at: Micros) {
        self.doubt(at);
        self.refused = false;
    }

    /// A frame that no request takes.
    pub(crate) fn stray(&mut self, command: u8, data: &[u8], at: Micros) {
        self.heard = at;
        if let Some(owed) = &mut self.owed {
            owed.heard = at;
        }
        let is_copy = self.last.as_ref().is_some_and(|(last, content)| (*last, &content[..]) == (command, data));
        self.suspect |= !is_copy;
    }

    pub(crate) fn broadcast(&mut self, command: u8, at: Micros) {
        self.broadcasts.insert(command);
        self.heard = at;
    }

    /// What a taken reply owes lapses in a silence.
    pub(crate) fn lapse(&mut self, at: Micros) {
        self.owed.take_if(|owed| at >= owed.heard + owed.window);
    }

    pub(crate) fn threat(&self, shape: Shape) -> Threat {
        let taken = match &self.owed {
            Some(owed) if owed.shape == shape => Threat::Reply,
            Some(owed) if owed.shape.command == shape.command => Threat::Refusal,
            _ => Threat::None,
        };
        if self.broadcasts.contains(&shape.command) { Threat::Reply } else { taken }
    }

    /// Whether a request of this shape may go out, as far as that is a matter of what is owed.
    pub(crate) fn allows(&self, sort: Sort, shape: Shape) -> bool {
        match sort {
            Sort::Once => self.threat(shape) == Threat::None,
            Sort::Read => self.threat(shape) <= Threat::Refusal,
            Sort::Page => true,
        }
    }

    /// Whether a reply is proven to be that to the request of this shape.
    pub(crate) fn proves(&self, sort: Sort, shape: Shape, held: &Held) -> bool {
        let threat = self.threat(shape);
        match sort {
            Sort::Once => true,
            _ if self.suspect => false,
            _ if held.answer.is_err() => threat == Threat::None,
            Sort::Read => true,
            Sort::Page => {
                threat == Threat::None || self.owed.as_ref().is_some_and(|owed| !owed.refused && owed.data != held.data)
            }
        }
    }

    /// The reply to what was on the wire was taken: it may come again, and nothing older may.
    pub(crate) fn taken(&mut self, wire: &Wire, shape: Shape, held: &Held, rules: &Rules, at: Micros) {
        self.slowest = (at - wire.sent).max(self.slowest * 7 / 8);
        let window = rules.window.max(2 * self.slowest);
        let refused = held.answer.is_err();
        self.owed = Some(Owed { shape, refused, data: held.data.clone(), heard: at, window });
        self.broadcasts.clear();
        self.last = Some((shape.command, held.data.clone()));
        self.heard = at;
    }

    /// A check was answered: whether that proves anything.
    pub(crate) fn checked(&mut self, wire: &Wire, shape: Shape, held: &Held, rules: &Rules, at: Micros) -> bool {
        let refused = held.answer.is_err();
        let echo = shape.command == 0x4E && shape.size > 0 && !refused;
        let unproven = self.suspect || refused && self.threat(shape) > Threat::None;
        let proof = echo || !unproven;
        self.heard = at;
        if !proof {
            self.refused |= shape.command == 0x4E && refused;
            return false;
        }
        if echo {
            self.suspect = false;
        }
        self.refused = false;
        self.taken(wire, shape, held, rules, at);
        true
    }

    /// It was silent for the quiet time, which proves it in step.
    pub(crate) fn was_silent(&mut self) {
        (self.suspect, self.refused, self.owed) = (false, false, None);
        self.broadcasts.clear();
    }

    pub(crate) fn quiet(&self, rules: &Rules) -> Micros {
        rules.quiet.max(self.allowed)
    }
}
