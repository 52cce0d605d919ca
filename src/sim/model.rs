use super::memory::covered;
use crate::command::{BriefStatus, DetailedStatus, PAGE_WORDS, ProgramPage, StatusFlags};
use crate::element::{Element, MemoryArea};
use crate::wire::Framing;

/// What kind of PLC a [`Plc`](super::Plc) is: what it says of itself, and where its memory ends.
///
/// The default says what the FBE-28MC in the manual's example of 53 says: 28 points, OS 3.1, a ladder of 13184 words.
/// Its memory is the largest that the protocol can address. What a model says of itself does not limit its memory;
/// [`last`](Self::last) does.
///
/// ```
/// use fatek::element;
/// use fatek::sim::{Model, Plc};
///
/// let small = Model::default()
///     .ladder_words(8192)
///     .discrete_inputs(28)
///     .last(element!("X255"))
///     .last(element!("Y255"))
///     .last(element!("S999"));
/// let plc = Plc::with_model(small);
/// assert!(plc.write(element!("WX240"), 0xFFFF_u16).is_ok());
/// assert!(plc.write(element!("WX248"), 0xFFFF_u16).is_err()); // X248 to X263
/// ```
///
/// Source: protocol reference, sections 5 and 6 (manual 000, commands 40, 4F and 53).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    /// STATUS2 of 40.
    program_capacity: u8,
    /// STATUS1..64 of 53, where STATUS1 is not the model's to say.
    detailed: [u8; 64],
    /// The last address of each area.
    last: [u16; MemoryArea::ALL.len()],
    /// The first bytes of page 0.
    program_mark: [u8; 4],
    page_reply: PageReply,
    pages_while_running: bool,
}

impl Model {
    /// Sets STATUS2 of 40, the program capacity of older models: 54h, an FBE of 13K, by default. FBs units answer 40h.
    #[must_use]
    pub fn program_capacity(mut self, code: u8) -> Self {
        self.program_capacity = code;
        self
    }

    /// Sets STATUS2 of 53, the type of the main unit: 00 is MA or MU, 01 is MC.
    #[must_use]
    pub fn main_unit(mut self, code: u8) -> Self {
        self.detailed[1] = code;
        self
    }

    /// Sets STATUS3 of 53, the code for the number of I/O points, which each series assigns anew.
    #[must_use]
    pub fn io_points_code(mut self, code: u8) -> Self {
        self.detailed[2] = code;
        self
    }

    /// Sets STATUS4 of 53, the version of the operating system: (3, 1) is sent as 31h. Each takes four bits, the rest
    /// is cut off.
    #[must_use]
    pub fn os_version(mut self, major: u8, minor: u8) -> Self {
        self.detailed[3] = major << 4 | minor & 0x0F;
        self
    }

    /// Ends the memory of one kind of element with this one: beyond it the PLC answers error A.
    ///
    /// It holds for every element in that memory: after `M2001`, `WM1984` still exists and `WM1992` does not; after
    /// `DR100` the last register is `R101`.
    #[must_use]
    pub fn last(mut self, element: impl Into<Element>) -> Self {
        let element = element.into();
        let (_, last) = covered(element);
        self.last[element.symbol().area() as usize] = last;
        self
    }

    /// Sets the first four bytes of page 0 of the program: `FB` or `FM`, then two digits. `FB00` by default.
    #[must_use]
    pub fn program_mark(mut self, mark: [u8; 4]) -> Self {
        self.program_mark = mark;
        self
    }

    /// Sets how 4F is answered.
    #[must_use]
    pub fn page_reply(mut self, form: PageReply) -> Self {
        self.page_reply = form;
        self
    }

    /// Sets whether the PLC takes pages of a program (50) while it runs. The manuals do not say; by default it refuses them with
    /// error 4.
    #[must_use]
    pub fn pages_while_running(mut self, taken: bool) -> Self {
        self.pages_while_running = taken;
        self
    }

    pub(super) fn takes_pages_while_running(&self) -> bool {
        self.pages_while_running
    }

    pub(super) fn has(&self, element: Element) -> bool {
        let (_, last) = covered(element);
        last <= self.last[element.symbol().area() as usize]
    }

    pub(super) fn brief_status(&self, flags: StatusFlags) -> BriefStatus {
        BriefStatus::from_raw([flags.0, self.program_capacity, 0])
    }

    pub(super) fn detailed_status(&self, flags: StatusFlags) -> DetailedStatus {
        let mut raw = self.detailed;
        raw[0] = flags.0;
        raw.into()
    }

    /// The last page of the program, where page 0 is the header.
    pub(super) fn last_page(&self) -> u16 {
        u16::from_be_bytes(self.ladder_size()).div_ceil(PAGE_WORDS as u16)
    }

    /// A page that was never written: of the header what the model says, of the ladder zeros.
    pub(super) fn blank_page(&self, page: u16) -> ProgramPage {
        let mut bytes = [0; 2 * PAGE_WORDS];
        if page == 0 {
            bytes.fill(0xFF);
            bytes[..4].copy_from_slice(&self.program_mark);
            bytes[4..6].copy_from_slice(&self.ladder_size());
        }
        ProgramPage::from_bytes(&bytes)
    }

    pub(super) fn form_of_page_reply(&self) -> PageReply {
        self.page_reply
    }

    /// STATUS5 and 6 of 53, and bytes 4 and 5 of page 0.
    fn ladder_size(&self) -> [u8; 2] {
        [self.detailed[4], self.detailed[5]]
    }

    fn say(mut self, status: usize, word: u16) -> Self {
        self.detailed[status - 1..=status].copy_from_slice(&word.to_be_bytes());
        self
    }
}

/// How a PLC answers 4F when all is well: the manual's figure and its text differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum PageReply {
    /// The error digit 0, then the page: what the text says of every reply.
    #[default]
    WithErrorDigit,
    /// The page alone: what the figure shows. An error is still answered by its digit.
    Bare,
}

// What 53 says in words.
//
// - STATUS:  the number of the high byte, from 1; the low byte follows
// - default: the manual's example
says! {
    // STATUS  default  method            sets
    5          13_184   ladder_words      "the size of the ladder, in words; the program has a page for every 64, and the header";
    7             256   discrete_inputs   "the number of discrete inputs";
    9             256   discrete_outputs  "the number of discrete outputs";
    11            100   analog_inputs     "the number of analog inputs";
    13            100   analog_outputs    "the number of analog outputs";
    15          2_002   m_relays          "the number of relays `M`";
    17          1_000   s_relays          "the number of step relays `S`";
    19              0   l_relays          "the number of relays `L`";
    21          8_072   r_registers       "the number of registers `R`";
    23          3_072   d_registers       "the number of registers `D`";
    25            256   timers            "the number of timers";
    27            256   counters          "the number of counters";
}

/// The last address of each area, as far as the protocol goes.
fn furthest() -> [u16; MemoryArea::ALL.len()] {
    std::array::from_fn(|n| {
        let last = |framing| MemoryArea::ALL[n].last_address_in(framing);
        last(Framing::Ascii).max(last(Framing::Binary))
    })
}

macro_rules! says {
    ($($status:literal $default:literal $method:ident $sets:literal;)*) => {
        impl Model {
            $(
                #[doc = concat!("Sets ", $sets, ": STATUS", $status, " and the next of 53. ", $default, " by default.")]
                #[must_use]
                pub fn $method(self, number: u16) -> Self {
                    self.say($status, number)
                }
            )*
        }

        impl Default for Model {
            fn default() -> Self {
                Self {
                    program_capacity: 0x54,
                    detailed: [0; 64],
                    last: furthest(),
                    program_mark: *b"FB00",
                    page_reply: PageReply::default(),
                    pages_while_running: false,
                }
                .main_unit(0x01)
                .io_points_code(0x02)
                .os_version(3, 1)
                $(.$method($default))*
            }
        }
    };
}
use says;
