//! A set of commands.

use super::Code;

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(crate) struct CommandSet(u32);

impl CommandSet {
    pub(crate) const NONE: Self = Self(0);

    pub(crate) fn contains(self, code: Code) -> bool {
        self.0 & Self::bit(code) != 0
    }

    pub(crate) fn insert(&mut self, code: Code) {
        self.0 |= Self::bit(code);
    }

    pub(crate) fn remove(&mut self, code: Code) {
        self.0 &= !Self::bit(code);
    }

    #[must_use]
    pub(crate) fn and(self, others: Self) -> Self {
        Self(self.0 | others.0)
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
