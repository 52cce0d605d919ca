//! A set of commands.

use crate::command::Code;

#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct CommandSet(u32);

impl CommandSet {
    pub(super) const NONE: Self = Self(0);

    pub(super) fn contains(self, code: Code) -> bool {
        self.0 & Self::bit(code) != 0
    }

    pub(super) fn insert(&mut self, code: Code) {
        self.0 |= Self::bit(code);
    }

    /// The commands are 40h to 5Fh.
    fn bit(code: Code) -> u32 {
        1_u32.wrapping_shl(u8::from(code).into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_command_has_a_bit_of_its_own() {
        for (n, &code) in Code::ALL.iter().enumerate() {
            let mut codes = CommandSet::NONE;
            codes.insert(code);
            let found: Vec<_> = Code::ALL.iter().filter(|&&other| codes.contains(other)).collect();
            assert_eq!(found, [&Code::ALL[n]]);
        }
    }
}
