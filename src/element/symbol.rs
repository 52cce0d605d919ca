use std::fmt;

use super::ElementError;
use crate::wire::Framing;

// The element table: one row a memory area. Symbols, widths, steps, alignments, limits and the
// partners of other widths follow from it, here, in the planner, in backups and in the simulator.
//
// - 1, 16, 32 bits: the symbols of its elements; the area is named by its smallest one
// - digits:         decimal digits of an address in the ASCII framing
// - ASCII, binary:  the last address of the smallest element in this framing: an address has
//                   `digits`
//                   digits in ASCII, and two bytes in binary
// - content:        `Derived` if the PLC itself sets the elements in each scan: inputs from their
//                   wiring, contacts of timers and counters from their values. Else `Stored`
// - counters:       the addresses, from first to last, whose elements are counters of 32 bits: one
//                   address each, not a pair of 16-bit registers
//
// An address of a discrete stands for 1 bit and one of a register for 16 bits, so consecutive
// elements of 32 bits are 32 or 2 addresses apart; counters of 32 bits are 1 address apart.
memory_areas! {
    discretes {
        // 1 bit  16 bits  32 bits  digits  ASCII  binary  content
        X         WX       DWX      4        9999   65535  Derived;
        Y         WY       DWY      4        9999   65535  Stored;
        M         WM       DWM      4        9999   65535  Stored;
        S         WS       DWS      4        9999   65535  Stored;
        T         WT       DWT      4        9999   65535  Derived;
        C         WC       DWC      4        9999   65535  Derived;
    }
    registers {
        //        16 bits  32 bits  digits  ASCII  binary  content  counters
                  RT       DRT      4        9999   65535  Stored   [];
                  RC       DRC      4        9999   65535  Stored   [200 255];
                  R        DR       5       65535   65535  Stored   [];
                  D        DD       5       65535   65535  Stored   [];
                  F        DF       5       65535   65535  Stored   [];
    }
}

/// The length of the longest symbol, in letters.
pub(crate) const LONGEST_SYMBOL: usize = 3;

/// The length of the longest address in the ASCII framing, in digits.
pub(crate) const LONGEST_ADDRESS: usize = 5;

/// Words of discretes begin at addresses that are a multiple of this.
const WORD_ALIGNMENT: u16 = 8;

impl Symbol {
    /// The letters, upper case: one to three of them.
    #[must_use]
    pub const fn as_str(self) -> &'static str {
        self.row().letters
    }

    /// The width of its elements.
    #[must_use]
    #[inline]
    pub const fn width(self) -> Width {
        self.row().width
    }

    /// The memory that its elements lie in. Elements of two areas never overlap.
    pub(crate) const fn area(self) -> MemoryArea {
        self.row().area
    }

    /// The symbol of 16 bits with the same addresses: `R` for `DR`. Others are their own.
    pub(crate) const fn halved(self) -> Self {
        match self.width() {
            Width::Bit | Width::Word => self,
            Width::DWord => self.area().word(),
        }
    }

    /// The number of decimal digits of its addresses in the ASCII framing: 4 or 5.
    #[must_use]
    pub const fn digits(self) -> usize {
        self.row().digits
    }

    /// The largest address that the protocol has for it, in the framing that has more: binary.
    ///
    /// The limit of a PLC is usually smaller: beyond it the PLC refuses a request with
    /// [`IllegalAddress`](crate::ErrorCode::IllegalAddress).
    #[must_use]
    #[inline]
    pub const fn last_address(self) -> u16 {
        self.row().last_address
    }

    /// The largest address in a framing: of `M`, 9999 in ASCII and 65535 in binary.
    #[must_use]
    #[inline]
    pub const fn last_address_in(self, framing: Framing) -> u16 {
        match framing {
            Framing::Ascii => self.row().last_in_ascii,
            Framing::Binary => self.row().last_in_binary,
        }
    }

    /// The distance between the addresses of consecutive elements: 16 for `WX`, 2 for `DR`, 1 for
    /// `R`.
    ///
    /// Counters of 32 bits, `DRC200` to `DRC255`, are the exception: see
    /// [`Element::step`](super::Element::step).
    #[must_use]
    #[inline]
    pub const fn step(self) -> u16 {
        self.row().step
    }

    /// The number that its addresses are a multiple of: 8 for words and double words of discretes,
    /// else 1.
    #[must_use]
    pub const fn alignment(self) -> u16 {
        self.row().alignment
    }

    /// Returns whether some of its addresses are counters of 32 bits.
    #[inline]
    pub(crate) const fn has_counters(self) -> bool {
        let [first, last] = self.row().counters;
        first <= last
    }

    /// The first and the last counter of 32 bits. An area without counters has an empty range.
    #[inline]
    pub(crate) const fn counters(self) -> [u16; 2] {
        self.row().counters
    }

    /// The first and the last address of the elements that are consecutive with those at this one:
    /// all of the area, but counters of 32 bits are apart from the elements before and behind them.
    pub(crate) const fn consecutive(self, address: u16) -> [u16; 2] {
        match self.counters() {
            [first, last] if first > last => [0, u16::MAX],
            [first, _] if address < first => [0, first - 1],
            [_, last] if address > last => [last + 1, u16::MAX],
            counters => counters,
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

    /// Checks that there is an element with this address, in a framing at least.
    pub(super) const fn check(self, address: u32) -> Result<u16, ElementError> {
        let address = match self.check_form(address) {
            Ok(address) => address,
            Err(error) => return Err(error),
        };
        let row = self.row();
        let [first, last] = row.counters;
        let is_counter = first <= address && address <= last;
        let splits_one = first <= last && address < first && first - address < row.step;
        if splits_one || is_counter && matches!(row.width, Width::Word) {
            return Err(ElementError::Counter { symbol: self, address });
        }
        Ok(address)
    }

    /// Checks range and alignment of an address. A counter of 32 bits passes as one of 16 bits.
    pub(super) const fn check_form(self, address: u32) -> Result<u16, ElementError> {
        if address > self.last_address() as u32 {
            return Err(ElementError::OutOfRange { symbol: self, address });
        }
        let address = address as u16;
        if !address.is_multiple_of(self.row().alignment) {
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

impl MemoryArea {
    /// The symbol of its elements of 16 bits.
    pub(crate) const fn word(self) -> Symbol {
        self.row().word
    }

    /// The symbol of its elements of 32 bits.
    pub(crate) const fn dword(self) -> Symbol {
        self.row().dword
    }

    /// The bits that an address stands for: 1 in an area of discretes, 16 in one of registers.
    pub(crate) const fn bits_per_address(self) -> u32 {
        match self.row().smallest {
            Width::Bit => 1,
            Width::Word | Width::DWord => 16,
        }
    }

    /// The symbol of its smallest elements.
    pub(crate) const fn smallest(self) -> Symbol {
        self.row().symbol
    }

    /// Returns whether the PLC itself sets its elements in each scan.
    pub(crate) const fn is_derived(self) -> bool {
        matches!(self.row().content, Content::Derived)
    }
}

/// The width of an element.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Width {
    /// One bit: a discrete.
    Bit,
    /// 16 bits: a register, or 16 discretes together.
    Word,
    /// 32 bits: two consecutive registers, or 32 discretes together.
    DWord,
}

impl Width {
    /// The units that an element of this width counts against a command's limit: 1, or 2 for 32
    /// bits.
    #[must_use]
    pub const fn units(self) -> usize {
        match self {
            Self::Bit | Self::Word => 1,
            Self::DWord => 2,
        }
    }

    /// The number of bits: 1, 16 or 32.
    #[must_use]
    pub const fn bits(self) -> u32 {
        match self {
            Self::Bit => 1,
            Self::Word => 16,
            Self::DWord => 32,
        }
    }
}

impl fmt::Display for Width {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bit => "a discrete",
            Self::Word => "a 16-bit register",
            Self::DWord => "a 32-bit register",
        })
    }
}

/// Everything that the table says of a symbol.
struct SymbolRow {
    letters: &'static str,
    area: MemoryArea,
    width: Width,
    digits: usize,
    last_in_ascii: u16,
    last_in_binary: u16,
    /// The last address in the framing that has more.
    last_address: u16,
    step: u16,
    alignment: u16,
    /// The first and the last counter of 32 bits of its area.
    counters: [u16; 2],
}

impl SymbolRow {
    const fn new(letters: &'static str, area: MemoryArea, width: Width) -> Self {
        let row = area.row();
        assert!(letters.len() <= LONGEST_SYMBOL && row.digits <= LONGEST_ADDRESS);
        assert!((row.last_in_ascii as u32) < 10_u32.pow(row.digits as u32));
        let step = (width.bits() / area.bits_per_address()) as u16;
        let alignment =
            if matches!(row.smallest, Width::Bit) && !matches!(width, Width::Bit) { WORD_ALIGNMENT } else { 1 };
        let last_in_ascii = last_element(row.last_in_ascii, step, alignment);
        let last_in_binary = last_element(row.last_in_binary, step, alignment);
        Self {
            letters,
            area,
            width,
            digits: row.digits,
            last_in_ascii,
            last_in_binary,
            last_address: if last_in_ascii > last_in_binary { last_in_ascii } else { last_in_binary },
            step,
            alignment,
            counters: row.counters,
        }
    }
}

/// The address of the last element, which ends with the last address of its area or before.
const fn last_element(last: u16, step: u16, alignment: u16) -> u16 {
    let last = last - (step - 1);
    last - last % alignment
}

/// The counters of an area that has none.
const NO_COUNTERS: [u16; 2] = [u16::MAX, 0];

/// A row of the table.
struct AreaRow {
    smallest: Width,
    symbol: Symbol,
    word: Symbol,
    dword: Symbol,
    digits: usize,
    last_in_ascii: u16,
    last_in_binary: u16,
    content: Content,
    counters: [u16; 2],
}

enum Content {
    Stored,
    Derived,
}

macro_rules! memory_areas {
    (
        discretes { $($bit:ident $word:ident $dword:ident
            $digits:literal $ascii:literal $binary:literal $content:ident;)* }
        registers { $($register:ident $pair:ident
            $digits_:literal $ascii_:literal $binary_:literal $content_:ident [$($counters:literal)*];)* }
    ) => {
        /// The letters of an element, which name its memory and its width.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[non_exhaustive]
        #[allow(missing_docs, reason = "the letters are the names; the table above is their description")]
        pub enum Symbol { $($bit,)* $($word,)* $($register,)* $($dword,)* $($pair,)* }

        impl Symbol {
            /// All symbols: of 1 bit, of 16 bits, of 32 bits.
            pub const ALL: &'static [Self] = &[
                $(Self::$bit,)* $(Self::$word,)* $(Self::$register,)* $(Self::$dword,)* $(Self::$pair,)*
            ];

            #[inline]
            const fn row(self) -> &'static SymbolRow {
                match self {
                    $(
                        Self::$bit => const { &SymbolRow::new(stringify!($bit), MemoryArea::$bit, Width::Bit) },
                        Self::$word => const { &SymbolRow::new(stringify!($word), MemoryArea::$bit, Width::Word) },
                        Self::$dword => const { &SymbolRow::new(stringify!($dword), MemoryArea::$bit, Width::DWord) },
                    )*
                    $(
                        Self::$register => const {
                            &SymbolRow::new(stringify!($register), MemoryArea::$register, Width::Word)
                        },
                        Self::$pair => const {
                            &SymbolRow::new(stringify!($pair), MemoryArea::$register, Width::DWord)
                        },
                    )*
                }
            }
        }

        /// A memory of its own: elements of one area can overlap, elements of two never do.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        pub(crate) enum MemoryArea { $($bit,)* $($register,)* }

        impl MemoryArea {
            /// All areas.
            #[cfg(any(test, feature = "sim"))]
            pub(crate) const ALL: &'static [Self] = &[$(Self::$bit,)* $(Self::$register,)*];

            #[inline]
            const fn row(self) -> AreaRow {
                match self {
                    $(Self::$bit => AreaRow {
                        smallest: Width::Bit,
                        symbol: Symbol::$bit,
                        word: Symbol::$word,
                        dword: Symbol::$dword,
                        digits: $digits,
                        last_in_ascii: $ascii,
                        last_in_binary: $binary,
                        content: Content::$content,
                        counters: NO_COUNTERS,
                    },)*
                    $(Self::$register => AreaRow {
                        smallest: Width::Word,
                        symbol: Symbol::$register,
                        word: Symbol::$register,
                        dword: Symbol::$pair,
                        digits: $digits_,
                        last_in_ascii: $ascii_,
                        last_in_binary: $binary_,
                        content: Content::$content_,
                        counters: memory_areas!(@counters $($counters)*),
                    },)*
                }
            }
        }
    };
    (@counters) => { NO_COUNTERS };
    (@counters $first:literal $last:literal) => { [$first, $last] };
}
use memory_areas;
