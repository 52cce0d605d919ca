//! Test bench: a PLC with a program, its line, and links to it.

use std::time::Duration;

use fatek::command::{ControlPlc, PAGE_WORDS, ProgramPage, Request};
use fatek::program::Program;
use fatek::sim::{self, Bus, Faults, LogEntry, Model, PageReply, Plc};
use fatek::wire::Framing;
use fatek::{Link, Station};

pub(crate) struct Bench {
    pub(crate) plc: Plc,
    pub(crate) faults: Faults,
    pub(crate) bus: Bus,
}

impl Bench {
    pub(crate) fn new(ladder_words: u16, form: PageReply, seed: u64) -> Self {
        Self::with_model(Model::default().ladder_words(ladder_words).page_reply(form), seed)
    }

    pub(crate) fn with_model(model: Model, seed: u64) -> Self {
        let (plc, faults) = (Plc::with_model(model), Faults::new(seed).log_capacity(100_000));
        let bus = Bus::new().with_station(1, plc.clone()).unwrap().with_faults(faults.clone());
        Self { plc, faults, bus }
    }

    /// A station over a new link, as another process would have.
    pub(crate) fn station(&self) -> Station {
        let open = sim::connector(self.bus.clone(), Framing::Ascii);
        let link = Link::connector_builder("in memory", Framing::Ascii, open)
            .response_timeout(Duration::from_millis(50))
            .offline_after(0)
            .build();
        link.station(1).unwrap()
    }

    pub(crate) fn pages_held(&self) -> Vec<ProgramPage> {
        (0..self.plc.pages()).map(|page| self.plc.page(page).unwrap()).collect()
    }

    /// Loads a program directly into the PLC.
    pub(crate) fn load(&self, program: &Program) {
        (0..).zip(program.pages()).for_each(|(page, content)| self.plc.set_page(page, content.clone()).unwrap());
    }

    pub(crate) fn entries(&self) -> Vec<LogEntry> {
        assert_eq!(self.faults.log().forgotten(), 0);
        self.faults.log().entries()
    }

    /// Replays the log, starting with the old program. Asserts that RUN never came while the PLC
    /// held neither program.
    pub(crate) fn assert_never_ran_a_half(&self, old: &Program, new: &Program) {
        let mut pages = old.pages().to_vec();
        for entry in self.entries().into_iter().filter(|entry| entry.executed) {
            match entry.request() {
                Some(Request::WriteProgramPage(write)) => pages[usize::from(write.page)] = write.content.clone(),
                Some(Request::ControlPlc(ControlPlc::Run)) => {
                    assert!(pages == old.pages() || pages == new.pages(), "RUN came while pages differed");
                }
                _ => {}
            }
        }
        assert_eq!(pages, self.pages_held(), "the log is complete");
    }
}

/// A random program of this size. All have the same header.
pub(crate) fn program(ladder_words: u16, seed: u64) -> Program {
    program_with_header(ladder_words, seed, b"FB00")
}

pub(crate) fn program_with_header(ladder_words: u16, seed: u64, mark: &[u8; 4]) -> Program {
    let mut state = seed;
    let mut word = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 48) as u16
    };
    let mut header = [0xFF; 2 * PAGE_WORDS];
    header[..4].copy_from_slice(mark);
    header[4..6].copy_from_slice(&ladder_words.to_be_bytes());
    let mut pages = vec![ProgramPage::from_bytes(&header)];
    for _ in 0..ladder_words.div_ceil(64) {
        pages.push(ProgramPage::new([0; PAGE_WORDS].map(|_: u16| word())));
    }
    Program::from_pages(pages).unwrap()
}

pub(crate) fn seeds(count: u64) -> std::ops::Range<u64> {
    let number = |name| std::env::var(name).ok().and_then(|number| number.parse().ok());
    match number("FATEK_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_SEEDS").unwrap_or(count),
    }
}
