use bytes::BytesMut;
use fatek::ErrorCode;
use fatek::command::encode_reply;
use fatek::wire::{Codec, Received, Side};
use tokio_util::codec::Decoder;

use super::*;

const TIME: Duration = Duration::from_millis(7);

fn questions(stations: &[u8], retries: u32) -> Questions {
    Questions { stations: stations.to_vec(), framings: vec![Framing::Ascii, Framing::Binary], retries }
}

fn good() -> Option<(Reply<BriefStatus>, Duration)> {
    Some((Reply::Good(BriefStatus::from_raw([1, 0, 0])), TIME))
}

/// Traffic with the status of a station.
fn status_of(station: u8, framing: Framing) -> Traffic {
    let mut bytes = BytesMut::new();
    encode_reply(&ReadStatus, Ok(&BriefStatus::from_raw([1, 0, 0])), framing, station, &mut bytes);
    let frame = Codec::new(framing, Side::Client).decode(&mut bytes).unwrap().and_then(Received::frame).unwrap();
    Traffic { frames: vec![frame], ..Traffic::default() }
}

/// Takes part in a trial: `plc` gives the answer to each status. Returns the requests, such as `a1` for
/// the status of station 1 in ASCII and `d1` for its detailed status.
fn run(trial: &mut Trial<'_>, mut plc: impl FnMut(Framing, u8) -> Option<(Reply<BriefStatus>, Duration)>) -> String {
    let mut asked = Vec::new();
    loop {
        match trial.step() {
            TrialStep::Status { framing, station } => {
                asked.push(format!("{}{station}", &framing.to_string()[..1]));
                trial.status(plc(framing, station), Traffic::default());
            }
            TrialStep::Detail { station, .. } => {
                asked.push(format!("d{station}"));
                trial.detail(None, Traffic::default());
            }
            TrialStep::Listen { .. } => trial.listened(Traffic::default(), false),
            TrialStep::Open => panic!("it was not lost"),
            TrialStep::End => return asked.join(" "),
        }
        assert!(asked.len() < 1000, "it ends");
    }
}

#[test]
fn a_silent_port_is_asked_in_all_framings_and_the_first_station_again() {
    for (stations, retries, expected) in
        [(&[1][..], 0, "a1 b1"), (&[1, 2, 3], 0, "a1 a2 a3 b1 b2 b3"), (&[1, 2], 2, "a1 a1 a1 a2 b1 b1 b1 b2")]
    {
        let questions = questions(stations, retries);
        let mut trial = Trial::new(&questions, None, false);
        let asked = run(&mut trial, |_, _| None);
        assert_eq!(asked, expected);
        assert_eq!(asked.split(' ').count(), usize::try_from(questions.when_silent()).unwrap());
        assert_eq!(trial.framing(), None);
        assert_eq!(trial.into_found(), [], "UDP: it is not known whether there is a PLC");
    }
    let questions = questions(&[1], 0);
    let [silent] = &Trial::new(&questions, None, true).into_found()[..] else { panic!("one row") };
    assert_eq!((silent.answer, silent.station), (StationAnswer::Silent, None));
}

#[test]
fn the_framing_of_the_first_answer_is_the_only_one() {
    let questions = questions(&[1, 2, 3], 1);
    let mut trial = Trial::new(&questions, None, true);
    let asked = run(&mut trial, |framing, station| good().filter(|_| framing == Framing::Binary && station == 2));
    assert_eq!(asked, "a1 a1 a2 a3 b1 b1 b2 d2 b3 b3");
    assert_eq!(trial.framing(), Some(Framing::Binary));
    let [found] = &trial.into_found()[..] else { panic!("one station") };
    assert_eq!((found.framing, found.station, found.time), (Some(Framing::Binary), Some(2), Some(TIME)));
    assert_eq!(found.notes, ["no answer to the detailed status (53)"]);

    let mut other = Trial::new(&questions, Some(Framing::Binary), true);
    assert_eq!(run(&mut other, |_, _| None), "b1 b1 b2 b3 a1 a1 a2 a3", "first, and not alone");
}

#[test]
fn a_refusal_is_an_answer_without_details() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None, true);
    let refused = |_, _| Some((Reply::Refused(ErrorCode::IllegalFormat), TIME));
    assert_eq!(run(&mut trial, refused), "a1 a2");
    let found = trial.into_found();
    assert_eq!(found.iter().map(|found| found.answer).collect::<Vec<_>>(), [StationAnswer::Refused; 2]);
}

#[test]
fn a_late_reply_shows_the_framing_and_the_station() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None, true);
    trial.status(None, Traffic::default());
    trial.status(None, status_of(1, Framing::Ascii));
    assert_eq!(trial.step(), TrialStep::Listen { framing: Framing::Ascii });
    trial.listened(Traffic::default(), false);
    assert_eq!(trial.step(), TrialStep::End, "there is no need to try the other framing");
    let [late] = &trial.into_found()[..] else { panic!("one station") };
    assert_eq!((late.answer, late.station), (StationAnswer::Late, Some(1)));
}

#[test]
fn a_reply_more_than_requests_is_bad_and_one_to_a_retry_is_not() {
    for (retries, lost, expected) in [(0, 0, StationAnswer::Bad), (1, 1, StationAnswer::Ok)] {
        let questions = questions(&[1], retries);
        let mut trial = Trial::new(&questions, None, true);
        for _ in 0..lost {
            trial.status(None, Traffic::default());
        }
        trial.status(good(), Traffic::default());
        trial.detail(None, status_of(1, Framing::Ascii));
        assert_eq!(trial.into_found()[0].answer, expected, "{retries} retries");
    }
}

#[test]
fn a_connection_that_closes_after_each_reply_is_opened_again() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None, true);
    for station in 1..=2 {
        trial.status(good(), Traffic::default());
        trial.lost("closed", Traffic::default());
        assert_eq!(trial.step(), TrialStep::Open);
        trial.opened();
        assert_eq!(trial.step(), TrialStep::Detail { framing: Framing::Ascii, station });
        trial.detail(Some(Reply::Refused(ErrorCode::IllegalFormat)), Traffic::default());
        if station == 1 {
            trial.lost("closed", Traffic::default());
            trial.opened();
        }
    }
    assert_eq!(trial.step(), TrialStep::End);
    let found = trial.into_found();
    assert!(found.iter().all(|found| found.answer == StationAnswer::Ok && found.notes.is_empty()), "{found:?}");
}

#[test]
fn a_connection_lost_without_a_reply_is_for_the_next_framing() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None, true);
    trial.status(None, Traffic::default());
    trial.lost("reset", Traffic::default());
    assert_eq!(trial.step(), TrialStep::Open, "a device may close it after a frame of another framing");
    trial.opened();
    assert_eq!(trial.step(), TrialStep::Status { framing: Framing::Binary, station: 1 });
    trial.lost("reset", Traffic::default());
    assert_eq!(trial.step(), TrialStep::End);
    let [silent] = &trial.into_found()[..] else { panic!("one row") };
    assert_eq!((silent.answer, &silent.notes[..]), (StationAnswer::Silent, &["reset".to_owned()][..]));

    // Nor without end, by a peer that answers the status and closes.
    let mut trial = Trial::new(&questions, None, true);
    let mut opened = 0;
    while trial.step() != TrialStep::End {
        match trial.step() {
            TrialStep::Open => {
                opened += 1;
                trial.opened();
            }
            TrialStep::Status { .. } => trial.status(good(), Traffic::default()),
            TrialStep::Detail { .. } | TrialStep::Listen { .. } | TrialStep::End => {
                trial.lost("closed", Traffic::default());
            }
        }
        assert!(opened < 10);
    }
}

#[test]
fn traffic_without_frames_is_another_protocol_and_beside_a_reply_it_is_bad() {
    let noise = || Traffic { bytes: 9, garbage: 9, ..Traffic::default() };
    let questions = questions(&[1], 0);
    let mut trial = Trial::new(&questions, None, false);
    trial.status(None, noise());
    trial.status(None, Traffic::default());
    let [other] = &trial.into_found()[..] else { panic!("one row") };
    assert_eq!((other.answer, other.answer.is_bad()), (StationAnswer::Other, false));
    assert!(other.notes[0].contains("IPsec"), "{:?}", other.notes);

    let mut trial = Trial::new(&questions, None, true);
    trial.status(good(), noise());
    let [bad] = &trial.into_found()[..] else { panic!("one row") };
    assert_eq!((bad.answer, &bad.notes[..]), (StationAnswer::Bad, &["9 bytes that are no frame".to_owned()][..]));
}

#[test]
fn garbage_belongs_to_the_station_that_was_asked() {
    let noise = |garbage| Traffic { bytes: garbage, garbage, ..Traffic::default() };
    let questions = questions(&[1, 2, 3], 0);
    let mut trial = Trial::new(&questions, None, true);
    trial.status(good(), noise(5));
    trial.detail(Some(Reply::Refused(ErrorCode::IllegalFormat)), noise(2));
    trial.status(None, noise(3));
    trial.status(good(), Traffic::default());
    trial.detail(Some(Reply::Refused(ErrorCode::IllegalFormat)), Traffic::default());
    let found = trial.into_found();
    let summary: Vec<_> = found.iter().map(|found| (found.station, found.answer, found.notes.join("; "))).collect();
    let text = |bytes| format!("{bytes} bytes that are no frame");
    assert_eq!(
        summary,
        [
            (Some(1), StationAnswer::Bad, text(7)),
            (Some(2), StationAnswer::Bad, text(3)),
            (Some(3), StationAnswer::Ok, String::new())
        ]
    );

    // Garbage in another framing says nothing about a station.
    let mut trial = Trial::new(&questions, None, true);
    let asked = run_with_noise(&mut trial, &noise(4));
    assert_eq!(asked, 3);
    let [found] = &trial.into_found()[..] else { panic!("one station") };
    assert_eq!((found.station, found.answer), (Some(1), StationAnswer::Ok));
    assert_eq!(found.notes, ["12 bytes that are no frame before the framing was known"]);
}

/// Garbage for each ASCII request, and an answer of station 1 in binary. Returns the ASCII requests.
fn run_with_noise(trial: &mut Trial<'_>, noise: &Traffic) -> usize {
    let mut asked = 0;
    loop {
        match trial.step() {
            TrialStep::Status { framing: Framing::Ascii, .. } => {
                asked += 1;
                trial.status(None, noise.clone());
            }
            TrialStep::Status { station, .. } => trial.status(good().filter(|_| station == 1), Traffic::default()),
            TrialStep::Detail { .. } => {
                trial.detail(Some(Reply::Refused(ErrorCode::IllegalFormat)), Traffic::default());
            }
            TrialStep::Listen { .. } => trial.listened(Traffic::default(), false),
            TrialStep::Open | TrialStep::End => return asked,
        }
    }
}

#[test]
fn the_reply_of_the_last_station_may_be_late() {
    for framing in [Framing::Ascii, Framing::Binary] {
        let questions = questions(&[1], 0);
        let mut trial = Trial::new(&questions, Some(framing), true);
        trial.status(None, Traffic::default());
        assert_eq!(trial.step(), TrialStep::Listen { framing });
        trial.listened(status_of(1, framing), false);
        assert_eq!(trial.step(), TrialStep::End);
        let [late] = &trial.into_found()[..] else { panic!("one station") };
        assert_eq!((late.answer, late.station), (StationAnswer::Late, Some(1)));
    }
    // A connection that ends meanwhile is opened for the next framing.
    let questions = questions(&[1], 0);
    let mut trial = Trial::new(&questions, None, true);
    trial.status(None, Traffic::default());
    trial.listened(Traffic::default(), true);
    assert_eq!(trial.step(), TrialStep::Open);
    // Over UDP a silent host is perhaps not there.
    let mut trial = Trial::new(&questions, None, false);
    trial.status(None, Traffic::default());
    assert_eq!(trial.step(), TrialStep::Status { framing: Framing::Binary, station: 1 });
}
