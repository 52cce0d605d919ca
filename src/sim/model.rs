use super::memory::covered;
use crate::command::{BriefStatus, DetailedStatus, PAGE_WORDS, ProgramPage, StatusFlags};
use crate::element::{Element, MemoryArea};

/// Model of a [`Plc`](super::Plc): the status it reports, and the size of its memory.
///
/// The default reports the status of the FBE-28MC in the manual's example of 53: 28 points, OS 3.1,
/// a ladder of 13184 words. Its memory is the largest that the protocol can address. The reported
/// sizes do not limit the memory; [`last`](Self::last) does.
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
    /// STATUS1 to 64 of 53. STATUS1 is set from the PLC's flags.
    detailed: [u8; 64],
    /// The last address of each area.
    last: [u16; MemoryArea::ALL.len()],
    /// The first bytes of page 0.
    program_mark: [u8; 4],
    page_reply: PageReply,
    pages_while_running: bool,
}

impl Model {
    /// Sets STATUS2 of 40, the program capacity of older models.
    ///
    /// Default: 54h, an FBE with 13K. FBs units answer 40h.
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

    /// Sets STATUS3 of 53, the code of the number of I/O points. Its meaning depends on the series.
    #[must_use]
    pub fn io_points_code(mut self, code: u8) -> Self {
        self.detailed[2] = code;
        self
    }

    /// Sets STATUS4 of 53, the version of the operating system: (3, 1) is sent as 31h.
    ///
    /// Only the low four bits of each number are sent.
    #[must_use]
    pub fn os_version(mut self, major: u8, minor: u8) -> Self {
        self.detailed[3] = major << 4 | minor & 0x0F;
        self
    }

    /// Sets the last element of a memory area. Beyond it the PLC answers error A.
    ///
    /// It applies to all symbols of the area. With `M2001`, `WM1984` exists and `WM1992` does not;
    /// with `DR100`, the last register is `R101`.
    #[must_use]
    pub fn last(mut self, element: impl Into<Element>) -> Self {
        let element = element.into();
        let (_, last) = covered(element);
        self.last[element.symbol().area() as usize] = last;
        self
    }

    /// Sets the first four bytes of page 0 of the program: `FB` or `FM`, then two digits.
    ///
    /// Default: `FB00`.
    #[must_use]
    pub fn program_mark(mut self, mark: [u8; 4]) -> Self {
        self.program_mark = mark;
        self
    }

    /// Sets the form of the reply to 4F.
    #[must_use]
    pub fn page_reply(mut self, form: PageReply) -> Self {
        self.page_reply = form;
        self
    }

    /// Sets whether the PLC accepts program pages (50) in RUN.
    ///
    /// Default: `false`, it refuses them with error 4. The manuals do not specify this.
    #[must_use]
    pub fn pages_while_running(mut self, accepted: bool) -> Self {
        self.pages_while_running = accepted;
        self
    }

    pub(super) fn accepts_pages_while_running(&self) -> bool {
        self.pages_while_running
    }

    pub(super) fn has(&self, element: Element) -> bool {
        let (_, last) = covered(element);
        // A received request can name a counter of 32 bits as one of 16 bits.
        let exists = Element::new(element.symbol(), element.address()).is_ok();
        exists && last <= self.last[element.symbol().area() as usize]
    }

    pub(super) fn brief_status(&self, flags: StatusFlags) -> BriefStatus {
        BriefStatus::from_raw([flags.0, self.program_capacity, 0])
    }

    pub(super) fn detailed_status(&self, flags: StatusFlags) -> DetailedStatus {
        let mut raw = self.detailed;
        raw[0] = flags.0;
        raw.into()
    }

    /// Number of the last page of the program. Page 0 is the header.
    pub(super) fn last_page(&self) -> u16 {
        u16::from_be_bytes(self.ladder_size()).div_ceil(PAGE_WORDS as u16)
    }

    /// A page that was never written: the header of this model, or a page of zeros.
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

    fn with_status_word(mut self, status: usize, word: u16) -> Self {
        self.detailed[status - 1..=status].copy_from_slice(&word.to_be_bytes());
        self
    }
}

/// Form of the reply to 4F without an error. The manual's figure and its text differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum PageReply {
    /// The error digit 0, then the page, as the text has it for all replies.
    #[default]
    WithErrorDigit,
    /// The page alone, as in the figure. An error is still answered by its digit.
    Bare,
}

// The words in the reply to 53.
//
// - STATUS:  number of the high byte, from 1; the low byte follows
// - default: the manual's example
status_words! {
    // STATUS  default  method            sets
    5          13_184   ladder_words      "the ladder size in words; the program has a page per 64 words";
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

/// The last address of each area in the protocol.
fn protocol_limits() -> [u16; MemoryArea::ALL.len()] {
    std::array::from_fn(|n| MemoryArea::ALL[n].smallest().last_address())
}

macro_rules! status_words {
    ($($status:literal $default:literal $method:ident $sets:literal;)*) => {
        impl Model {
            $(
                #[doc = concat!("Sets ", $sets, ".")]
                #[doc = concat!("\n\nSTATUS", $status, " and the next byte of 53. Default: ", $default, ".")]
                #[must_use]
                pub fn $method(self, number: u16) -> Self {
                    self.with_status_word($status, number)
                }
            )*
        }

        impl Default for Model {
            fn default() -> Self {
                Self {
                    program_capacity: 0x54,
                    detailed: [0; 64],
                    last: protocol_limits(),
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
use status_words;
