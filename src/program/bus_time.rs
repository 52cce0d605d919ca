//! How long a transfer takes, in exact simulated time: the states and the link on one end, the simulated PLC on the other.
#![allow(clippy::print_stdout, reason = "the figures are what it is for")]

use std::time::{Duration, SystemTime};

use super::reading::{self, Reading};
use super::writing::{self, Goal, Told, Writing};
use super::{PAGE_WORDS, Program, ProgramPage, WriteOptions};
use crate::command::{ControlPlc, LoopBack, ReadDetailedStatus, ReadProgramPage, ReadStatus, WriteProgramPage};
use crate::link::bus_time::{RESPONSE_TIME, World};
use crate::sim::{Bus, Model, Plc};
use crate::wire::Framing;

/// STX, station, command, page, LRC, ETX.
const READ_REQUEST: usize = 1 + 2 + 2 + 4 + 2 + 1;
/// With an error digit and the words instead of the page.
const READ_REPLY: usize = 1 + 2 + 2 + 1 + 4 * PAGE_WORDS + 2 + 1;
const WRITE_REQUEST: usize = READ_REQUEST + 4 * PAGE_WORDS;
const WRITE_REPLY: usize = 1 + 2 + 2 + 1 + 2 + 1;
/// The most that all else may take: checks, statuses, looking whether the PLC is stopped, pauses between two requests.
const MOST: f64 = 0.03;

fn world(ladder_words: u16, baud: u32) -> (World, Plc) {
    let plc = Plc::with_model(Model::default().ladder_words(ladder_words));
    for page in 1..plc.pages() {
        plc.set_page(page, ProgramPage::new([page; PAGE_WORDS])).unwrap();
    }
    (World::on(Bus::new().with_station(1, plc.clone()).unwrap(), Framing::Ascii, baud, &[]), plc)
}

/// A check as a job sends it: a loop-back with a nonce of 8 characters.
fn check(world: &mut World) {
    world.call(1, LoopBack::nonce(0x1234_5678_9ABC)).unwrap();
}

fn read(world: &mut World) -> Program {
    let mut reading = Reading::default();
    reading.begin();
    loop {
        match reading.next() {
            reading::Step::Brief => reading.brief(world.call(1, ReadStatus).unwrap()),
            reading::Step::Status => reading.status(world.call(1, ReadDetailedStatus).unwrap()),
            reading::Step::Page(page) => reading.page(world.call(1, ReadProgramPage::new(page)).unwrap()),
            reading::Step::Confirm => {
                check(world);
                reading.confirmed().unwrap();
            }
            reading::Step::Done => return reading.finish(SystemTime::UNIX_EPOCH).unwrap(),
        }
    }
}

fn write(world: &mut World, program: &Program, options: WriteOptions) -> usize {
    let mut writing = Writing::new(program.clone(), options);
    writing.begin(Goal::Write);
    loop {
        let told = match writing.next() {
            writing::Step::Status => world.call(1, ReadDetailedStatus).map(Told::Status),
            writing::Step::Flags => world.call(1, ReadStatus).map(|status| Told::Flags(status.flags())),
            writing::Step::Read(page) => world.call(1, ReadProgramPage::new(page)).map(Told::Page),
            writing::Step::Write(page) => {
                let content = program.page(page).unwrap().clone();
                world.call(1, WriteProgramPage::new(page, content)).map(|()| Told::Done)
            }
            writing::Step::Stop => world.call(1, ControlPlc::Stop).map(|()| Told::Done),
            writing::Step::Run => world.call(1, ControlPlc::Run).map(|()| Told::Done),
            writing::Step::Pause => unreachable!("this PLC obeys at once"),
            writing::Step::Confirm => {
                check(world);
                writing.confirmed(Ok(None));
                continue;
            }
            writing::Step::Done => return writing.report().written.len(),
            writing::Step::Failed => panic!("{}", writing.failure()),
        };
        writing.told(told);
    }
}

#[test]
fn a_program_is_read_and_written_within_3_percent_of_what_its_bytes_and_the_turnaround_take() {
    for baud in [9600, 115_200] {
        for ladder_words in [8192, 13_184] {
            let (mut world, plc) = world(ladder_words, baud);
            let pages = u32::from(plc.pages());
            let read_page = world.transmission(READ_REQUEST + READ_REPLY) + RESPONSE_TIME;
            let write_page = world.transmission(WRITE_REQUEST + WRITE_REPLY) + RESPONSE_TIME;

            let start = world.now;
            let program = read(&mut world);
            limit("reading", ladder_words, baud, world.now - start, read_page * pages);
            assert_eq!(program.pages().len(), usize::from(plc.pages()));

            // Every page but the header is another now, and the PLC runs.
            let blank = |page: u16| ProgramPage::new([!page; PAGE_WORDS]);
            (1..plc.pages()).for_each(|page| plc.set_page(page, blank(page)).unwrap());
            plc.run();
            let start = world.now;
            let written = write(&mut world, &program, WriteOptions::new().stop_first().run_again());
            // All are compared, and all but the header written and read back.
            let least = read_page * pages + (write_page + read_page) * (pages - 1);
            limit("writing what differs", ladder_words, baud, world.now - start, least);
            assert_eq!(written, usize::from(plc.pages()) - 1);
            assert!(plc.is_running());
            assert!((0..).zip(program.pages()).all(|(page, content)| plc.page(page).as_ref() == Some(content)));

            plc.stop();
            let start = world.now;
            write(&mut world, &program, WriteOptions::new().all_pages());
            limit("writing all", ladder_words, baud, world.now - start, (write_page + read_page) * pages);
        }
    }
}

fn limit(what: &str, ladder_words: u16, baud: u32, took: Duration, least: Duration) {
    let more = took.as_secs_f64() / least.as_secs_f64() - 1.0;
    println!(
        "{what}, {ladder_words} words, {baud} baud: {:.2} s, {:.2} % more than its bytes and the turnaround",
        took.as_secs_f64(),
        100.0 * more
    );
    assert!((0.0..=MOST).contains(&more), "{what}, {ladder_words} words, {baud} baud: {more}");
}
