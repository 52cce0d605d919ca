//! Users of transfers and of the poller.

use std::collections::HashMap;
use std::time::Duration;

use fatek::backup::{Backup, BackupError, Missing, Restore, RestoreFailure, RestoreOptions};
use fatek::command::PAGE_WORDS;
use fatek::poll::{PollTag, Poller, Quality, Reason, ScanClass};
use fatek::program::{ProgramError, WriteOptions};
use fatek::sim::{self, Bus};
use fatek::tag::Tag;
use fatek::{Error, Link, Symbol, Value};
use futures::StreamExt;
use tokio::time::timeout;

use crate::jobs::tag;
use crate::layout::{self, LADDER_WORDS, REFUSED, RESTORED, bit, d, dword, word};
use crate::rng::Rng;
use crate::tally::Tally;
use crate::users::broadcast;
use crate::world::World;

pub(crate) async fn poll(world: &World, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let link = world.link();
    let mut poller = Poller::builder().seed(rng.next()).build();
    let mut expected = HashMap::new();
    for number in 1..=world.stations {
        let polled = poller.station(&link.station(number).unwrap()).unwrap();
        for _ in 0..1 + rng.below(2) {
            let period = rng.pick(&[20, 100, 500]);
            let class = ScanClass::every(Duration::from_millis(period));
            let tags: Vec<_> = (0..rng.between(1, 12)).map(|_| tag(number, rng)).collect();
            let ids = polled.add(class, tags.iter().map(|&(tag, _)| PollTag::from(tag))).unwrap();
            expected.extend(ids.into_iter().zip(tags));
        }
    }
    while link.stats().stations.requests < requests {
        // No sample comes while no request is answered.
        let Ok(sample) = timeout(Duration::from_secs(100), poller.next()).await else { break };
        let Some(Ok(sample)) = sample else { continue };
        let (tag, values) = &expected[&sample.id];
        let is_right = |got: &&[fatek::tag::TagValue]| values.as_ref().is_some_and(|values| **got == **values);
        let result = match (&sample.quality, sample.values()) {
            (Quality::Good | Quality::Stale(_), got) => Ok(got),
            (Quality::Bad(Reason::Refused(error)), _) => {
                // The poller retries a refused tag alone.
                let right = values.is_none() && *error == REFUSED
                    || world.injected().contains(error)
                    || world.mixed().contains(error);
                if !right {
                    tally.wrong.push(format!("{tag}: {}", sample.quality));
                }
                continue;
            }
            (Quality::Bad(_), []) => continue,
            (_, got) => Ok(got),
        };
        let _ = tally.call::<&[_]>(format!("sample of {tag}"), (values.is_none(), &[]), result, is_right);
    }
    poller.close().await;
    tally.links(&link.stats());
    link.close().await;
}

pub(crate) async fn back_up(world: &World, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let link = world.link();
    while link.stats().stations.requests < requests {
        broadcast(world, &link, rng, tally).await;
        let number = world.any_station(rng);
        let first = rng.between(0, 1500);
        let ranges = [
            format!("R{first}-R{}", first + rng.between(1, 900)),
            format!("M0-M{}", rng.between(100, 1500)),
            format!("DR2500-DR{}", 2500 + 2 * rng.between(1, 200)),
            "R2950-R3050".to_owned(),
        ];
        let ranges = ranges.iter().take(rng.between(1, 4).into()).map(|range| range.parse::<Tag>().unwrap());
        let backup = match link.station(number).unwrap().back_up(ranges).await {
            Ok(backup) => Ok(backup),
            Err(BackupError::Call { partial, source, .. }) => {
                check_backup(world, number, &partial, tally);
                Err(source)
            }
            Err(error) => panic!("{error}"),
        };
        if let Ok(backup) = &backup {
            check_backup(world, number, backup, tally);
        }
        let _ = tally.call("backup", (false, &[]), backup, |_| true);
    }
    tally.links(&link.stats());
    link.close().await;
}

fn check_backup(world: &World, station: u8, backup: &Backup, tally: &mut Tally) {
    for (element, value) in backup.elements() {
        let address = element.address();
        let unreadable = element.symbol() != Symbol::M && address >= layout::READABLE;
        let expected = match element.symbol() {
            Symbol::M => Value::Bit(bit(station, address)),
            Symbol::DR if !unreadable => Value::DWord(dword(station, address)),
            _ => Value::Word(word(station, address)),
        };
        let right = match value {
            Ok(value) => !unreadable && value == expected,
            Err(Missing::NotRead) => true,
            Err(Missing::Refused(error)) => unreadable && error == REFUSED || world.injected().contains(&error),
            Err(_) => false,
        };
        if !right {
            tally.wrong.push(format!("backup of station {station}, {element}: {value:?}"));
        }
    }
}

pub(crate) async fn restore(world: &World, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let link = world.link();
    while link.stats().stations.requests < requests {
        broadcast(world, &link, rng, tally).await;
        let number = world.any_station(rng);
        let plc = world.plc(number);
        plc.stop();
        let (first, count) = (RESTORED.0, rng.between(2, RESTORED.1));
        let range: Tag = format!("D{first}-D{}", first + count - 1).parse().unwrap();
        let values: Vec<u16> = (0..count).map(|_| rng.next() as u16).collect();
        let fill = |values: &[u16]| {
            (first..).zip(values).for_each(|(address, &value)| plc.write(d(address), value).unwrap());
        };
        fill(&values);
        // Read the backup over a line without faults.
        let clean = Bus::new().with_station(number, plc.clone()).unwrap();
        let good = Link::connector_builder("good", world.framing, sim::connector(clean, world.framing)).build();
        let backup = good.station(number).unwrap().back_up([range]).await.unwrap();
        good.close().await;
        let disturbed: Vec<u16> = values.iter().map(|&value| if rng.percent(40) { !value } else { value }).collect();
        fill(&disturbed);
        let station = link.station(number).unwrap();
        let options = RestoreOptions::new().bridge(if rng.percent(50) { 0 } else { 5 });
        let mut restore = Restore::new(&backup, options);
        let mut result = Ok(());
        for _ in 0..3 {
            result = match restore.run(&station).await {
                Ok(report) if !report.refused.is_empty() || !report.remaining.is_empty() => {
                    if world.injected().is_empty() {
                        tally.wrong.push(format!("restored with {report}, {:?}", report.refused));
                    }
                    Ok(())
                }
                Ok(_) => {
                    let holds =
                        (first..).zip(&values).all(|(address, &value)| plc.read(d(address)) == Value::Word(value));
                    if !holds {
                        tally.wrong.push(format!("restored, but {range} does not hold it"));
                    }
                    Ok(())
                }
                Err(error) => match error.source {
                    RestoreFailure::Call { source, .. } => Err(source),
                    _ if !world.injected().is_empty() => Ok(()),
                    failure => {
                        tally.wrong.push(format!("{failure}"));
                        Ok(())
                    }
                },
            };
            if result.is_ok() {
                break;
            }
        }
        let _ = tally.call("restore", (false, &right(world)), result, |()| true);
    }
    tally.links(&link.stats());
    link.close().await;
}

pub(crate) async fn read_program(world: &World, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let link = world.link();
    let program = layout::program(rng);
    world.plcs.iter().for_each(|plc| layout::load(plc, &program));
    while link.stats().stations.requests < requests {
        broadcast(world, &link, rng, tally).await;
        let number = world.any_station(rng);
        let result = call_error(link.station(number).unwrap().read_program().await, tally);
        let Some(result) = result else { continue };
        let _ = tally.call("program", (false, &right(world)), result, |read| read.pages() == program.pages());
    }
    tally.links(&link.stats());
    link.close().await;
}

pub(crate) async fn write_program(world: &World, rng: &mut Rng, requests: u64, tally: &mut Tally) {
    let link = world.link();
    world.plcs.iter().for_each(|plc| layout::load(plc, &layout::program(rng)));
    while link.stats().stations.requests < requests {
        broadcast(world, &link, rng, tally).await;
        let number = world.any_station(rng);
        // Most pages are unchanged: they are read and not written.
        let held: Vec<_> = (0..=LADDER_WORDS.div_ceil(64)).map(|page| world.plc(number).page(page).unwrap()).collect();
        let changed = held.into_iter().enumerate().map(|(n, page)| match n > 0 && rng.percent(30) {
            true => fatek::command::ProgramPage::new([0; PAGE_WORDS].map(|_: u16| rng.next() as u16)),
            false => page,
        });
        let program = fatek::Program::from_pages(changed.collect()).unwrap();
        let station = link.station(number).unwrap();
        let result = station.write_program(&program, WriteOptions::new().stop_first(true)).await;
        let Some(result) = call_error(result.map_err(|error| *error.source), tally) else { continue };
        let plc = world.plc(number);
        let holds = |_: &_| (0..).zip(program.pages()).all(|(n, page)| plc.page(n).as_ref() == Some(page));
        let _ = tally.call("program written", (false, &right(world)), result, holds);
    }
    tally.links(&link.stats());
    link.close().await;
}

/// Separates the error of a call. Any other error is wrong, because the PLC is healthy.
fn call_error<T>(result: Result<T, ProgramError>, tally: &mut Tally) -> Option<Result<T, Error>> {
    match result {
        Ok(value) => Some(Ok(value)),
        Err(ProgramError::Call { source, .. }) => Some(Err(source)),
        Err(error) => {
            tally.wrong.push(format!("program: {error}"));
            None
        }
    }
}

fn right(world: &World) -> Vec<fatek::ErrorCode> {
    [world.injected(), world.mixed(), world.loop_back()].concat()
}
