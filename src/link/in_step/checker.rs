//! A model checker of the rule: a breadth-first search of all states of client, line and PLC.
//!
//! The client is the real [`InStep`](super::InStep) with the real spellings, driven as the core
//! drives it. The line and the PLC do what is assumed of them, up to a number of faults: replies
//! are late, are lost, and come more than once; replies to earlier processes are on their way. A
//! result is wrong if its reply answered another request. Requests are not counted in a state, so
//! "sound" holds for any number of them.
//!
//! `FATEK_CHECKER=full` sets larger bounds. With `--nocapture`, the tests print a table, and the
//! shortest trace of each wrong result.
#![allow(clippy::print_stdout, reason = "prints verdicts")]

mod client;
mod faults;
mod frame;
mod jobs;
mod model;
mod requests;
mod state;

use std::collections::{BTreeMap, HashMap, VecDeque};
use std::fmt::Write;
use std::rc::Rc;

use tokio::time::Instant;

use self::client::{Ablation, Client, Wrong};
use self::model::{Faults, starts, steps};
use self::requests::Name;
pub(super) use self::requests::Request;
use self::state::ModelState;
use super::Rule;

/// Number of states after which a search is cut.
const MOST_STATES: usize = 1_000_000;

/// The result of a search.
struct Verdict {
    states: usize,
    /// The shortest trace to a wrong result of each kind.
    found: BTreeMap<Wrong, String>,
    /// The maximum number of wrong results in a row, counted up to the bound.
    most: u8,
    cut: bool,
}

/// Searches all states. Traces end at `most` wrong results.
fn explore(faults: &Faults, rule: Rule, ablation: Ablation, most: u8) -> Verdict {
    let requests = Name::ALL.map(Request::of);
    let client = Client { rule, ablation, now: Instant::now(), by_content: faults.roam, lacks: faults.lacks, requests };
    let mut came: HashMap<Rc<ModelState>, Option<Rc<ModelState>>> = HashMap::new();
    let mut queue = VecDeque::new();
    for start in starts(faults, &client) {
        let start = Rc::new(start.canonical());
        came.insert(start.clone(), None);
        queue.push_back(start);
    }
    let mut verdict = Verdict { states: 0, found: BTreeMap::new(), most: 0, cut: false };
    while let Some(s) = queue.pop_front() {
        let mut wrongs = Vec::new();
        steps(faults, &client, &s, &mut |label, after, wrong| {
            let mut after = after.canonical();
            if let Some(wrong) = wrong {
                after.wrong += 1;
                verdict.most = verdict.most.max(after.wrong);
                if !verdict.found.contains_key(&wrong) {
                    wrongs.push((wrong, label.to_string()));
                }
                if after.wrong >= most {
                    return;
                }
            }
            if !came.contains_key(&after) {
                let after = Rc::new(after);
                came.insert(after.clone(), Some(s.clone()));
                queue.push_back(after);
            }
        });
        for (wrong, last) in wrongs {
            verdict.found.entry(wrong).or_insert_with(|| trace(faults, &client, &came, &s) + &last);
        }
        verdict.cut = came.len() >= MOST_STATES;
        if verdict.cut || ablation != Ablation::Nothing && !verdict.found.is_empty() && most == 1 {
            break;
        }
    }
    verdict.states = came.len();
    verdict
}

/// The trace to a state, one step a line.
fn trace(
    faults: &Faults,
    client: &Client,
    came: &HashMap<Rc<ModelState>, Option<Rc<ModelState>>>,
    s: &Rc<ModelState>,
) -> String {
    let mut states = vec![s];
    while let Some(Some(before)) = states.last().map(|s| &came[*s]) {
        states.push(before);
    }
    states.reverse();
    let on_its_way: Vec<_> = states[0].on_its_way().map(ToString::to_string).collect();
    let mut lines = format!("        on its way at the start: {}\n", on_its_way.join("; "));
    for pair in states.windows(2) {
        let mut found = false;
        steps(faults, client, pair[0], &mut |label, after, wrong| {
            let mut after = after.canonical();
            after.wrong += u8::from(wrong.is_some());
            if !found && after == **pair[1] {
                writeln!(lines, "        {label}").unwrap();
                found = true;
            }
        });
    }
    lines + "        "
}

/// Searches, and prints a line of the table and the traces.
fn report(name: &str, faults: &Faults, rule: Rule, ablation: Ablation, most: u8) -> Verdict {
    let began = std::time::Instant::now();
    let verdict = explore(faults, rule, ablation, most);
    let found: Vec<_> = verdict.found.keys().collect();
    let said = match (verdict.found.is_empty(), verdict.cut) {
        (true, false) => "sound".to_owned(),
        (true, true) => "cut, sound so far".to_owned(),
        (false, _) if most > 1 => format!("at most {} wrong: {found:?}", verdict.most),
        (false, _) => format!("WRONG {found:?}"),
    };
    println!("{name:28} | {:34} | {:7} | {said} | {:.1} s", faults.name, verdict.states, began.elapsed().as_secs_f32());
    let wanted = ablation == Ablation::Nothing || std::env::var("FATEK_CHECKER").is_ok();
    for trace in verdict.found.values().filter(|_| wanted) {
        println!("{trace}");
    }
    verdict
}

fn is_full() -> bool {
    std::env::var("FATEK_CHECKER").is_ok_and(|value| value == "full")
}
