//! A line that is opened with a setting, and again if the other end has closed it: some devices close a
//! connection after each reply, or after a frame of the other framing.

use std::io;
use std::time::Duration;

use fatek::command::Command;
use fatek::endpoint::EndpointStream;
use fatek::link::defaults;
use fatek::wire::Framing;
use tokio::time::sleep;

use super::trials::{SETTLE, Setting};
use crate::connect;
use crate::enquiry::Traffic;
use crate::enquiry::exchange::{Outcome, Stream, ask, listen};

pub(super) struct Connection<'s> {
    setting: &'s Setting,
    timeout: Duration,
    /// `None` after the other end has closed it.
    line: Option<Stream<EndpointStream>>,
    /// A reply has come since it was opened.
    has_answered: bool,
}

impl<'s> Connection<'s> {
    pub(super) async fn open(setting: &'s Setting, timeout: Duration) -> io::Result<Self> {
        let line = Some(Stream(open(setting, timeout).await?));
        Ok(Self { setting, timeout, line, has_answered: false })
    }

    /// Listens to traffic without a request.
    pub(super) async fn listen(&mut self, framing: Framing, time: Duration) -> Traffic {
        match &mut self.line {
            // The end of the line shows at the next request.
            Some(line) => listen(line, framing, time).await.0,
            None => Traffic::default(),
        }
    }

    /// Sends a request and waits for its reply. A request on a connection that ends after a reply is sent
    /// once more on a new one.
    pub(super) async fn ask<C: Command + Copy>(
        &mut self,
        command: C,
        framing: Framing,
        station: u8,
        within: Duration,
    ) -> Outcome<C::Reply> {
        let had_answered = self.has_answered;
        let mut outcome = self.ask_once(command, framing, station, within).await;
        if had_answered && outcome.reply.is_none() && outcome.lost.is_some() {
            let again = self.ask_once(command, framing, station, within).await;
            outcome.traffic.add(again.traffic);
            (outcome.reply, outcome.lost) = (again.reply, again.lost);
        }
        outcome
    }

    async fn ask_once<C: Command>(
        &mut self,
        command: C,
        framing: Framing,
        station: u8,
        within: Duration,
    ) -> Outcome<C::Reply> {
        if self.line.is_none() {
            self.has_answered = false;
            match open(self.setting, self.timeout).await {
                Ok(line) => self.line = Some(Stream(line)),
                Err(error) => return Outcome { reply: None, traffic: Traffic::default(), lost: Some(error) },
            }
        }
        let Some(line) = &mut self.line else {
            return Outcome { reply: None, traffic: Traffic::default(), lost: None };
        };
        let outcome = ask(line, command, framing, station, within).await;
        self.has_answered |= outcome.reply.is_some();
        if outcome.lost.is_some() {
            self.line = None;
        }
        outcome
    }
}

/// Opens the line with a setting.
async fn open(setting: &Setting, within: Duration) -> io::Result<EndpointStream> {
    // The framing matters for UDP only, whose endpoint has no other settings.
    let framing = setting.framings.first().copied().unwrap_or(Framing::Ascii);
    let endpoint = setting.endpoint(framing);
    let within = within.max(defaults::CONNECT_TIMEOUT);
    let line = connect::open(&endpoint, Some(within)).await?;
    sleep(SETTLE).await;
    Ok(line)
}
