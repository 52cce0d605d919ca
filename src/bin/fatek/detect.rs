//! Subcommand `fatek detect SERIAL`: the settings of a line, by trying.
//!
//! [`trials`] has the settings and their order, [`connection`] the line, [`hearing`] the conclusions from
//! other traffic, [`found`] the results. Only the status (40) and the detailed status (53) are read. The
//! port is opened anew for each setting, as a link does, so that drivers of RS-485 are switched as usual.

mod connection;
mod found;
mod hearing;
pub(crate) mod trials;

use std::io;
use std::path::Path;
use std::time::Duration;

use fatek::Endpoint;
use fatek::command::{ReadDetailedStatus, ReadStatus};
use fatek::endpoint::Transport;
use fatek::link::defaults;
use fatek::wire::{Frame, Framing};
use tokio::time::sleep;

use self::connection::Connection;
use self::found::Found;
use self::trials::{Setting, Trials};
use crate::args::DetectArgs;
use crate::enquiry::{Reply, Traffic};
use crate::failure::Failure;
use crate::hint;
use crate::output::Output;
use crate::ports::access::Access;
use crate::progress::StatusLine;
use crate::signal::unless_signalled;
use crate::targets;

/// Time for the traffic of another master, before the first request.
const LISTEN: Duration = Duration::from_millis(250);
/// Requests to a station for the confidence in its settings.
const CONFIRMATIONS: u32 = 4;
/// Pause between a reply and the next request, for drivers of RS-485, and for duplicates.
const PAUSE: Duration = Duration::from_millis(30);
/// Limit of the settings whose traffic is explained.
const MAX_EXPLAINED: usize = 5;

pub(crate) async fn detect(args: &DetectArgs, given: Option<Duration>, output: &Output) -> Result<(), Failure> {
    let line = line(&args.line)?;
    let stations = targets::numbers(&args.stations)?;
    let trials = Trials::new(&line, &args.baud, &args.frame, args.framing, stations).map_err(Failure::Usage)?;
    let default = match line.transport().serial_settings() {
        Some(_) => defaults::SERIAL_RESPONSE_TIMEOUT,
        None => defaults::RESPONSE_TIMEOUT,
    };
    let timeout = given.unwrap_or(default);
    let settings = match trials.settings.len() {
        1 => "1 setting".to_owned(),
        several => format!("{several} settings"),
    };
    output.remark(format_args!(
        "trying {settings} with {}: {}, up to {}",
        targets::numbers_text(&trials.stations),
        requests_text(trials.count()),
        seconds(trials.longest(timeout))
    ));
    let mut detection = Detection {
        timeout,
        may_disturb: args.busy,
        is_busy: false,
        found: Vec::new(),
        traffic: Vec::new(),
        tried: 0,
        opened: 0,
        unopened: Vec::new(),
        lost: Vec::new(),
    };
    let progress = StatusLine::new(output);
    let ended = unless_signalled(detection.run(&trials, &progress)).await?;
    drop(progress);
    found::print(&detection.found, detection.frames(), output)?;
    detection.print_traffic(output);
    ended.map_err(Failure::interrupted(""))?;
    detection.verdict(&line, output)
}

/// Number of requests as a text.
pub(crate) fn requests_text(count: usize) -> String {
    if count == 1 { "1 request".to_owned() } else { format!("{count} requests") }
}

/// Whole seconds, at least one.
fn seconds(time: Duration) -> String {
    format!("{} s", time.as_secs_f64().ceil().max(1.0))
}

/// The line of the argument: a URL, or the path of a serial port.
fn line(text: &str) -> Result<Endpoint, Failure> {
    let scheme = text.split_once(':').map(|(scheme, _)| scheme.to_ascii_lowercase());
    let is_url = matches!(scheme.as_deref(), Some("serial" | "tcp" | "udp"));
    let url = if is_url { text.to_owned() } else { format!("serial:{text}") };
    let options = url.split_once('?').map_or("", |(_, options)| options);
    for name in options.split('&').filter_map(|option| option.split('=').next()) {
        if ["baud", "frame", "framing"].contains(&name) {
            return Err(Failure::Usage(format!("`{name}` is what is detected: to narrow it, give --{name}")));
        }
    }
    url.parse().map_err(Failure::usage)
}

/// A running detection.
struct Detection {
    timeout: Duration,
    /// Send requests even if the line is busy.
    may_disturb: bool,
    /// Another master was heard, and nothing was sent.
    is_busy: bool,
    found: Vec<Found>,
    /// Traffic besides answers, by setting.
    traffic: Vec<(Setting, Framing, Traffic)>,
    /// Requests sent, and times that the line was opened.
    tried: usize,
    opened: usize,
    /// Settings that the port could not be opened with, with the errors.
    unopened: Vec<(Setting, io::Error)>,
    /// Errors of requests at which the line ended without a reply.
    lost: Vec<io::Error>,
}

impl Detection {
    /// Tries the settings until a station answers, and then the other stations with that setting.
    async fn run(&mut self, trials: &Trials, progress: &StatusLine) {
        let (count, mut is_first) = (trials.count(), true);
        for (station, setting, left) in trials.iter(self.timeout) {
            let mut line = match Connection::open(setting, self.timeout).await {
                Ok(line) => line,
                Err(error) => {
                    self.unopened.push((setting.clone(), error));
                    // A serial port may refuse a single setting; a host is not there for any framing.
                    if setting.serial().is_none() && self.opened == 0 {
                        return;
                    }
                    continue;
                }
            };
            self.opened += 1;
            if std::mem::take(&mut is_first) && setting.serial().is_some() {
                progress.show(format_args!("listening for another master"));
                let framing = setting.framings.first().copied().unwrap_or(Framing::Ascii);
                let traffic = line.listen(framing, LISTEN).await;
                self.is_busy = traffic.bytes > 0 && !self.may_disturb;
                self.keep(setting, framing, traffic);
                if self.is_busy {
                    return;
                }
            }
            for &framing in &setting.framings {
                self.tried += 1;
                let text = setting.serial().map(|serial| format!("{serial}, ")).unwrap_or_default();
                progress.show(format_args!(
                    "{} of {count}: {text}{framing}, station {station}; up to {} left",
                    self.tried,
                    seconds(left)
                ));
                if self.station(&mut line, setting, framing, station, progress).await {
                    for &other in trials.stations.iter().filter(|other| **other != station) {
                        progress.show(format_args!("{}, station {other}", setting.endpoint(framing)));
                        self.station(&mut line, setting, framing, other, progress).await;
                    }
                    return;
                }
            }
        }
    }

    /// Asks a station with a setting, several times if it answers. Returns whether it does.
    async fn station(
        &mut self,
        line: &mut Connection<'_>,
        setting: &Setting,
        framing: Framing,
        station: u8,
        progress: &StatusLine,
    ) -> bool {
        let wait = setting.wait(self.timeout);
        let first = line.ask(ReadStatus, framing, station, wait).await;
        let Some((reply, time)) = first.reply else {
            self.keep(setting, framing, first.traffic);
            self.lost.extend(first.lost);
            return false;
        };
        let endpoint = setting.endpoint(framing);
        progress.event(format_args!("station {station} answers on {endpoint}"));
        let (mut brief, mut refused) = (None, None);
        match reply {
            Reply::Good(status) => brief = Some(status),
            Reply::Refused(code) => refused = Some(code),
        }
        let position = self.found.len();
        self.found.push(Found {
            endpoint,
            station,
            requests: 1,
            replies: 1,
            brief,
            detailed: None,
            is_detail_missing: false,
            refused,
            time,
            traffic: first.traffic,
        });
        while let Some(found) = self.found.get_mut(position).filter(|found| found.requests < CONFIRMATIONS) {
            sleep(PAUSE).await;
            found.requests += 1;
            let again = line.ask(ReadStatus, framing, station, wait).await;
            found.replies += u32::from(again.reply.is_some());
            found.traffic.add(again.traffic);
        }
        sleep(PAUSE).await;
        let details = line.ask(ReadDetailedStatus, framing, station, setting.wait_for_details(self.timeout)).await;
        if let Some(found) = self.found.get_mut(position) {
            found.traffic.add(details.traffic);
            match details.reply {
                Some((Reply::Good(detailed), _)) => found.detailed = Some(detailed),
                // Some models have no detailed status.
                Some((Reply::Refused(_), _)) => {}
                None => found.is_detail_missing = true,
            }
        }
        sleep(PAUSE).await;
        true
    }

    fn keep(&mut self, setting: &Setting, framing: Framing, traffic: Traffic) {
        if traffic.bytes == 0 {
            return;
        }
        let same = |(other, of, _): &&mut (Setting, Framing, Traffic)| other == setting && *of == framing;
        match self.traffic.iter_mut().find(same) {
            Some((_, _, sum)) => sum.add(traffic),
            None => self.traffic.push((setting.clone(), framing, traffic)),
        }
    }

    /// The settings with good frames of others, each with its first frame.
    fn frames(&self) -> impl Iterator<Item = (Endpoint, &Frame)> {
        self.traffic
            .iter()
            .filter_map(|(setting, framing, traffic)| Some((setting.endpoint(*framing), traffic.frames.first()?)))
    }

    /// Prints conclusions from other traffic. After an answer, those of settings before it mean little.
    fn print_traffic(&self, output: &Output) {
        if !self.found.is_empty() {
            return;
        }
        let texts = self.traffic.iter().flat_map(|(setting, framing, traffic)| {
            let endpoint = setting.endpoint(*framing);
            hearing::conclusions(traffic, setting.serial()).into_iter().map(move |text| (endpoint.clone(), text))
        });
        let texts: Vec<_> = texts.collect();
        for (endpoint, text) in texts.iter().take(MAX_EXPLAINED) {
            output.remark(format_args!("{endpoint}: {text}"));
        }
        if texts.len() > MAX_EXPLAINED {
            output.remark(format_args!("... and the like with {} more settings", texts.len() - MAX_EXPLAINED));
        }
    }

    fn verdict(mut self, line: &Endpoint, output: &Output) -> Result<(), Failure> {
        if let Some(found) = self.found.first() {
            let command = hint::command(&found.endpoint, found.station, "status");
            output.remark(format_args!("hint: to read more: {command}"));
            return Ok(());
        }
        if self.is_busy {
            return Err(Failure::BusyLine);
        }
        if self.opened == 0 && !self.unopened.is_empty() {
            let (_, error) = self.unopened.swap_remove(0);
            return Err(cannot_open(line, error));
        }
        if let Some((setting, error)) = self.unopened.first() {
            let (count, endpoint) = (self.unopened.len(), setting.endpoint(Framing::Ascii));
            output.remark(format_args!("the port could not be opened {count} times, such as for {endpoint}: {error}"));
        }
        if !self.lost.is_empty() {
            let (lost, error) = (self.lost.len(), self.lost.swap_remove(0));
            if lost == self.tried {
                return Err(Failure::LostLine { link: line.to_string(), tried: self.tried, error });
            }
            output.remark(format_args!("the line was lost at {lost} of {}: {error}", requests_text(self.tried)));
        }
        for hint in self.hints(line) {
            output.remark(format_args!("hint: {hint}"));
        }
        Err(Failure::NotDetected { tried: self.tried })
    }

    fn hints(&self, line: &Endpoint) -> Vec<String> {
        let mut hints = Vec::new();
        let is_serial = line.transport().serial_settings().is_some();
        if self.frames().next().is_some() {
            hints
                .push("frames of another master or station came: give its --stations, and stop that master".to_owned());
        } else if self.traffic.is_empty() && is_serial {
            hints.push(
                "nothing came: check power and cable, A and B, and that the port has the FATEK protocol".to_owned(),
            );
        }
        hints.push("other stations may answer, such as --stations 5-16".to_owned());
        if is_serial {
            hints.push("other speeds may, too: --baud 4800,76800,153600,230400,307200,614400,921600".to_owned());
        }
        hints.push("docs/CONNECT.md has more causes".to_owned());
        hints
    }
}

fn cannot_open(line: &Endpoint, error: io::Error) -> Failure {
    let path = if let Transport::Serial { path, .. } = line.transport() { Some(path) } else { None };
    let hint = match (error.kind() == io::ErrorKind::PermissionDenied, path) {
        (true, Some(path)) => Access::of(Path::new(path), Path::new("/")).remedy(),
        (_, Some(_)) => Some("`fatek ports` lists the ports".to_owned()),
        (_, None) => None,
    };
    let hint = hint.map_or(String::new(), |hint| format!("; {hint}"));
    Failure::Open { link: line.to_string(), error, hint }
}
