use std::fmt;

use super::ElementError;

// One row an element, as in the manuals' table: the check against the standard is to read this.
//
// - digits: decimal digits of the address in the ASCII framing
// - last:   the largest address
// - step:   the distance to the next consecutive element
// - align:  addresses must be a multiple of it
symbols! {
    // width  symbol  digits  last  step  align
    Bit     X    4   9999   1  1;
    Bit     Y    4   9999   1  1;
    Bit     M    4   9999   1  1;
    Bit     S    4   9999   1  1;
    Bit     T    4   9999   1  1;
    Bit     C    4   9999   1  1;

    Word    WX   4   9984  16  8;
    Word    WY   4   9984  16  8;
    Word    WM   4   9984  16  8;
    Word    WS   4   9984  16  8;
    Word    WT   4   9984  16  8;
    Word    WC   4   9984  16  8;
    Word    RT   4   9999   1  1;
    Word    RC   4   9999   1  1;
    Word    R    5  65535   1  1;
    Word    D    5  65535   1  1;
    Word    F    5  65535   1  1;

    Double  DWX  4   9968  32  8;
    Double  DWY  4   9968  32  8;
    Double  DWM  4   9968  32  8;
    Double  DWS  4   9968  32  8;
    Double  DWT  4   9968  32  8;
    Double  DWC  4   9968  32  8;
    Double  DRT  4   9998   2  1;
    Double  DRC  4   9998   2  1;
    Double  DR   5  65534   2  1;
    Double  DD   5  65534   2  1;
    Double  DF   5  65534   2  1;
}

/// The length of the longest symbol, in letters.
pub(crate) const LONGEST_SYMBOL: usize = 3;

impl Symbol {
    /// The letters, upper case: one to three of them.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        self.row().letters
    }

    /// How many bits an element of this symbol holds.
    #[must_use]
    pub const fn width(self) -> Width {
        self.row().width
    }

    /// How many decimal digits its address has in the ASCII framing: 4 or 5.
    #[must_use]
    pub const fn digits(self) -> usize {
        self.row().digits
    }

    /// The largest address the protocol has for it. A PLC's own limit is usually smaller: it answers
    /// [`IllegalAddress`](crate::ErrorCode::IllegalAddress) beyond that.
    #[must_use]
    pub const fn last_address(self) -> u16 {
        self.row().last
    }

    /// The distance between the addresses of consecutive elements: 16 for `WX`, 2 for `DR`, 1 for `R`.
    #[must_use]
    pub const fn step(self) -> u16 {
        self.row().step
    }

    /// What its addresses must be a multiple of: 8 for words and double words of discretes, else 1.
    #[must_use]
    pub const fn alignment(self) -> u16 {
        self.row().align
    }

    /// The symbol of the smallest elements in the same memory: `M` for `WM` and `DWM`, `R` for `DR`. Elements of two such
    /// memories never overlap.
    pub(crate) const fn memory(self) -> Self {
        match self {
            Self::X | Self::WX | Self::DWX => Self::X,
            Self::Y | Self::WY | Self::DWY => Self::Y,
            Self::M | Self::WM | Self::DWM => Self::M,
            Self::S | Self::WS | Self::DWS => Self::S,
            Self::T | Self::WT | Self::DWT => Self::T,
            Self::C | Self::WC | Self::DWC => Self::C,
            Self::RT | Self::DRT => Self::RT,
            Self::RC | Self::DRC => Self::RC,
            Self::R | Self::DR => Self::R,
            Self::D | Self::DD => Self::D,
            Self::F | Self::DF => Self::F,
        }
    }

    /// The symbol with these letters, in either case.
    #[must_use]
    pub const fn from_letters(letters: &[u8]) -> Option<Self> {
        let mut i = 0;
        while i < Self::ALL.len() {
            if Self::ALL[i].as_str().as_bytes().eq_ignore_ascii_case(letters) {
                return Some(Self::ALL[i]);
            }
            i += 1;
        }
        None
    }

    pub(super) const fn check(self, address: u32) -> Result<u16, ElementError> {
        let row = self.row();
        if address > row.last as u32 {
            return Err(ElementError::OutOfRange { symbol: self, address });
        }
        let address = address as u16;
        if !address.is_multiple_of(row.align) {
            return Err(ElementError::Misaligned { symbol: self, address });
        }
        Ok(address)
    }
}

impl fmt::Display for Symbol {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.as_str())
    }
}

/// How many bits an element holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Width {
    /// One bit: a discrete.
    Bit,
    /// 16 bits: a register, or 16 discretes together.
    Word,
    /// 32 bits: two consecutive registers, or 32 discretes together.
    Double,
}

impl Width {
    /// What an element of this width counts against a command's limit: 1, or 2 for 32 bits.
    #[must_use]
    pub const fn units(self) -> usize {
        match self {
            Self::Bit | Self::Word => 1,
            Self::Double => 2,
        }
    }

    /// 1, 16 or 32.
    #[must_use]
    pub const fn bits(self) -> u32 {
        match self {
            Self::Bit => 1,
            Self::Word => 16,
            Self::Double => 32,
        }
    }
}

impl fmt::Display for Width {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bit => "a discrete",
            Self::Word => "a 16-bit register",
            Self::Double => "a 32-bit register",
        })
    }
}

struct Row {
    letters: &'static str,
    width: Width,
    digits: usize,
    last: u16,
    step: u16,
    align: u16,
}

macro_rules! symbols {
    ($($width:ident $symbol:ident $digits:literal $last:literal $step:literal $align:literal;)*) => {
        /// The letters that say what kind of element it is.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[non_exhaustive]
        #[allow(missing_docs, reason = "the letters are the names; the table above is their description")]
        pub enum Symbol { $($symbol),* }

        impl Symbol {
            /// Every symbol, in the table's order.
            pub const ALL: &'static [Self] = &[$(Self::$symbol),*];

            const fn row(self) -> Row {
                match self {
                    $(Self::$symbol => Row {
                        letters: stringify!($symbol),
                        width: Width::$width,
                        digits: $digits,
                        last: $last,
                        step: $step,
                        align: $align,
                    }),*
                }
            }
        }
    };
}
use symbols;
