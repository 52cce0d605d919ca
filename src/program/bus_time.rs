//! Duration of transfers in exact simulated time: transfer and link on one end, the simulated PLC on
//! the other.
#![allow(clippy::print_stdout, reason = "the test prints its figures")]

use std::time::{Duration, SystemTime};

use super::reading::Reading;
use super::writing::{WriteGoal, Writing};
use super::{PAGE_WORDS, Program, ProgramError, ProgramPage, WriteOptions};
use crate::command::{ControlPlc, LoopBack, ReadDetailedStatus, ReadProgramPage, ReadStatus, WriteProgramPage};
use crate::link::bus_time::{RESPONSE_TIME, World};
use crate::sim::{Bus, Model, Plc};
use crate::transfer::{Reply, Request, Step, Transfer};
use crate::wire::Framing;

/// STX, station, command, page, LRC, ETX.
const READ_REQUEST: usize = 1 + 2 + 2 + 4 + 2 + 1;
/// With an error digit and the words instead of the page.
const READ_REPLY: usize = 1 + 2 + 2 + 1 + 4 * PAGE_WORDS + 2 + 1;
const WRITE_REQUEST: usize = READ_REQUEST + 4 * PAGE_WORDS;
const WRITE_REPLY: usize = 1 + 2 + 2 + 1 + 2 + 1;
/// The limit for all else: checks, statuses, and the time between two requests.
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
    drive(world, &mut reading);
    reading.finish(SystemTime::UNIX_EPOCH).unwrap()
}

fn write(world: &mut World, program: &Program, options: WriteOptions) -> usize {
    let mut writing = Writing::new(program.clone(), options);
    writing.begin(WriteGoal::Write);
    drive(world, &mut writing);
    writing.report().written.len()
}

fn drive<T: Transfer<Failure = ProgramError>>(world: &mut World, transfer: &mut T) {
    loop {
        let result = match transfer.next().unwrap() {
            Step::Send(Request::DetailedStatus) => world.call(1, ReadDetailedStatus).map(Reply::DetailedStatus),
            Step::Send(Request::Status) => world.call(1, ReadStatus).map(Reply::Status),
            Step::Send(Request::ReadPage(page)) => world.call(1, ReadProgramPage::new(page)).map(Reply::Page),
            Step::Send(Request::WritePage { page, content, .. }) => {
                world.call(1, WriteProgramPage::new(page, content)).map(|()| Reply::Done)
            }
            Step::Send(Request::Stop) => world.call(1, ControlPlc::Stop).map(|()| Reply::Done),
            Step::Send(Request::Run) => world.call(1, ControlPlc::Run).map(|()| Reply::Done),
            Step::Send(request) => unreachable!("this PLC obeys at once: {request:?}"),
            Step::Confirm => {
                check(world);
                transfer.confirmed(Ok(())).unwrap();
                continue;
            }
            Step::Done => return,
        };
        transfer.handle(result).unwrap();
    }
}

#[test]
fn a_transfer_takes_at_most_3_percent_more_than_its_bytes() {
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

            // Every page but the header differs now, and the PLC runs.
            let blank = |page: u16| ProgramPage::new([!page; PAGE_WORDS]);
            (1..plc.pages()).for_each(|page| plc.set_page(page, blank(page)).unwrap());
            plc.run();
            let start = world.now;
            let written = write(&mut world, &program, WriteOptions::new().stop_first(true).run_again(true));
            // All pages are compared, and all but the header written and read back.
            let least = read_page * pages + (write_page + read_page) * (pages - 1);
            limit("writing what differs", ladder_words, baud, world.now - start, least);
            assert_eq!(written, usize::from(plc.pages()) - 1);
            assert!(plc.is_running());
            assert!((0..).zip(program.pages()).all(|(page, content)| plc.page(page).as_ref() == Some(content)));

            plc.stop();
            let start = world.now;
            write(&mut world, &program, WriteOptions::new().all_pages(true));
            // The last page is read first: the PLC must have it.
            let least = (write_page + read_page) * pages + read_page;
            limit("writing all", ladder_words, baud, world.now - start, least);
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
