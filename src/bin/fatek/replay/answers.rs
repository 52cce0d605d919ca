//! The recorded replies, by their requests.
//!
//! A request that was recorded several times has a queue of outcomes, which are given in turn; the last
//! one stays. A station that has echoed a loop-back (4E) echoes all of them.

use std::collections::{BTreeSet, HashMap};
use std::time::Duration;

use bytes::Bytes;
use fatek::command::Code;
use fatek::wire::{Frame, Framing};

use super::script::exchange;
use crate::conversation::{Entry, Found, Outcome, StrayReply};

#[derive(Debug)]
pub(super) struct Answers {
    by_request: HashMap<Frame, ReplyQueue>,
    echoing: BTreeSet<u8>,
}

#[derive(Debug, Default)]
struct ReplyQueue {
    outcomes: Vec<RecordedReply>,
    /// Index of the next outcome.
    next: usize,
}

/// A recorded reply.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct RecordedReply {
    pub(super) round_trip: Duration,
    /// Bytes of the reply, and of its copies; empty if there was none.
    pub(super) bytes: Vec<Bytes>,
}

/// The reply to a request.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum ServedReply {
    Recorded(RecordedReply),
    /// The request itself.
    Echo,
    /// The request was not recorded.
    Unknown,
}

impl Answers {
    /// The replies to requests of this framing.
    pub(super) fn new(recorded: &[Entry], framing: Framing) -> Self {
        let mut answers = Self { by_request: HashMap::new(), echoing: BTreeSet::new() };
        // The last request that was answered, of each connection and station.
        let mut last: HashMap<(u64, u8), Frame> = HashMap::new();
        for entry in recorded {
            if let Found::Stray { reply, why: StrayReply::Doubled } = &entry.found {
                let request = last.get(&(entry.connection, reply.frame.station));
                let queue = request.and_then(|request| answers.by_request.get_mut(request));
                if let Some(outcome) = queue.and_then(|queue| queue.outcomes.last_mut()) {
                    outcome.bytes.push(reply.bytes.clone());
                }
            }
            let Some(exchange) = exchange(entry).filter(|exchange| exchange.request.framing == framing) else {
                continue;
            };
            let request = exchange.request.frame.clone();
            let outcome = match &exchange.outcome {
                Outcome::Answered(answer) => {
                    last.insert((entry.connection, request.station), request.clone());
                    if is_loop_back(&request) && answer.reply.frame == request {
                        answers.echoing.insert(request.station);
                    }
                    RecordedReply { round_trip: answer.round_trip, bytes: vec![answer.reply.bytes.clone()] }
                }
                Outcome::Unanswered | Outcome::Retried | Outcome::Broadcast => {
                    RecordedReply { round_trip: Duration::ZERO, bytes: Vec::new() }
                }
            };
            answers.by_request.entry(request).or_default().outcomes.push(outcome);
        }
        answers
    }

    /// Number of different requests.
    pub(super) fn len(&self) -> usize {
        self.by_request.len()
    }

    /// The reply to a request, the next one of its queue.
    pub(super) fn reply(&mut self, request: &Frame) -> ServedReply {
        let queue = self.by_request.get_mut(request);
        if let Some(outcome) = queue.and_then(ReplyQueue::take) {
            return ServedReply::Recorded(outcome);
        }
        if is_loop_back(request) && self.echoing.contains(&request.station) {
            ServedReply::Echo
        } else {
            ServedReply::Unknown
        }
    }
}

impl ReplyQueue {
    fn take(&mut self) -> Option<RecordedReply> {
        let outcome = self.outcomes.get(self.next).or(self.outcomes.last()).cloned();
        self.next = self.next.saturating_add(1).min(self.outcomes.len());
        outcome
    }
}

fn is_loop_back(frame: &Frame) -> bool {
    Code::from_u8(frame.command) == Some(Code::LoopBack)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::conversation::{Analysis, Change, Direction, Event};
    use crate::replay::script::Script;

    /// A frame of the ASCII framing.
    fn ascii(content: &str) -> Vec<u8> {
        let mut frame = format!("\x02{content}").into_bytes();
        let sum = fatek::wire::ascii::lrc(&frame);
        frame.extend_from_slice(format!("{sum:02X}\x03").as_bytes());
        frame
    }

    /// A conversation: `>` before a request, `<` before a reply, one each millisecond.
    fn recorded(frames: &[&str]) -> Vec<Entry> {
        let (mut analysis, mut entries) = (Analysis::new(None), Vec::new());
        for (millis, frame) in (0..).zip(frames) {
            let direction = if frame.starts_with('>') { Direction::ToPlc } else { Direction::FromPlc };
            let change = Change::Bytes { direction, bytes: ascii(&frame[1..]).into(), is_datagram: false };
            analysis.push(Event { connection: 1, at: Duration::from_millis(millis), change }, &mut entries);
        }
        analysis.finish(&mut entries);
        entries
    }

    fn frame(content: &str) -> Frame {
        let (station, command) = (&content[..2], &content[2..4]);
        let number = |digits| u8::from_str_radix(digits, 16).unwrap();
        Frame { station: number(station), command: number(command), data: content[4..].to_owned().into() }
    }

    /// The replies to a request, as texts.
    fn reply(answers: &mut Answers, request: &str) -> Vec<String> {
        match answers.reply(&frame(request)) {
            ServedReply::Recorded(recorded) => {
                recorded.bytes.iter().map(|bytes| bytes.escape_ascii().to_string()).collect()
            }
            ServedReply::Echo => vec!["echo".to_owned()],
            ServedReply::Unknown => vec!["unknown".to_owned()],
        }
    }

    fn shown(content: &str) -> String {
        ascii(content).escape_ascii().to_string()
    }

    const R0: &str = "014601R00000";
    const R1: &str = "014601R00001";

    #[test]
    fn repeated_requests_get_the_recorded_replies_in_turn() {
        let ask = format!(">{R0}");
        let recorded = recorded(&[&ask, "<014600001", &ask, "<014600002", "<014600002", &ask, &ask, "<014600003"]);
        let mut answers = Answers::new(&recorded, Framing::Ascii);
        assert_eq!(answers.len(), 1);
        let replies: Vec<_> = (0..6).map(|_| reply(&mut answers, R0)).collect();
        let [one, two, three] = ["014600001", "014600002", "014600003"].map(shown);
        // The second came twice, the third not at all; the last stays.
        let expected =
            [vec![one], vec![two.clone(), two], vec![], vec![three.clone()], vec![three.clone()], vec![three]];
        assert_eq!(replies, expected);
        assert_eq!(reply(&mut answers, R1), ["unknown"]);
    }

    #[test]
    fn loop_backs_are_echoed_by_stations_that_have_echoed_one() {
        let recorded = recorded(&[">014EAB", "<014EAB", ">024EAB", "<024E9"]);
        let mut answers = Answers::new(&recorded, Framing::Ascii);
        assert_eq!(reply(&mut answers, "014EXYZ"), ["echo"]);
        assert_eq!(reply(&mut answers, "014EAB"), [shown("014EAB")]);
        assert_eq!(reply(&mut answers, "024EXYZ"), ["unknown"]);
    }

    #[test]
    fn a_script_has_each_request_once_and_differences_have_values() {
        let recorded = recorded(&[">00410", ">014601R00000", ">014601R00000", "<01460000A", ">01450", "<01454"]);
        let script = Script::new(&recorded, Framing::Ascii);
        let texts: Vec<_> = script.steps.iter().map(|step| (step.text(), step.may_write())).collect();
        assert_eq!(texts[0], ("control RUN/STOP (41h) stop".to_owned(), true));
        assert_eq!(texts[1], ("read registers (46h) R0".to_owned(), false));
        assert!(texts.len() == 3 && texts[2].1, "an unknown request may write: {texts:?}");
        let [broadcast, read, _] = &script.steps[..] else { panic!("{script:?}") };
        assert_eq!(broadcast.difference(None), None);
        assert_eq!(read.difference(Some(&frame("01460000A"))), None);
        let difference = |reply: &str| read.difference(Some(&frame(reply))).unwrap();
        assert_eq!(difference("01460000B"), ["10", "11"].map(str::to_owned));
        assert_eq!(difference("0146A"), ["10".to_owned(), "illegal address (A)".to_owned()]);
        // The same value in other characters.
        assert_eq!(difference("01460000a"), ["\"0000A\"", "\"0000a\""].map(str::to_owned));
        assert_eq!(read.difference(None), Some(["10", "no reply"].map(str::to_owned)));
        assert!(Script::new(&recorded, Framing::Binary).steps.is_empty());
    }
}
