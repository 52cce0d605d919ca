//! Writing against a PLC in memory, without a link: a line that loses requests and replies, pages that
//! are not taken, other clients that start the PLC, and futures dropped at any step. `FATEK_SEEDS=n`
//! runs n seeds, `FATEK_SEED=n` one.

mod steps;

use std::time::Duration;

use super::*;
use crate::ErrorCode;
use crate::command::{Code, ControlPlc, ReadDetailedStatus, ReadProgramPage, ReadStatus, WriteProgramPage};
use crate::program::{WriteProgramError, WriteReport, WriteState};
use crate::random::Random;
use crate::sim::{Execute, Model, Plc};
use crate::transfer::PlcState;
use crate::transfer::contract::{self, End};

const LADDER_WORDS: u16 = 320;
const PAGES: u16 = 6;

/// Chances of faults, in thousandths.
#[derive(Clone, Copy, Debug, Default)]
struct Chances {
    /// The request does not arrive.
    lost: u64,
    /// It is executed, and its reply does not arrive.
    unanswered: u64,
    /// A page is written with other content.
    spoilt: u64,
    /// A page is refused.
    refused: u64,
    /// The link has sent it twice: executed the first time, refused the second.
    repeated: u64,
    /// STOP or RUN is refused.
    disobeyed: u64,
    /// Another client starts the PLC.
    started: u64,
    /// A check finds an out-of-order duplicate: replies since the last check are not reliable.
    doubted: u64,
}

struct World {
    plc: Plc,
    old: Program,
    new: Program,
    chances: Chances,
    random: Random,
    /// Another client started the PLC since its status was last read.
    started_since: bool,
    started: bool,
    /// The last request read its status.
    looked: bool,
    /// Its pages when the run began.
    before: Vec<ProgramPage>,
    runs: u32,
    /// The first read since the last check.
    held: Option<WriteMark>,
    seed: u64,
}

impl World {
    fn new(seed: u64, chances: Chances) -> Self {
        let mut random = Random::new(seed);
        let model = Model::default().ladder_words(LADDER_WORDS).pages_while_running(random.next().is_multiple_of(2));
        let plc = Plc::with_model(model);
        let old = random_program(&plc, &mut random, None);
        let new = random_program(&plc, &mut random, Some(&old));
        (0..).zip(old.pages()).for_each(|(page, content)| plc.set_page(page, content.clone()).unwrap());
        if random.next().is_multiple_of(2) {
            plc.run();
        }
        let before = old.pages().to_vec();
        let (started_since, started, looked) = (false, false, false);
        Self { plc, old, new, chances, random, started_since, started, looked, before, runs: 0, held: None, seed }
    }

    /// The pages of the PLC, which may not be a program.
    fn holds(&self) -> Vec<ProgramPage> {
        (0..PAGES).map(|page| self.plc.page(page).unwrap()).collect()
    }

    fn happens(&mut self, chance: u64) -> bool {
        self.random.next() % 1000 < chance
    }

    /// Executes a request, and checks the invariants.
    fn send(&mut self, request: Request) -> Result<Reply, Error> {
        if self.happens(self.chances.started) {
            self.plc.run();
            (self.started, self.started_since) = (true, true);
        }
        self.looked = request == Request::Status;
        let result = match request {
            Request::DetailedStatus => self.execute(&ReadDetailedStatus).map(Reply::DetailedStatus),
            Request::Status => self.execute(&ReadStatus).map(Reply::Status),
            Request::ReadPage(page) => self.execute(&ReadProgramPage::new(page)).map(Reply::Page),
            Request::WritePage { page, mut content, .. } => {
                if self.happens(self.chances.spoilt) {
                    content = ProgramPage::new([0xDEAD; 64]);
                }
                let refused = self.happens(self.chances.refused);
                if refused {
                    Err(refusal(Code::WriteProgramPage, ErrorCode::WriteProhibited))
                } else {
                    self.execute(&WriteProgramPage::new(page, content)).map(|()| Reply::Done)
                }
            }
            Request::Stop | Request::Run if self.happens(self.chances.disobeyed) => {
                Err(refusal(Code::ControlPlc, ErrorCode::IllegalFormat))
            }
            Request::Stop => self.execute(&ControlPlc::Stop).map(|()| Reply::Done),
            Request::Run => {
                self.runs += 1;
                assert_eq!(
                    self.holds(),
                    self.new.pages(),
                    "seed {}: RUN is sent for a program that is not whole",
                    self.seed
                );
                self.execute(&ControlPlc::Run).map(|()| Reply::Done)
            }
            Request::Pause => Ok(Reply::Done),
            Request::Read { .. } | Request::ReadDisabled(..) | Request::Write(..) => {
                unreachable!("no program has these")
            }
        };
        self.started_since &= !matches!(result, Ok(Reply::Status(_) | Reply::DetailedStatus(_)));
        self.check();
        result
    }

    /// Does the next step.
    fn go(&mut self, writing: &mut Writing) {
        let (step, mark) = (writing.next().unwrap(), writing.mark());
        let is_read = |step: &Step| matches!(step, Step::Send(request) if !is_command(request));
        if is_read(&step) {
            self.held.get_or_insert(mark);
        }
        let result = match step.clone() {
            Step::Confirm if self.happens(self.chances.lost) => {
                return writing.confirmed(Err(timeout(Code::LoopBack))).unwrap();
            }
            Step::Confirm => None,
            Step::Send(request) => Some(self.send(request)),
            Step::Done => unreachable!("there is no step after the end"),
        };
        let doubted = self.held.filter(|_| step == Step::Confirm || is_read(&step));
        if let Some(mark) = doubted.filter(|_| self.happens(self.chances.doubted)) {
            self.held = None;
            return writing.rewind(mark);
        }
        match result {
            Some(result) => writing.handle(result).unwrap(),
            None => {
                self.held = None;
                writing.confirmed(Ok(())).unwrap();
            }
        }
    }

    fn check(&self) {
        if self.plc.is_running() && !self.started {
            let holds = self.holds();
            assert!(
                holds == self.old.pages() || holds == self.new.pages(),
                "seed {}: it runs a half-written program",
                self.seed
            );
        }
    }

    fn execute<C: Execute>(&mut self, request: &C) -> Result<C::Reply, Error> {
        if self.happens(self.chances.lost) {
            return Err(timeout(C::CODE));
        }
        let reply = self.plc.execute(request);
        if self.happens(self.chances.unanswered) {
            return Err(timeout(C::CODE));
        }
        if matches!(C::CODE, Code::WriteProgramPage | Code::ControlPlc) && self.happens(self.chances.repeated) {
            return Err(Error::Plc { station: 1, code: C::CODE, error: ErrorCode::IllegalFormat, repeated: true });
        }
        reply.map_err(|error| refusal(C::CODE, error))
    }

    /// Runs a writing until it ends; `None` if its future is dropped after this number of steps.
    fn run(&mut self, writing: &mut Writing, steps: usize) -> Option<Result<WriteReport, WriteProgramError>> {
        writing.begin(WriteGoal::Write);
        self.before = self.holds();
        self.held = None;
        let mut steps = 0..steps;
        loop {
            match writing.next() {
                Ok(Step::Done) => return Some(Ok(writing.report())),
                Err(source) => return Some(Err(failed(writing, source))),
                // The request is on its way: it is executed, and its reply is dropped.
                Ok(step) if steps.next().is_none() => {
                    if let Step::Send(request) = step {
                        let _ = self.send(request);
                    }
                    return None;
                }
                Ok(_) => self.go(writing),
            }
        }
    }
}

fn failed(writing: &Writing, source: ProgramError) -> WriteProgramError {
    WriteProgramError { source: Box::new(source), state: Box::new(writing.state()) }
}

/// Requests that are sent outside of the job.
fn is_command(request: &Request) -> bool {
    matches!(request, Request::WritePage { .. } | Request::Stop | Request::Run | Request::Pause)
}

fn timeout(code: Code) -> Error {
    Error::timeout(1, code, Duration::ZERO, true)
}

fn refusal(code: Code, error: ErrorCode) -> Error {
    Error::Plc { station: 1, code, error, repeated: false }
}

/// A random program, or a copy of another one with some pages changed, now and then the header, too.
fn random_program(plc: &Plc, random: &mut Random, like: Option<&Program>) -> Program {
    let mut pages: Vec<ProgramPage> = like
        .map_or_else(|| (0..PAGES).map(|page| plc.page(page).unwrap()).collect(), |program| program.pages().to_vec());
    for page in &mut pages[1..] {
        if like.is_none() || !random.next().is_multiple_of(3) {
            *page = ProgramPage::new([0; 64].map(|_: u16| random.next() as u16));
        }
    }
    if random.next().is_multiple_of(3) {
        let mut header = pages[0].to_bytes();
        header[3] = b'0' + (random.next() % 10) as u8;
        pages[0] = ProgramPage::from_bytes(&header);
    }
    Program::from_pages(pages).unwrap()
}

fn seeds(count: u64) -> std::ops::Range<u64> {
    let number = |name| std::env::var(name).ok().and_then(|number| number.parse().ok());
    match number("FATEK_SEED") {
        Some(seed) => seed..seed + 1,
        None => 0..number("FATEK_SEEDS").unwrap_or(count),
    }
}

fn options(random: &mut Random) -> WriteOptions {
    let mut options = WriteOptions::new().stop_first(true);
    if random.next().is_multiple_of(2) {
        options = options.run_again(true);
    }
    if random.next().is_multiple_of(4) {
        options = options.all_pages(true);
    }
    if random.next().is_multiple_of(4) {
        options = options.verify_all(true);
    }
    options
}

/// More steps than any run can take.
const MANY: usize = 2000;

#[test]
fn a_writing_without_faults_writes_only_what_differs() {
    for seed in seeds(500) {
        let mut world = World::new(seed, Chances::default());
        let (ran, mut random) = (world.plc.is_running(), Random::new(seed));
        let options = options(&mut random);
        let mut writing = Writing::new(world.new.clone(), options);
        let differing = world.old.differing_pages(&world.new);
        let report = world.run(&mut writing, MANY).unwrap().unwrap();
        let mut written = report.written.clone();
        written.sort_unstable();
        assert_eq!(written, if options.all_pages { (0..PAGES).collect() } else { differing }, "seed {seed}");
        // The ladder in ascending order, and then the header.
        let ladder = written.iter().copied().filter(|&page| page != 0);
        let expected: Vec<u16> = ladder.chain(written.contains(&0).then_some(0)).collect();
        assert_eq!(report.written, expected, "seed {seed}");
        assert_eq!(world.holds(), world.new.pages(), "seed {seed}");
        let stopped = ran && !written.is_empty();
        assert_eq!(report.was_stopped, stopped, "seed {seed}");
        assert_eq!(world.plc.is_running(), ran && (options.run_again || !stopped), "seed {seed}");
        assert_eq!(report.running, world.plc.is_running(), "seed {seed}");
    }
}

#[test]
fn no_fault_or_dropped_future_runs_a_half_written_program() {
    let mut failures = 0;
    for seed in seeds(4000) {
        let chances = Chances {
            lost: 40,
            unanswered: 40,
            spoilt: 20,
            refused: 10,
            repeated: 30,
            disobeyed: 30,
            started: 0,
            doubted: if seed % 2 == 0 { 30 } else { 0 },
        };
        let mut world = World::new(seed, chances);
        let mut random = Random::new(!seed);
        let options = options(&mut random);
        let mut writing = Writing::new(world.new.clone(), options);
        let ran = world.plc.is_running();
        let to_write = if options.all_pages { (0..PAGES).collect() } else { world.old.differing_pages(&world.new) };
        let mut one_process = true;
        for attempt in 0.. {
            assert!(attempt < 200, "seed {seed}: it does not end");
            let steps = if random.next().is_multiple_of(2) { random.next() as usize % 40 } else { MANY };
            match world.run(&mut writing, steps) {
                Some(Ok(report)) => {
                    assert_eq!(world.holds(), world.new.pages(), "seed {seed}");
                    assert_eq!(report.running, world.plc.is_running(), "seed {seed}");
                    let mut written = [&report.written[..], &report.written_before].concat();
                    written.sort_unstable();
                    assert!(!one_process || written == to_write, "seed {seed}: {report:?}, {to_write:?}");
                    // Only the process that stopped it knows that it ran.
                    let untouched = report.written.is_empty() && !report.was_stopped;
                    let expected = ran && (options.run_again || untouched);
                    assert!(!one_process || report.running == expected, "seed {seed}: {report:?}");
                    break;
                }
                Some(Err(_)) => failures += 1,
                None => assert!(steps < MANY, "seed {seed}: a run has no end"),
            }
            let state = writing.state();
            expect(&world, &state);
            let holds = world.holds();
            for &page in &state.unwritten {
                let before = world.before.get(usize::from(page));
                assert_eq!(holds.get(usize::from(page)), before, "seed {seed}: page {page} was written: {state:?}");
            }
            let half = holds != world.old.pages() && holds != world.new.pages();
            assert!(!half || !one_process || state.is_half_written(), "seed {seed}: {state}");
            // Another process knows nothing of the first.
            if random.next().is_multiple_of(2) {
                writing = Writing::new(world.new.clone(), options);
                one_process = false;
            }
        }
    }
    assert!(failures > 100 || seeds(4000).count() < 4000, "{failures}");
}

#[test]
fn a_plc_that_others_start_is_not_reported_as_stopped() {
    let mut set_running = 0;
    for seed in seeds(4000) {
        let chances = Chances { lost: 10, unanswered: 10, spoilt: 200, started: 30, ..Chances::default() };
        let mut world = World::new(seed, chances);
        let mut random = Random::new(!seed);
        let mut writing = Writing::new(world.new.clone(), options(&mut random));
        // Until it succeeds, or four times.
        for _ in 0..4 {
            let Some(Err(error)) = world.run(&mut writing, MANY) else { break };
            expect(&world, &error.state);
            if error.state.is_half_written() {
                // Its status is read before the end, or the error says that this failed.
                assert!(world.looked, "seed {seed}: {error}");
                assert!(error.state.plc != PlcState::Stopped || !world.plc.is_running(), "seed {seed}: {error}");
                // Five STOP that are lost or undone in a row are too rare to occur here.
                assert_ne!(error.state.plc, PlcState::Running, "seed {seed}: {error}");
            }
            set_running += usize::from(matches!(*error.source, ProgramError::SetRunning));
        }
    }
    assert!(set_running > 100 || seeds(4000).count() < 4000, "{set_running}");
}

#[test]
fn a_plc_started_after_the_last_page_is_stopped_again() {
    for (options, seed) in [WriteOptions::new(), WriteOptions::new().run_again(true)].into_iter().zip(1..) {
        let mut world = World::new(seed, Chances::default());
        world.plc.stop();
        let mut writing = Writing::new(world.new.clone(), options);
        let error = loop {
            match writing.next() {
                Ok(Step::Done) => panic!("it may have run a half-written program"),
                Err(source) => break failed(&writing, source),
                Ok(_) => {
                    if writing.stage == WriteStage::Look(LookAt::End) {
                        world.plc.run();
                    }
                    world.go(&mut writing);
                    world.started = true;
                }
            }
        };
        assert!(matches!(*error.source, ProgramError::SetRunning) && error.state.whole, "{error}");
        assert_eq!((error.state.plc, world.plc.is_running()), (PlcState::Stopped, false));
        assert!(error.to_string().ends_with("; the program is written, and the PLC is stopped"), "{error}");
    }
}

/// The state of a writing must be true.
fn expect(world: &World, state: &WriteState) {
    let seed = world.seed;
    match state.plc {
        PlcState::Stopped => {
            assert!(world.started_since || !world.plc.is_running(), "seed {seed}: {state}");
        }
        PlcState::Running => assert!(world.plc.is_running(), "seed {seed}: {state}"),
        PlcState::Unknown => {}
    }
    let holds = world.holds();
    assert!(holds == world.before || state.whole || state.is_half_written(), "seed {seed}: {state}");
    assert!(!state.whole || holds == world.new.pages(), "seed {seed}: {state}");
    for &page in &state.written {
        assert_eq!(holds.get(usize::from(page)), world.new.page(page), "seed {seed}: {state}");
    }
    for page in (0..PAGES).filter(|&page| holds.get(usize::from(page)) != world.new.page(page)) {
        // Before the comparison no page is known.
        let known = state.unwritten.contains(&page)
            || state.in_doubt.contains(&page)
            || state.written.is_empty() && state.in_doubt.is_empty();
        assert!(known, "seed {seed}: page {page} differs, and and is not reported: {state:?}");
    }
}

#[test]
fn a_page_that_another_client_changes_fails_verify_all() {
    for seed in seeds(200) {
        let mut world = World::new(seed, Chances::default());
        let mut writing =
            Writing::new(world.new.clone(), WriteOptions::new().stop_first(true).run_again(true).verify_all(true));
        let mut changed = None;
        let end = loop {
            match writing.next() {
                Ok(Step::Done) => break Ok(writing.report()),
                Err(source) => break Err(failed(&writing, source)),
                Ok(_) => {
                    if writing.stage == WriteStage::Verify(0) && changed.is_none() {
                        let page = 1 + (seed % 5) as u16;
                        world.plc.set_page(page, ProgramPage::new([0xBAD; 64])).unwrap();
                        changed = Some(page);
                    }
                    world.go(&mut writing);
                }
            }
        };
        match (changed, end) {
            (Some(page), Err(error)) => {
                let ProgramError::Differs { pages } = &*error.source else { panic!("seed {seed}: {error}") };
                assert_eq!(
                    (pages, error.state.whole, error.state.plc),
                    (&vec![page], false, PlcState::Stopped),
                    "seed {seed}"
                );
                assert_eq!(error.state.unwritten, vec![page], "seed {seed}");
                assert!(!error.state.written.contains(&page), "seed {seed}: {error}");
                let mut all = world.old.differing_pages(&world.new);
                all.retain(|&other| other != page);
                let mut written = error.state.written.clone();
                written.sort_unstable();
                assert_eq!(written, all, "seed {seed}");
                assert_eq!(world.runs, 0);
                assert!(!world.plc.is_running());
            }
            // No page differed, so none was verified.
            (None, Ok(report)) => assert!(report.written.is_empty(), "seed {seed}"),
            (changed, end) => panic!("seed {seed}: {changed:?}, {end:?}"),
        }
    }
}

#[test]
fn a_misfit_is_refused_before_anything_is_changed() {
    let mut world = World::new(1, Chances::default());
    world.plc.run();
    let error = |world: &mut World, program: &Program, options: WriteOptions| {
        let mut writing = Writing::new(program.clone(), options);
        let error = world.run(&mut writing, MANY).unwrap().unwrap_err();
        assert_eq!(
            (&error.state.written, &error.state.in_doubt, error.state.plc),
            (&vec![], &vec![], PlcState::Running)
        );
        assert!(world.plc.is_running() && world.holds() == world.old.pages());
        error.to_string()
    };
    let new = world.new.clone();
    let stop = WriteOptions::new().stop_first(true);
    assert_eq!(
        error(&mut world, &new, WriteOptions::new()),
        "the PLC runs: stop it first, or choose to have it stopped; nothing was written, and the PLC runs"
    );
    let mut bytes = new.to_bytes();
    bytes[1] = b'M';
    let other_kind = Program::from_bytes(&bytes).unwrap();
    assert!(
        error(&mut world, &other_kind, stop)
            .starts_with("the program is of the kind FM, and that of the PLC of the kind FB")
    );
    bytes[4..6].copy_from_slice(&256_u16.to_be_bytes());
    let smaller = Program::from_bytes(&bytes[..5 * 128]).unwrap();
    assert!(
        error(&mut world, &smaller, stop).starts_with("the program has a ladder of 256 words, and the PLC one of 320")
    );
    world.plc.set_memory_card(true);
    assert!(error(&mut world, &new, stop).starts_with("the PLC has a ROM pack"));
}

#[test]
fn a_plc_that_refuses_run_holds_the_program_and_is_stopped() {
    for code in [ErrorCode::LadderChecksum, ErrorCode::IdMismatch, ErrorCode::Syntax, ErrorCode::NotSupported] {
        let mut world = World::new(1, Chances::default());
        world.plc.run();
        world.plc.refuse_run(Some(code));
        let mut writing = Writing::new(world.new.clone(), WriteOptions::new().stop_first(true).run_again(true));
        let error = world.run(&mut writing, MANY).unwrap().unwrap_err();
        assert!(matches!(*error.source, ProgramError::RunRefused { error } if error == code), "{error}");
        assert!(
            error.state.whole && !error.state.is_half_written() && error.state.plc == PlcState::Stopped,
            "{error:?}"
        );
        assert_eq!((world.holds(), world.runs, world.plc.is_running()), (world.new.pages().to_vec(), 1, false));
        assert!(error.to_string().ends_with("; the program is written, and the PLC ran before and is stopped now"));
        // The writing remembers that it ran, when the reason is gone.
        world.plc.refuse_run(None);
        let report = world.run(&mut writing, MANY).unwrap().unwrap();
        assert!(report.written.is_empty() && report.was_stopped && report.running && world.plc.is_running());
    }
}

#[test]
fn writing_keeps_the_contract_of_a_transfer() {
    for seed in seeds(300) {
        let world = World::new(seed, Chances::default());
        let mut random = Random::new(!seed);
        let mut writing = Writing::new(world.new.clone(), options(&mut random));
        for run in 0.. {
            assert!(run < 200, "seed {seed}: it does not end");
            writing.begin(WriteGoal::Write);
            if let End::Done = contract::run(&mut writing, &world.plc, &mut random, 10) {
                break;
            }
            assert!(
                !world.plc.is_running() || [world.old.pages(), world.new.pages()].contains(&&*world.holds()),
                "{seed}"
            );
        }
        assert_eq!(world.holds(), world.new.pages(), "seed {seed}");
        assert_eq!(writing.report().running, world.plc.is_running(), "seed {seed}");
    }
}
