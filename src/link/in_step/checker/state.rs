//! States of client, line and PLC.

use super::frame::{Frame, NONCES};
use super::jobs::ModelJob;
use super::requests::Name;
use crate::command::CommandSet;
use crate::command::Spelling;
use crate::link::in_step::{Check, InStep, Proof, Shape, Why};

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Asked {
    Call(Name),
    Check { check: Check, confirms: bool },
}

/// The request on the wire.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct Out {
    pub(super) asked: Asked,
    pub(super) spelling: Spelling,
    pub(super) shape: Shape,
    /// Sent for the job.
    pub(super) in_job: bool,
}

#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub(super) struct ModelState {
    pub(super) in_step: InStep,
    pub(super) out: Option<Out>,
    /// Frames on their way, in order.
    pub(super) channel: Vec<Frame>,
    /// Roaming duplicates, with the number of exchanges left to each.
    pub(super) roaming: Vec<(Frame, u8)>,
    /// Duplicates, losses, late replies, broadcasts and reconnects left.
    pub(super) budget: [u8; 5],
    /// Number of wrong results so far.
    pub(super) wrong: u8,
    pub(super) job: Option<ModelJob>,
}

pub(super) const COPIES: usize = 0;
pub(super) const LOSS: usize = 1;
pub(super) const LATE: usize = 2;
pub(super) const BROADCASTS: usize = 3;
pub(super) const RECONNECTS: usize = 4;

impl ModelState {
    /// Ends the exchange: frames on their way answer no request on the wire.
    pub(super) fn ends(&mut self) {
        self.out = None;
        self.channel.iter_mut().for_each(|frame| frame.own = false);
        self.roaming.iter_mut().for_each(|(frame, _)| frame.own = false);
    }

    pub(super) fn on_its_way(&self) -> impl Iterator<Item = &Frame> {
        self.channel.iter()
    }

    pub(super) fn spends(&self, what: usize) -> Option<Self> {
        let mut after = self.clone();
        after.budget[what] = self.budget[what].checked_sub(1)?;
        Some(after)
    }

    /// Normalises what makes equal states differ: reasons, the numbers of nonces, and counters that
    /// no job reads.
    pub(super) fn canonical(mut self) -> Self {
        let in_step = &mut self.in_step;
        in_step.silent_since = None;
        in_step.suspect = in_step.suspect.map(|_| Why::Connected);
        if self.job.is_none() {
            (in_step.timed_out, in_step.proof) = (CommandSet::NONE, Proof::default());
        }
        in_step.proof.proofs = in_step.proof.proofs.min(1);
        in_step.proof.doubts = in_step.proof.doubts.min(1);
        in_step.strays = 0;
        self.rename_nonces();
        self
    }

    fn rename_nonces(&mut self) {
        let mut names = Vec::new();
        let mut size = |size: &mut u32| {
            if *size >= NONCES {
                let name = names.iter().position(|name| name == size).unwrap_or_else(|| {
                    names.push(*size);
                    names.len() - 1
                });
                *size = NONCES + u32::try_from(name).unwrap();
            }
        };
        if let Some(out) = &mut self.out {
            size(&mut out.shape.size);
        }
        self.channel
            .iter_mut()
            .chain(self.roaming.iter_mut().map(|(frame, _)| frame))
            .for_each(|frame| size(&mut frame.size));
        let mut fingerprint = |fingerprint: &mut u64| {
            let mut renamed = u32::try_from(*fingerprint >> 8 & 0xFFFF_FFFF).unwrap();
            size(&mut renamed);
            *fingerprint = *fingerprint & !(0xFFFF_FFFF << 8) | u64::from(renamed) << 8;
        };
        let in_step = &mut self.in_step;
        in_step.last.iter_mut().for_each(&mut fingerprint);
        for taken in in_step.taken.iter_mut().chain(&mut in_step.older) {
            taken.fingerprint.iter_mut().for_each(&mut fingerprint);
        }
        in_step.taken.iter_mut().chain(&mut in_step.older).for_each(|taken| size(&mut taken.shape.size));
    }
}
