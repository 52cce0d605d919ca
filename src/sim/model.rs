use crate::command::{BriefStatus, DetailedStatus, PAGE_WORDS, ProgramPage, StatusFlags};
use crate::element::{Element, MemoryArea};
use crate::memory_map::{Extent, MemoryMap, PlcModel};

/// Model of a [`Plc`](super::Plc): the status it reports, and the elements that it has.
///
/// The default is the FBE-28MC of [`PlcModel`]: its statuses are those of the protocol manual's
/// worked examples, and its ladder size is the one that its program has. [`largest`](Self::largest)
/// has every element that the protocol can address.
///
/// ```
/// use fatek::element;
/// use fatek::memory_map::PlcModel;
/// use fatek::sim::{Model, Plc};
///
/// let plc = Plc::with_model(Model::default());
/// assert!(plc.write(element!("WX240"), 0xFFFF_u16).is_ok());
/// assert!(plc.write(element!("WX248"), 0xFFFF_u16).is_err()); // X248 to X263
/// assert!(plc.write(element!("R4168"), 1_u16).is_err()); // R4168 to R4999 do not exist
///
/// let newer = Model::of(PlcModel::Fbs20Mc).last(element!("R8999"));
/// assert!(Plc::with_model(newer).write(element!("R8999"), 1_u16).is_ok());
/// ```
///
/// Source: protocol reference, sections 5 and 6 (manual 000, commands 40, 4F and 53).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Model {
    /// STATUS2 of 40.
    program_capacity: u8,
    /// STATUS1 to 64 of 53. STATUS1 is set from the PLC's flags.
    detailed: [u8; 64],
    /// The addresses of each area, ascending.
    extents: Vec<Extent>,
    /// The first bytes of page 0.
    program_mark: [u8; 4],
    /// `None`: the last page of the stated ladder.
    real_last_page: Option<u16>,
    page_reply: PageReply,
    pages_while_running: bool,
}

impl Model {
    /// A PLC of this model: its statuses, and the elements of its [`MemoryMap`].
    ///
    /// Areas that the map has no figures for, such as `F`, do not exist here: a simulated PLC refuses
    /// elements that no document confirms.
    #[must_use]
    pub fn of(model: PlcModel) -> Self {
        let [_, program_capacity, _] = model.brief_status().raw();
        let mut detailed = [0; 64];
        detailed.copy_from_slice(model.detailed_status().raw());
        Self {
            program_capacity,
            detailed,
            extents: Extent::merged(MemoryMap::of(model).ranges()),
            program_mark: *b"FB00",
            real_last_page: None,
            page_reply: PageReply::default(),
            pages_while_running: false,
        }
    }

    /// A PLC with every element that the protocol can address, and the statuses of the default.
    ///
    /// No documented unit has these. It is for tests of the protocol's own limits.
    #[must_use]
    pub fn largest() -> Self {
        let all = |&area: &MemoryArea| Extent { area, first: 0, last: area.smallest().last_address() };
        Self { extents: MemoryArea::ALL.iter().map(all).collect(), ..Self::default() }
    }

    /// Sets STATUS2 of 40, the program capacity of older models.
    ///
    /// Default: that of the model, such as 54h, an FBE with 13K. FBs units answer 40h.
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

    /// Sets the statuses to those that a PLC has reported: the capacity of 40, and all of 53 but the flags.
    /// `None` leaves one as it is.
    #[must_use]
    pub fn statuses(mut self, brief: Option<&BriefStatus>, detailed: Option<&DetailedStatus>) -> Self {
        if let Some(brief) = brief {
            let [_, program_capacity, _] = brief.raw();
            self.program_capacity = program_capacity;
        }
        if let Some(detailed) = detailed {
            // 53 has 28 bytes or more; those that it lacks stay.
            self.detailed.iter_mut().zip(detailed.raw()).for_each(|(own, &byte)| *own = byte);
        }
        self
    }

    /// Sets the last element of a memory area. Beyond it the PLC answers error A.
    ///
    /// It applies to all symbols of the area. With `M2001`, `WM1984` exists and `WM1992` does not;
    /// with `DR100`, the last register is `R101`. Gaps below it stay; an area that did not exist has
    /// all elements up to it.
    #[must_use]
    pub fn last(mut self, element: impl Into<Element>) -> Self {
        let element = element.into();
        let ((_, last), area) = (element.covered(), element.symbol().area());
        self.extents.retain(|extent| extent.area != area || extent.first <= last);
        match self.extents.iter_mut().rfind(|extent| extent.area == area) {
            Some(extent) => extent.last = last,
            None => self.extents.push(Extent { area, first: 0, last }),
        }
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

    /// Sets the last page of the program memory. Pages behind it are refused with error A, though the
    /// statuses state more: an FBs states 32768 words and may have 20 K.
    #[must_use]
    pub fn real_last_page(mut self, page: u16) -> Self {
        self.real_last_page = Some(page);
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

    /// The same model with this element; gaps beside it stay.
    pub(super) fn including(mut self, element: Element) -> Self {
        if self.has(element) {
            return self;
        }
        let ((first, last), area) = (element.covered(), element.symbol().area());
        self.extents.push(Extent { area, first, last });
        self.extents.sort_by_key(|extent| (extent.area, extent.first));
        self.extents.dedup_by(|next, before| {
            let joins = next.area == before.area && next.first <= before.last.saturating_add(1);
            if joins {
                before.last = before.last.max(next.last);
            }
            joins
        });
        self
    }

    pub(super) fn accepts_pages_while_running(&self) -> bool {
        self.pages_while_running
    }

    pub(super) fn has(&self, element: Element) -> bool {
        // A received request can name a counter of 32 bits as one of 16 bits.
        let exists = Element::new(element.symbol(), element.address()).is_ok();
        exists && Extent::have(&self.extents, element)
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
        let stated = u16::from_be_bytes(self.ladder_size()).div_ceil(PAGE_WORDS as u16);
        self.real_last_page.map_or(stated, |real| stated.min(real))
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

// The words in the reply to 53. Their defaults are those of the model.
//
// - STATUS: number of the high byte, from 1; the low byte follows
status_words! {
    // STATUS  method            sets
    5          ladder_words      "the ladder size in words; the program has a page per 64 words";
    7          discrete_inputs   "the number of discrete inputs";
    9          discrete_outputs  "the number of discrete outputs";
    11         analog_inputs     "the number of analog inputs";
    13         analog_outputs    "the number of analog outputs";
    15         m_relays          "the number of relays `M`";
    17         s_relays          "the number of step relays `S`";
    19         l_relays          "the number of relays `L`";
    21         r_registers       "the number of registers `R`";
    23         d_registers       "the number of registers `D`";
    25         timers            "the number of timers";
    27         counters          "the number of counters";
}

impl Default for Model {
    fn default() -> Self {
        Self::of(PlcModel::Fbe28Mc)
    }
}

macro_rules! status_words {
    ($($status:literal $method:ident $sets:literal;)*) => {
        impl Model {
            $(
                #[doc = concat!("Sets ", $sets, ".")]
                #[doc = concat!("\n\nSTATUS", $status, " and the next byte of 53. It does not limit the memory.")]
                #[must_use]
                pub fn $method(self, number: u16) -> Self {
                    self.with_status_word($status, number)
                }
            )*
        }
    };
}
use status_words;
