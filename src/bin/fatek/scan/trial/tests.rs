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
fn status_of(station: u8, framing: Framing) -> Heard {
    let mut bytes = BytesMut::new();
    encode_reply(&ReadStatus, Ok(&BriefStatus::from_raw([1, 0, 0])), framing, station, &mut bytes);
    let frame = Codec::new(framing, Side::Client).decode(&mut bytes).unwrap().and_then(Received::frame).unwrap();
    Heard { frames: vec![frame], ..Heard::default() }
}

/// Takes part in a trial: `plc` gives the answer to each status. Returns the requests, such as `a1` for
/// the status of station 1 in ASCII and `d1` for its detailed status.
fn run(trial: &mut Trial<'_>, mut plc: impl FnMut(Framing, u8) -> Option<(Reply<BriefStatus>, Duration)>) -> String {
    let mut asked = Vec::new();
    loop {
        match trial.step() {
            Step::Status { framing, station } => {
                asked.push(format!("{}{station}", &framing.to_string()[..1]));
                trial.status(plc(framing, station), Heard::default());
            }
            Step::Detail { station, .. } => {
                asked.push(format!("d{station}"));
                trial.detail(None, Heard::default());
            }
            Step::Open => panic!("it was not lost"),
            Step::End => return asked.join(" "),
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
        let mut trial = Trial::new(&questions, None);
        let asked = run(&mut trial, |_, _| None);
        assert_eq!(asked, expected);
        assert_eq!(asked.split(' ').count(), usize::try_from(questions.when_silent()).unwrap());
        assert_eq!(trial.framing(), None);
        assert_eq!(trial.into_found(false), [], "UDP: it is not known whether there is a PLC");
    }
    let questions = questions(&[1], 0);
    let [silent] = &Trial::new(&questions, None).into_found(true)[..] else { panic!("one row") };
    assert_eq!((silent.answer, silent.station), (Answer::Silent, None));
}

#[test]
fn the_framing_of_the_first_answer_is_the_only_one() {
    let questions = questions(&[1, 2, 3], 1);
    let mut trial = Trial::new(&questions, None);
    let asked = run(&mut trial, |framing, station| good().filter(|_| framing == Framing::Binary && station == 2));
    assert_eq!(asked, "a1 a1 a2 a3 b1 b1 b2 d2 b3 b3");
    assert_eq!(trial.framing(), Some(Framing::Binary));
    let [found] = &trial.into_found(true)[..] else { panic!("one station") };
    assert_eq!((found.framing, found.station, found.time), (Some(Framing::Binary), Some(2), Some(TIME)));
    assert_eq!(found.notes, ["no answer to the detailed status (53)"]);

    let mut other = Trial::new(&questions, Some(Framing::Binary));
    assert_eq!(run(&mut other, |_, _| None), "b1 b1 b2 b3");
}

#[test]
fn a_refusal_is_an_answer_without_details() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None);
    let refused = |_, _| Some((Reply::Refused(ErrorCode::IllegalFormat), TIME));
    assert_eq!(run(&mut trial, refused), "a1 a2");
    let found = trial.into_found(true);
    assert_eq!(found.iter().map(|found| found.answer).collect::<Vec<_>>(), [Answer::Refused; 2]);
}

#[test]
fn a_late_reply_shows_the_framing_and_the_station() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None);
    trial.status(None, Heard::default());
    trial.status(None, status_of(1, Framing::Ascii));
    assert_eq!(trial.step(), Step::End, "there is no need to try the other framing");
    let [late] = &trial.into_found(true)[..] else { panic!("one station") };
    assert_eq!((late.answer, late.station), (Answer::Late, Some(1)));
}

#[test]
fn a_reply_more_than_requests_is_bad_and_one_to_a_retry_is_not() {
    for (retries, lost, expected) in [(0, 0, Answer::Bad), (1, 1, Answer::Ok)] {
        let questions = questions(&[1], retries);
        let mut trial = Trial::new(&questions, None);
        for _ in 0..lost {
            trial.status(None, Heard::default());
        }
        trial.status(good(), Heard::default());
        trial.detail(None, status_of(1, Framing::Ascii));
        assert_eq!(trial.into_found(true)[0].answer, expected, "{retries} retries");
    }
}

#[test]
fn a_connection_that_closes_after_each_reply_is_opened_again() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None);
    for station in 1..=2 {
        trial.status(good(), Heard::default());
        trial.lost("closed", Heard::default());
        assert_eq!(trial.step(), Step::Open);
        trial.opened();
        assert_eq!(trial.step(), Step::Detail { framing: Framing::Ascii, station });
        trial.detail(Some(Reply::Refused(ErrorCode::IllegalFormat)), Heard::default());
        if station == 1 {
            trial.lost("closed", Heard::default());
            trial.opened();
        }
    }
    assert_eq!(trial.step(), Step::End);
    let found = trial.into_found(true);
    assert!(found.iter().all(|found| found.answer == Answer::Ok && found.notes.is_empty()), "{found:?}");
}

#[test]
fn a_connection_that_is_closed_without_a_reply_is_not_opened_again() {
    let questions = questions(&[1, 2], 0);
    let mut trial = Trial::new(&questions, None);
    trial.lost("reset", Heard::default());
    assert_eq!(trial.step(), Step::End);
    let [silent] = &trial.into_found(true)[..] else { panic!("one row") };
    assert_eq!((silent.answer, &silent.notes[..]), (Answer::Silent, &["reset".to_owned()][..]));

    // Nor without end, by a peer that answers the status and closes.
    let mut trial = Trial::new(&questions, None);
    let mut opened = 0;
    while trial.step() != Step::End {
        match trial.step() {
            Step::Open => {
                opened += 1;
                trial.opened();
            }
            Step::Status { .. } => trial.status(good(), Heard::default()),
            Step::Detail { .. } | Step::End => trial.lost("closed", Heard::default()),
        }
        assert!(opened < 10);
    }
}

#[test]
fn traffic_without_frames_is_another_protocol_and_beside_a_reply_it_is_bad() {
    let noise = || Heard { bytes: 9, garbage: 9, ..Heard::default() };
    let questions = questions(&[1], 0);
    let mut trial = Trial::new(&questions, None);
    trial.status(None, noise());
    trial.status(None, Heard::default());
    let [other] = &trial.into_found(false)[..] else { panic!("one row") };
    assert_eq!((other.answer, other.answer.is_bad()), (Answer::Other, false));
    assert!(other.notes[0].contains("IPsec"), "{:?}", other.notes);

    let mut trial = Trial::new(&questions, None);
    trial.status(good(), noise());
    let [bad] = &trial.into_found(true)[..] else { panic!("one row") };
    assert_eq!((bad.answer, &bad.notes[..]), (Answer::Bad, &["9 bytes that are no frame".to_owned()][..]));
}
