//! Explores all interleavings of the models up to a bound, and checks that they detect planted
//! faults. See the README.

mod lock;
mod shared;

use std::process::{Command, ExitCode, Stdio};

use self::shared::{Ending, Fault, Model};

/// Limit of preemptions per interleaving, besides waits.
const BOUND: usize = 2;

fn main() -> ExitCode {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let args: Vec<&str> = args.iter().map(String::as_str).collect();
    let found = match args[..] {
        [] => all(BOUND),
        ["--bound", bound] => match bound.parse() {
            Ok(bound) => all(bound),
            Err(error) => {
                eprintln!("--bound {bound}: {error}");
                return ExitCode::from(2);
            }
        },
        // One run, in a process of its own, because loom aborts at an error.
        ["--one", model, ending, fault, bound] => {
            let (Some(model), Some(ending)) = (named(&Model::ALL, model), named(&Ending::ALL, ending)) else {
                return ExitCode::from(2);
            };
            shared::run(model, ending, named(&Fault::ALL, fault), bound.parse().unwrap_or(BOUND));
            true
        }
        _ => {
            eprintln!("usage: fatek-models [--bound N]");
            return ExitCode::from(2);
        }
    };
    if found { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}

fn all(bound: usize) -> bool {
    let mut good = true;
    for model in Model::ALL {
        for ending in Ending::ALL {
            let holds = one(model, ending, None, bound);
            good &= holds;
            println!("{model:?}, {ending:?}: {}", if holds { "all interleavings are correct" } else { "WRONG" });
        }
    }
    for fault in Fault::ALL {
        let runs = || Model::ALL.into_iter().flat_map(|model| Ending::ALL.map(|ending| (model, ending)));
        let found = runs().find(|&(model, ending)| !one(model, ending, Some(fault), bound));
        good &= found.is_some();
        match found {
            Some((model, ending)) => println!("{fault:?}: detected by {model:?}, {ending:?}"),
            None => println!("{fault:?}: NOT DETECTED"),
        }
    }
    good
}

/// Returns whether all interleavings of a run are correct. A run without a planted fault prints its
/// error.
fn one(model: Model, ending: Ending, fault: Option<Fault>, bound: usize) -> bool {
    let own = std::env::current_exe().expect("path of this program");
    let fault = fault.map_or_else(String::new, |fault| format!("{fault:?}"));
    let mut run = Command::new(own);
    run.args(["--one", &format!("{model:?}"), &format!("{ending:?}"), &fault, &bound.to_string()]);
    if !fault.is_empty() {
        run.stderr(Stdio::null());
    }
    run.status().expect("start of this program").success()
}

fn named<T: Copy + std::fmt::Debug>(all: &[T], name: &str) -> Option<T> {
    all.iter().copied().find(|one| format!("{one:?}") == name)
}
