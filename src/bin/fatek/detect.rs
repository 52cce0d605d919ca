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
use crate::enquiry::{Heard, Reply};
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
/// Limit of the settings whose traffic is told.
const MAX_TOLD: usize = 5;

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
    let mut detection =
        Detection { timeout, found: Vec::new(), traffic: Vec::new(), tried: 0, opened: 0, unopened: Vec::new() };
    let progress = StatusLine::new(output);
    let ended = unless_signalled(detection.run(&trials, &progress)).await?;
    drop(progress);
    found::print(&detection.found, detection.frames(), output)?;
    detection.tell_traffic(output);
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
    found: Vec<Found>,
    /// Traffic besides answers, by setting.
    traffic: Vec<(Setting, Framing, Heard)>,
    /// Requests sent, and times that the line was opened.
    tried: usize,
    opened: usize,
    /// Settings that the port could not be opened with, with the errors.
    unopened: Vec<(Setting, io::Error)>,
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
                    continue;
                }
            };
            self.opened += 1;
            if std::mem::take(&mut is_first) && setting.serial().is_some() {
                progress.show(format_args!("listening for another master"));
                let framing = setting.framings.first().copied().unwrap_or(Framing::Ascii);
                let heard = line.listen(framing, LISTEN).await;
                self.keep(setting, framing, heard);
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
            self.keep(setting, framing, first.heard);
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
            refused,
            time,
            heard: first.heard,
        });
        while let Some(found) = self.found.get_mut(position).filter(|found| found.requests < CONFIRMATIONS) {
            sleep(PAUSE).await;
            found.requests += 1;
            let again = line.ask(ReadStatus, framing, station, wait).await;
            found.replies += u32::from(again.reply.is_some());
            found.heard.add(again.heard);
        }
        sleep(PAUSE).await;
        let details = line.ask(ReadDetailedStatus, framing, station, setting.wait_for_details(self.timeout)).await;
        if let (Some(found), Some((Reply::Good(detailed), _))) = (self.found.get_mut(position), details.reply) {
            found.detailed = Some(detailed);
        }
        sleep(PAUSE).await;
        true
    }

    fn keep(&mut self, setting: &Setting, framing: Framing, heard: Heard) {
        if heard.bytes == 0 {
            return;
        }
        let same = |(other, of, _): &&mut (Setting, Framing, Heard)| other == setting && *of == framing;
        match self.traffic.iter_mut().find(same) {
            Some((_, _, sum)) => sum.add(heard),
            None => self.traffic.push((setting.clone(), framing, heard)),
        }
    }

    /// The settings with good frames of others, each with its first frame.
    fn frames(&self) -> impl Iterator<Item = (Endpoint, &Frame)> {
        self.traffic
            .iter()
            .filter_map(|(setting, framing, heard)| Some((setting.endpoint(*framing), heard.frames.first()?)))
    }

    /// Prints conclusions from other traffic. After an answer, those of settings before it mean little.
    fn tell_traffic(&self, output: &Output) {
        if !self.found.is_empty() {
            return;
        }
        let told = self.traffic.iter().flat_map(|(setting, framing, heard)| {
            let endpoint = setting.endpoint(*framing);
            hearing::conclusions(heard, setting.serial()).into_iter().map(move |text| (endpoint.clone(), text))
        });
        let told: Vec<_> = told.collect();
        for (endpoint, text) in told.iter().take(MAX_TOLD) {
            output.remark(format_args!("{endpoint}: {text}"));
        }
        if told.len() > MAX_TOLD {
            output.remark(format_args!("... and the like with {} more settings", told.len() - MAX_TOLD));
        }
    }

    fn verdict(mut self, line: &Endpoint, output: &Output) -> Result<(), Failure> {
        if let Some(found) = self.found.first() {
            let command = hint::command(&found.endpoint, found.station, "status");
            output.remark(format_args!("hint: to read more: {command}"));
            return Ok(());
        }
        if self.opened == 0 && !self.unopened.is_empty() {
            let (_, error) = self.unopened.swap_remove(0);
            return Err(cannot_open(line, error));
        }
        if let Some((setting, error)) = self.unopened.first() {
            let (count, endpoint) = (self.unopened.len(), setting.endpoint(Framing::Ascii));
            output.remark(format_args!("the port could not be opened {count} times, such as for {endpoint}: {error}"));
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
