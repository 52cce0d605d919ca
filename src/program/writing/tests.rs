//! The states of writing against a PLC in memory, without a link: a line that loses requests and answers, pages that do not
//! take, others who start the PLC, and a writer that is abandoned at any step. `FATEK_SEEDS=n` runs so many seeds,
//! `FATEK_SEED=n` one.

mod steps;

use std::time::Duration;

use super::*;
use crate::ErrorCode;
use crate::command::{Code, ControlPlc, ReadDetailedStatus, ReadProgramPage, ReadStatus, WriteProgramPage};
use crate::program::{WriteProgramError, WriteReport, WriteState};
use crate::random::Random;
use crate::sim::{Execute, Model, Plc};

const LADDER_WORDS: u16 = 320;
const PAGES: u16 = 6;

/// What goes wrong, in thousandths.
#[derive(Clone, Copy, Debug, Default)]
struct Chances {
    /// The request does not arrive.
    lost: u64,
    /// It is done, and its answer does not arrive.
    unanswered: u64,
    /// A page is taken, and is another.
    spoilt: u64,
    /// A page is refused.
    refused: u64,
    /// The link has sent it twice: it was done the first time, and refused the second.
    repeated: u64,
    /// STOP or RUN is refused.
    disobeyed: u64,
    /// Somebody else sets the PLC running.
    started: u64,
    /// A check finds that a duplicate came out of order: what was read since the last one is not good.
    doubted: u64,
}

struct World {
    plc: Plc,
    old: Program,
    new: Program,
    chances: Chances,
    random: Random,
    /// Whether the PLC was started by somebody else since its status was last told.
    started_since: bool,
    started: bool,
    /// Whether the last request asked for its status.
    looked: bool,
    /// What it held when the run began.
    before: Vec<ProgramPage>,
    runs: u32,
    /// The first read since the last check.
    held: Option<Mark>,
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

    /// The pages as they are: these may be no program.
    fn holds(&self) -> Vec<ProgramPage> {
        (0..PAGES).map(|page| self.plc.page(page).unwrap()).collect()
    }

    fn happens(&mut self, chance: u64) -> bool {
        self.random.next() % 1000 < chance
    }

    /// Does a step, and looks at what must always hold.
    fn ask(&mut self, step: Step, program: &Program) -> Result<Told, Error> {
        if self.happens(self.chances.started) {
            self.plc.run();
            (self.started, self.started_since) = (true, true);
        }
        let result = match step {
            Step::Status => self.execute(&ReadDetailedStatus).map(Told::Status),
            Step::Flags => self.execute(&ReadStatus).map(|status| Told::Flags(status.flags())),
            Step::Read(page) => self.execute(&ReadProgramPage::new(page)).map(Told::Page),
            Step::Write(page) => {
                let mut content = program.page(page).unwrap().clone();
                if self.happens(self.chances.spoilt) {
                    content = ProgramPage::new([0xDEAD; 64]);
                }
                let refused = self.happens(self.chances.refused);
                if refused {
                    Err(refusal(Code::WriteProgramPage, ErrorCode::WriteProhibited))
                } else {
                    self.execute(&WriteProgramPage::new(page, content)).map(|()| Told::Done)
                }
            }
            Step::Stop | Step::Run if self.happens(self.chances.disobeyed) => {
                Err(refusal(Code::ControlPlc, ErrorCode::IllegalFormat))
            }
            Step::Stop => self.execute(&ControlPlc::Stop).map(|()| Told::Done),
            Step::Run => {
                self.runs += 1;
                assert_eq!(
                    self.holds(),
                    self.new.pages(),
                    "seed {}: RUN is sent for a program that is not whole",
                    self.seed
                );
                self.execute(&ControlPlc::Run).map(|()| Told::Done)
            }
            Step::Pause => Ok(Told::Done),
            Step::Confirm | Step::Done | Step::Failed => unreachable!("these are no requests"),
        };
        self.looked = step == Step::Flags;
        self.started_since &= !matches!(result, Ok(Told::Flags(_) | Told::Status(_)));
        self.check();
        result
    }

    /// Does what is to be done next.
    fn go(&mut self, writing: &mut Writing, program: &Program) {
        let (step, mark) = (writing.next(), writing.mark());
        if matches!(step, Step::Status | Step::Flags | Step::Read(_)) {
            self.held.get_or_insert(mark);
        }
        let result = if step == Step::Confirm {
            if self.happens(self.chances.lost) {
                return writing.confirmed(Err(timeout(Code::LoopBack)));
            }
            None
        } else {
            Some(self.ask(step, program))
        };
        let doubted = self.held.filter(|_| !matches!(step, Step::Write(_) | Step::Stop | Step::Run | Step::Pause));
        if let Some(mark) = doubted.filter(|_| self.happens(self.chances.doubted)) {
            self.held = None;
            return writing.rewind(mark);
        }
        match result {
            Some(told) => writing.told(told),
            None => {
                self.held = None;
                writing.confirmed(Ok(None));
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

    /// Runs a writing until it ends, or is abandoned at so many steps; `None` then.
    fn run(&mut self, writing: &mut Writing, steps: usize) -> Option<Result<WriteReport, WriteProgramError>> {
        let program = self.new.clone();
        writing.begin(Goal::Write);
        self.before = self.holds();
        self.held = None;
        let mut steps = 0..steps;
        loop {
            match writing.next() {
                // Nobody can abandon it behind its last step.
                Step::Done => return Some(Ok(writing.report())),
                Step::Failed => return Some(Err(writing.failure())),
                // Abandoned with a request on its way: it is done, and nobody hears of it.
                step if steps.next().is_none() => {
                    if step != Step::Confirm {
                        let _ = self.ask(step, &program);
                    }
                    return None;
                }
                _ => self.go(writing, &program),
            }
        }
    }
}

fn timeout(code: Code) -> Error {
    Error::Timeout { station: 1, code, after: Duration::ZERO, sent: true }
}

fn refusal(code: Code, error: ErrorCode) -> Error {
    Error::Plc { station: 1, code, error, repeated: false }
}

/// Like another one but for some pages, or random throughout. Some differ from it in the header's digits, too.
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
    let mut options = WriteOptions::new().stop_first();
    if random.next().is_multiple_of(2) {
        options = options.run_again();
    }
    if random.next().is_multiple_of(4) {
        options = options.all_pages();
    }
    if random.next().is_multiple_of(4) {
        options = options.verify_all();
    }
    options
}

/// More steps than any run can take.
const MANY: usize = 2000;

#[test]
fn a_writing_without_faults_writes_what_differs_and_nothing_else() {
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
fn whatever_goes_wrong_and_wherever_it_is_abandoned_no_half_program_runs_and_the_next_run_ends_it() {
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
            assert!(attempt < 200, "seed {seed}: it does not come to an end");
            let steps = if random.next().is_multiple_of(2) { random.next() as usize % 40 } else { MANY };
            match world.run(&mut writing, steps) {
                Some(Ok(report)) => {
                    assert_eq!(world.holds(), world.new.pages(), "seed {seed}");
                    assert_eq!(report.running, world.plc.is_running(), "seed {seed}");
                    let mut written = [&report.written[..], &report.written_before].concat();
                    written.sort_unstable();
                    assert!(!one_process || written == to_write, "seed {seed}: {report:?}, {to_write:?}");
                    // Whoever has stopped it knows that it ran.
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
            // The process may be another one, which knows nothing of the first.
            if random.next().is_multiple_of(2) {
                writing = Writing::new(world.new.clone(), options);
                one_process = false;
            }
        }
    }
    assert!(failures > 100 || seeds(4000).count() < 4000, "{failures}");
}

#[test]
fn a_plc_that_others_start_is_stopped_again_or_the_error_does_not_say_that_it_is_stopped() {
    let mut set_running = 0;
    for seed in seeds(4000) {
        let chances = Chances { lost: 10, unanswered: 10, spoilt: 200, started: 30, ..Chances::default() };
        let mut world = World::new(seed, chances);
        let mut random = Random::new(!seed);
        let mut writing = Writing::new(world.new.clone(), options(&mut random));
        // Until it is done, or somebody has stopped it often enough.
        for _ in 0..4 {
            let Some(Err(error)) = world.run(&mut writing, MANY) else { break };
            expect(&world, &error.state);
            if error.state.is_half_written() {
                // It is looked at before it is left alone, or the error says that it could not be.
                assert!(world.looked, "seed {seed}: {error}");
                assert!(error.state.plc != PlcState::Stopped || !world.plc.is_running(), "seed {seed}: {error}");
                // It takes as many STOP as needed: five that are lost or undone are too rare to be seen here.
                assert_ne!(error.state.plc, PlcState::Running, "seed {seed}: {error}");
            }
            set_running += usize::from(matches!(*error.source, ProgramError::SetRunning));
        }
    }
    assert!(set_running > 100 || seeds(4000).count() < 4000, "{set_running}");
}

#[test]
fn a_plc_that_is_started_when_all_is_written_is_stopped_again_too() {
    for (options, seed) in [WriteOptions::new(), WriteOptions::new().run_again()].into_iter().zip(1..) {
        let mut world = World::new(seed, Chances::default());
        world.plc.stop();
        let mut writing = Writing::new(world.new.clone(), options);
        let program = world.new.clone();
        let error = loop {
            match writing.next() {
                Step::Done => panic!("it may have run a half-written program"),
                Step::Failed => break writing.failure(),
                _ => {
                    if writing.state == State::Final {
                        world.plc.run();
                    }
                    world.go(&mut writing, &program);
                    world.started = true;
                }
            }
        };
        assert!(matches!(*error.source, ProgramError::SetRunning) && error.state.whole, "{error}");
        assert_eq!((error.state.plc, world.plc.is_running()), (PlcState::Stopped, false));
        assert!(error.to_string().ends_with("; the program is written, and the PLC is stopped"), "{error}");
    }
}

/// What is said of how far it came must be so.
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
        // Nothing is known of the pages before they have been compared.
        let known = state.unwritten.contains(&page)
            || state.in_doubt.contains(&page)
            || state.written.is_empty() && state.in_doubt.is_empty();
        assert!(known, "seed {seed}: page {page} differs, and it is not said: {state:?}");
    }
}

#[test]
fn a_page_that_changes_behind_the_back_is_found_when_all_are_verified() {
    for seed in seeds(200) {
        let mut world = World::new(seed, Chances::default());
        let mut writing = Writing::new(world.new.clone(), WriteOptions::new().stop_first().run_again().verify_all());
        let program = world.new.clone();
        let mut changed = None;
        let end = loop {
            match writing.next() {
                Step::Done => break Ok(writing.report()),
                Step::Failed => break Err(writing.failure()),
                _ => {
                    if matches!(writing.state, State::Verify(0)) && changed.is_none() {
                        let page = 1 + (seed % 5) as u16;
                        world.plc.set_page(page, ProgramPage::new([0xBAD; 64])).unwrap();
                        changed = Some(page);
                    }
                    world.go(&mut writing, &program);
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
            // Nothing differed, so there was no need to verify.
            (None, Ok(report)) => assert!(report.written.is_empty(), "seed {seed}"),
            (changed, end) => panic!("seed {seed}: {changed:?}, {end:?}"),
        }
    }
}

#[test]
fn what_does_not_fit_is_refused_before_anything_is_changed() {
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
    let stop = WriteOptions::new().stop_first();
    assert_eq!(
        error(&mut world, &new, WriteOptions::new()),
        "the PLC runs: stop it first, or have it stopped; nothing was written, and the PLC runs"
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
fn a_plc_that_refuses_to_run_has_the_program_and_is_stopped() {
    for code in [ErrorCode::LadderChecksum, ErrorCode::IdMismatch, ErrorCode::Syntax, ErrorCode::NotSupported] {
        let mut world = World::new(1, Chances::default());
        world.plc.run();
        world.plc.refuse_run(Some(code));
        let mut writing = Writing::new(world.new.clone(), WriteOptions::new().stop_first().run_again());
        let error = world.run(&mut writing, MANY).unwrap().unwrap_err();
        assert!(matches!(*error.source, ProgramError::RunRefused { error } if error == code), "{error}");
        assert!(
            error.state.whole && !error.state.is_half_written() && error.state.plc == PlcState::Stopped,
            "{error:?}"
        );
        assert_eq!((world.holds(), world.runs, world.plc.is_running()), (world.new.pages().to_vec(), 1, false));
        assert!(error.to_string().ends_with("; the program is written, and the PLC ran before and is stopped now"));
        // It still knows that it ran, once the reason is gone.
        world.plc.refuse_run(None);
        let report = world.run(&mut writing, MANY).unwrap().unwrap();
        assert!(report.written.is_empty() && report.was_stopped && report.running && world.plc.is_running());
    }
}
