//! The cost of the rule of [`in_step`](crate::link::in_step): the time of each kind of work,
//! compared with a line that never doubles a reply.

use std::time::Duration;

use super::{RESPONSE_TIME, World};
use crate::command::{
    Command, LoopBack, PAGE_WORDS, ProgramPage, ReadDiscretes, ReadProgramPage, ReadRegisters, ReadStatus,
    WriteRegisters,
};
use crate::element::{Discrete, Register, Symbol};
use crate::endpoint::InStepSettings;
use crate::link::job::{Job, JobProgress};
use crate::link::{Line, Purpose};
use crate::sim::{Bus, Model, Plc};
use crate::wire::Framing;

/// The lines, by baud rate; 0 is a network.
const LINES: [(&str, u32); 3] = [("9600 7E1", 9600), ("115200 8N1", 115_200), ("TCP", 0)];

/// A station behind a line, and a job on it.
struct Work {
    world: World,
    job: Option<Job<usize>>,
}

impl Work {
    fn new(baud: u32, copies: u8, plc: &Plc) -> Self {
        let bus = Bus::new().with_station(1, plc.clone()).unwrap();
        let world = World::with(bus, Framing::Ascii, baud, &[], |config| {
            config.in_step = InStepSettings::new().with_copies(copies).unwrap();
            if baud > 0 {
                config.frame_gap = Line { baud, bits_per_character: 10 }.frame_gap();
            }
        });
        let mut work = Self { world, job: None };
        // The check of a new connection is not counted.
        work.world.call(1, ReadStatus).unwrap();
        work
    }

    /// Makes a call. Returns the number of elements that its request named.
    fn ask<C: Command>(&mut self, request: C, longer: bool) -> usize {
        let purpose = if longer { Purpose::Part } else { Purpose::Whole };
        let future = self.world.push_as(1, request, purpose);
        let (result, spelling, shape, proof) = self.world.finish(future);
        assert!(result.is_ok(), "{result:?}");
        if let Some(job) = &mut self.job {
            assert_eq!(job.answered(0, shape, proof), JobProgress::Go);
        }
        spelling.count.into()
    }

    fn in_job(&mut self, work: impl FnOnce(&mut Self)) {
        self.job = Some(Job::new(2));
        work(self);
        if self.job.take().is_some_and(|job| job.must_confirm()) {
            let future = self.world.push_as(1, LoopBack::empty(), Purpose::Confirm);
            assert!(self.world.finish(future).0.is_ok());
        }
    }

    fn read(&mut self, count: usize) {
        let mut read = 0;
        while read < count {
            let first = Register::r(u16::try_from(read).unwrap());
            read += self.ask(ReadRegisters::new(first, (count - read).min(64)).unwrap(), true);
        }
    }

    fn read_discretes(&mut self, count: usize) {
        let mut read = 0;
        while read < count {
            let first = Discrete::new(Symbol::M, u16::try_from(read).unwrap()).unwrap();
            read += self.ask(ReadDiscretes::new(first, (count - read).min(256)).unwrap(), true);
        }
    }

    fn write(&mut self, count: usize) {
        let mut written = 0;
        while written < count {
            let first = Register::r(u16::try_from(written).unwrap());
            let values = vec![1_u16; (count - written).min(64)];
            written += self.ask(WriteRegisters::new(first, values).unwrap(), true);
        }
    }
}

fn seconds(baud: u32, copies: u8, plc: &Plc, work: &impl Fn(&mut Work)) -> f64 {
    let mut bench = Work::new(baud, copies, plc);
    let began = bench.world.now;
    work(&mut bench);
    (bench.world.now - began).as_secs_f64()
}

/// Compares a kind of work with the same work on a line that never doubles a reply. `most`: the
/// additional time that the rule may cost, in percent.
fn costs(name: &str, plc: &Plc, most: [f64; 3], work: impl Fn(&mut Work)) {
    let mut row = format!("{name:44}");
    for ((line, baud), most) in LINES.into_iter().zip(most) {
        let (plain, ruled) = (seconds(baud, 0, plc, &work), seconds(baud, 1, plc, &work));
        let percent = 100.0 * (ruled / plain - 1.0);
        row += &format!(" {plain:8.3} s {percent:6.1} %");
        assert!((0.0..=most).contains(&percent), "{name}, {line}: {percent:.2} % instead of at most {most} %");
    }
    println!("{row}");
}

#[test]
fn the_rule_costs_no_more_than_the_table_allows() {
    let plc = Plc::with_model(Model::largest());
    println!(
        "{:44} {:>19} {:>19} {:>19}",
        "seconds without the rule, and its cost", LINES[0].0, LINES[1].0, LINES[2].0
    );
    costs("read of 3840 registers", &plc, [2.0, 2.0, 4.0], |work| work.in_job(|work| work.read(3840)));
    costs("backup, with 1912 discretes", &plc, [2.0, 2.0, 4.0], |work| {
        work.in_job(|work| {
            work.read(3840);
            work.read_discretes(1912);
        });
    });
    costs("ten cycles of 10 x 16 registers", &plc, [7.0, 8.0, 11.0], |work| {
        for _ in 0..10 {
            work.in_job(|work| {
                for block in 0..10 {
                    work.ask(ReadRegisters::new(Register::r(16 * block), 16).unwrap(), false);
                }
            });
        }
    });
    costs("ten cycles of 16, 17, ... 25 registers", &plc, [7.0, 8.0, 11.0], |work| {
        for _ in 0..10 {
            work.in_job(|work| {
                for block in 0..10_u16 {
                    let count = 16 + usize::from(block);
                    work.ask(ReadRegisters::new(Register::r(32 * block), count).unwrap(), false);
                }
            });
        }
    });
    costs("64 registers with a pause", &plc, [0.0, 0.0, 0.0], |work| {
        for _ in 0..10 {
            work.ask(ReadRegisters::new(Register::r(0), 64).unwrap(), false);
            work.world.now += Duration::from_millis(2000);
        }
    });
    costs("64 registers again and again", &plc, [9.0, 28.0, 4.0], |work| {
        (0..60).for_each(|_| {
            work.ask(ReadRegisters::new(Register::r(0), 64).unwrap(), false);
        });
    });
    costs("129 writes of 64 registers", &plc, [9.0, 27.0, 35.0], |work| work.in_job(|work| work.write(129 * 64)));
    costs("64 callers of one register each", &plc, [1.0, 1.0, 2.0], |work| {
        (0..64).for_each(|n| {
            work.ask(ReadRegisters::new(Register::r(10 * n), 1).unwrap(), false);
        });
    });
    for (name, equal, most) in [("most", false, [3.0, 4.0, 5.0]), ("no", true, [10.0, 28.5, 101.5])] {
        let plc = Plc::with_model(Model::default().ladder_words(13_184));
        for page in 1..plc.pages() {
            let content = if equal { 7 } else { page };
            plc.set_page(page, ProgramPage::new([content; PAGE_WORDS])).unwrap();
        }
        let pages = plc.pages();
        costs(&format!("program of 13184 words, {name} pages different"), &plc, most, |work| {
            work.in_job(|work| {
                (0..pages).for_each(|page| {
                    work.ask(ReadProgramPage::new(page), false);
                });
            });
        });
    }
    assert_eq!(RESPONSE_TIME, Duration::from_millis(5), "the table is for this response time");
}
