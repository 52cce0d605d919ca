//! Subcommand `fatek replay FILE`: repeats a recorded conversation, with a PLC or as a simulated one.

mod answers;
mod client;
mod script;
mod server;

use std::time::Duration;

use fatek::Endpoint;
use fatek::wire::Framing;

use self::answers::Answers;
use self::script::{Script, ScriptedRequest};
use crate::args::{ReplayArgs, TimingArg, WritesArg};
use crate::confirm::{can_be_confirmed, confirm};
use crate::conversation::Entry;
use crate::failure::Failure;
use crate::listen::Listener;
use crate::output::{Cell, Output, Rows, print};
use crate::progress::StatusLine;
use crate::signal::Stop;
use crate::traffic::{Source, TrafficFailure, entries};
use crate::transfer::shown;

/// Longest recording, which is held in memory.
const MAX_ENTRIES: usize = 1_000_000;

/// Longest pause between two requests that is repeated.
const MAX_PAUSE: Duration = Duration::from_secs(24 * 3600);

/// Sends the recorded requests, and compares the replies.
pub(crate) async fn send(
    endpoint: Endpoint,
    args: &ReplayArgs,
    timeout: Option<Duration>,
    output: &Output,
) -> Result<(), Failure> {
    let recorded = recorded(args)?;
    let mut script = Script::new(&recorded, endpoint.framing());
    check_framing(&recorded, script.steps.len(), endpoint.framing(), args)?;
    consent(&mut script.steps, &endpoint, args).await?;
    if args.consent.dry_run {
        return dry_run(&script.steps, output);
    }
    check_pauses(&script, args)?;
    let mut stop = Stop::new()?;
    let mut replay = client::Replay::new(endpoint, timeout, args.timing);
    let mut rows = Rows::new(["request", "station", "sent", "recorded", "now"]);
    let (mut differing, mut done) = (0, 0);
    let status = StatusLine::new(output);
    let ended = loop {
        status.show(format_args!("{done} of {} requests sent", script.steps.len()));
        let Some(step) = script.steps.get(done) else { break Ok(()) };
        let reply = tokio::select! {
            biased;
            signal = stop.signalled() => {
                let all = script.steps.len();
                break Err(Failure::interrupted(format!(": {done} of {all} requests sent"))(signal));
            }
            reply = replay.step(step) => reply,
        };
        let reply = match reply {
            Ok(reply) => reply,
            Err(failure) => break Err(failure),
        };
        done += 1;
        if let Some([recorded, now]) = step.difference(reply.as_ref()) {
            differing += 1;
            let cells: [Cell; 5] =
                [done.into(), step.station().into(), step.text().into(), recorded.into(), now.into()];
            rows.push(cells);
        }
    };
    drop(status);
    output.rows(&rows)?;
    output.remark(format_args!("{done} of {} requests sent, {differing} replies differ", script.steps.len()));
    ended?;
    if differing > 0 { Err(Failure::Differs { parts: "replies", differing, all: done }) } else { Ok(()) }
}

/// Answers as recorded, until a signal.
pub(crate) async fn serve(url: &str, args: &ReplayArgs, output: &Output) -> Result<(), Failure> {
    let recorded = recorded(args)?;
    let framing = args.framing.or_else(|| script::framing(&recorded)).unwrap_or_default();
    let answers = Answers::new(&recorded, framing);
    check_framing(&recorded, answers.len(), framing, args)?;
    let mut stop = Stop::new()?;
    let (listener, url) = Listener::bind(url, framing).await?;
    print(format_args!("listening {url}"))?;
    let service = server::Service::new(answers, framing, args.timing);
    tokio::select! {
        biased;
        _ = stop.signalled() => {}
        failure = service.serve(listener) => return Err(failure),
    }
    output.remark(format_args!("{}", service.summary()));
    Ok(())
}

fn recorded(args: &ReplayArgs) -> Result<Vec<Entry>, Failure> {
    entries(&mut Source::open(&args.file)?, &args.ports, args.framing, MAX_ENTRIES)
}

/// Refuses a recording without requests of this framing.
fn check_framing(recorded: &[Entry], of_framing: usize, framing: Framing, args: &ReplayArgs) -> Result<(), Failure> {
    if of_framing > 0 {
        return Ok(());
    }
    let name = shown(&args.file);
    let rule = match script::framing(recorded) {
        Some(other) if other != framing => format!("its frames are {other}, and those of the link are {framing}"),
        Some(_) | None => "it has no requests".to_owned(),
    };
    Err(TrafficFailure::Damaged { name, rule }.into())
}

/// Refuses pauses that are too long to repeat, as of a wrong clock, before anything is sent.
fn check_pauses(script: &Script, args: &ReplayArgs) -> Result<(), Failure> {
    let longest = script.longest_pause();
    if args.timing == TimingArg::Fast || longest <= MAX_PAUSE {
        return Ok(());
    }
    let hours = MAX_PAUSE.as_secs() / 3600;
    let rule =
        format!("a pause of {} s between two requests: the most is {hours} h; give --timing fast", longest.as_secs());
    Err(TrafficFailure::Damaged { name: shown(&args.file), rule }.into())
}

/// Applies `--writes`. Asks before requests that may change the PLC are sent.
async fn consent(steps: &mut Vec<ScriptedRequest>, endpoint: &Endpoint, args: &ReplayArgs) -> Result<(), Failure> {
    let writes = steps.iter().filter(|step| step.may_write()).count();
    let Some(first) = steps.iter().find(|step| step.may_write()) else { return Ok(()) };
    match args.writes {
        Some(WritesArg::Skip) => {
            steps.retain(|step| !step.may_write());
            Ok(())
        }
        None if args.consent.dry_run => Ok(()),
        None => Err(Failure::Usage(format!(
            "{writes} of {} requests may change the PLC, the first is station {}: {}; to leave them out, give \
             --writes skip, to send them, --writes send",
            steps.len(),
            first.station(),
            first.text()
        ))),
        Some(WritesArg::Send) if args.consent.dry_run => Ok(()),
        Some(WritesArg::Send) => {
            can_be_confirmed(args.consent.yes)?;
            let question = format!(
                "Send {} requests to {endpoint}, {writes} of which may change the PLC? The first is station {}: {}.",
                steps.len(),
                first.station(),
                first.text()
            );
            confirm(&question, args.consent.yes).await
        }
    }
}

/// Prints the requests that would be sent.
fn dry_run(steps: &[ScriptedRequest], output: &Output) -> Result<(), Failure> {
    let mut rows = Rows::new(["station", "request", "may_write"]);
    for step in steps {
        rows.push([step.station().into(), step.text().into(), step.may_write().into()]);
    }
    output.rows(&rows)?;
    output.remark(format_args!("{} requests would be sent", steps.len()));
    Ok(())
}
