//! Subcommand `fatek ping`.

use std::cell::Cell;
use std::time::{Duration, Instant};

use fatek::{Error, Station};

use crate::args::PingArgs;
use crate::failure::Failure;
use crate::output::{Format, Output, Rows, print};
use crate::signal::unless_signalled;

pub(crate) async fn ping(station: &Station, args: &PingArgs, output: &Output) -> Result<(), Failure> {
    let mut tally = Tally::default();
    let mut rows = Rows::new(["sequence", "bytes", "time_ms"]);
    let mut result = Ok(());
    for sequence in 1..=args.count {
        let sent_at = Cell::new(Instant::now());
        let exchange = async {
            if sequence > 1 {
                tokio::time::sleep(args.interval).await;
            }
            sent_at.set(Instant::now());
            station.loop_back(payload(sequence, args.size.into())).await
        };
        let echo = match unless_signalled(exchange).await? {
            Ok(echo) => echo,
            Err(signal) => {
                result = Err(Failure::interrupted("")(signal));
                break;
            }
        };
        let sent_at = sent_at.get();
        let time = match tally.count(echo, sent_at.elapsed()) {
            Ok(time) => time,
            Err(error) => {
                result = Err(error.into());
                break;
            }
        };
        if output.format == Format::Table {
            print_line(sequence, args.size, &time)?;
        }
        rows.push([sequence.into(), args.size.into(), time.ok().into()]);
    }
    if output.format != Format::Table {
        output.rows(&rows)?;
    }
    tally.summarize(output);
    result?;
    match tally {
        Tally { sent, lost: lost @ 1.., last, .. } => Err(Failure::Lost { lost, sent, last }),
        Tally { sent, bad: bad @ 1.., last, .. } => Err(Failure::BadReplies { bad, sent, last }),
        Tally { lost: 0, bad: 0, .. } => Ok(()),
    }
}

#[derive(Debug, Default)]
struct Tally {
    sent: u32,
    lost: u32,
    bad: u32,
    /// The error of the last request without a good reply.
    last: Option<Error>,
    times: Vec<Duration>,
}

impl Tally {
    /// Counts a reply, a bad reply or a timeout. Any other error is returned and ends the command.
    fn count(&mut self, echo: Result<(), Error>, time: Duration) -> Result<Result<Duration, Error>, Error> {
        match echo {
            Ok(()) => self.times.push(time),
            Err(Error::Timeout { .. }) => self.lost += 1,
            Err(Error::BadReply { .. }) => self.bad += 1,
            Err(error) => return Err(error),
        }
        self.sent += 1;
        self.last = echo.as_ref().err().cloned().or(self.last.take());
        Ok(echo.map(|()| time))
    }

    fn summarize(&self, output: &Output) {
        let Self { sent, times, .. } = self;
        output.remark(format_args!("{sent} sent, {} received", times.len()));
        let total: Duration = times.iter().sum();
        if let (Some(shortest), Some(longest)) = (times.iter().min(), times.iter().max()) {
            let mean = total.as_secs_f64() / times.len() as f64 * 1000.0;
            output.remark(format_args!(
                "round trip: min {:.3} ms, mean {mean:.3} ms, max {:.3} ms",
                millis(*shortest),
                millis(*longest)
            ));
        }
    }
}

fn print_line(sequence: u32, size: u16, time: &Result<Duration, Error>) -> Result<(), Failure> {
    match time {
        Ok(time) => print(format_args!("{sequence}: {size} bytes in {:.3} ms", millis(*time))),
        Err(error) => print(format_args!("{sequence}: {error}")),
    }
}

fn millis(time: Duration) -> f64 {
    time.as_secs_f64() * 1000.0
}

/// Data of one request: printable, for the ASCII framing, and different each time.
fn payload(sequence: u32, size: usize) -> String {
    format!("{sequence:08X} fatek ping ").chars().cycle().take(size).collect()
}
