//! Call rates over loopback TCP, compared with a lower limit of the cost and with a peer.
//!
//! ```text
//! cargo bench -p fatek-benches --bench call                      # a table
//! cargo bench -p fatek-benches --bench call -- --csv             # and docs/performance/call.csv
//! cargo bench -p fatek-benches --bench call -- --test            # a few requests of each, as a test
//! ```
//!
//! In each setting the methods of reading 64 registers take turns, so that other load of the
//! machine affects all of them:
//!
//! - a [`Station`](fatek::Station) of this crate;
//! - the limit: a bare `write` and `read` of the same bytes;
//! - the peer: tokio-modbus with the same number of registers; without a timeout, and with one as
//!   in each call of a `Station`.
//!
//! Each round gives a ratio of two rates; the table has their median and quartiles. The [`server`]
//! is the same for all: a thread that answers every request with the same prepared bytes.
//! [`clients`] has the methods.

mod clients;
mod options;
mod server;
mod table;

use std::error::Error;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use tokio::runtime::{Builder, Runtime};

use self::clients::{Client, Way};
use self::options::Options;
use self::server::Servers;
use self::table::{Row, Table};

type Result<T> = std::result::Result<T, Box<dyn Error + Send + Sync>>;

/// Number of links and callers.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Setting {
    pub(crate) links: usize,
    /// Callers per link.
    pub(crate) callers: usize,
}

const SETTINGS: [Setting; 4] = [
    Setting { links: 1, callers: 1 },
    Setting { links: 64, callers: 1 },
    Setting { links: 1000, callers: 1 },
    Setting { links: 1, callers: 64 },
];

fn main() -> ExitCode {
    match Options::parse(std::env::args().skip(1)) {
        Ok(Some(options)) => match run(&options) {
            Ok(()) => ExitCode::SUCCESS,
            Err(error) => {
                eprintln!("call: {error}");
                ExitCode::FAILURE
            }
        },
        Ok(None) => {
            print!("{}", options::HELP);
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("{error}\n\n{}", options::HELP);
            ExitCode::from(2)
        }
    }
}

fn run(options: &Options) -> Result<()> {
    let servers = Servers::start()?;
    let mut table = Table::new();
    table.head();
    for (name, runtime) in [("current_thread", Builder::new_current_thread()), ("multi_thread", threads())] {
        let mut runtime = runtime;
        for setting in SETTINGS.into_iter().filter(|setting| options.selects(name, *setting)) {
            let runtime = runtime.enable_all().build()?;
            for row in measure(&runtime, name, setting, &servers, options)? {
                table.add(row);
            }
        }
    }
    if options.csv {
        table.save()?;
    }
    Ok(())
}

fn threads() -> Builder {
    let mut builder = Builder::new_multi_thread();
    builder.worker_threads(2);
    builder
}

/// Measures all methods in one setting, in turns.
fn measure(
    runtime: &Runtime,
    name: &'static str,
    setting: Setting,
    servers: &Servers,
    options: &Options,
) -> Result<Vec<Row>> {
    let mut ways = Vec::new();
    // All methods have their connections open, with both ends in this process: more than 20,000
    // descriptors are not to be had everywhere.
    let fits = |way: &Way| setting.links < 1000 || !matches!(way, Way::Task(_));
    for way in Way::ALL.into_iter().filter(|way| options.selects_way(*way) && fits(way)) {
        ways.push((way, runtime.block_on(clients::connect(way, setting, servers))?, Vec::new()));
    }
    // Warm-up: connects and buffers are not part of the cost of a call.
    let mut requests = Vec::new();
    for (_, clients, _) in &mut ways {
        let few = options.requests.unwrap_or(500_usize.div_ceil(clients.len()));
        round(runtime, clients, few)?;
        let each = round(runtime, clients, few)?.div_f64(few as f64);
        let by_time = options.round.div_duration_f64(each) as usize;
        requests.push(options.requests.unwrap_or(by_time.max(1)));
    }
    for n in 0..options.rounds {
        // The order rotates, so that no method is always the first or the last.
        let mut order: Vec<usize> = (0..ways.len()).collect();
        let first = n % order.len().max(1);
        order.rotate_left(first);
        for at in order {
            let (Some((_, clients, rates)), Some(&requests)) = (ways.get_mut(at), requests.get(at)) else { continue };
            let calls = requests * clients.len();
            rates.push(calls as f64 / round(runtime, clients, requests)?.as_secs_f64());
        }
    }
    let rates: Vec<(Way, Vec<f64>)> = ways.into_iter().map(|(way, _, rates)| (way, rates)).collect();
    Ok(table::rows(name, setting, &rates))
}

/// Runs all clients concurrently, with `requests` each. Returns the time taken.
fn round(runtime: &Runtime, clients: &mut Vec<Client>, requests: usize) -> Result<Duration> {
    runtime.block_on(async {
        let began = Instant::now();
        let tasks: Vec<_> = clients
            .drain(..)
            .map(|mut client| tokio::spawn(async move { client.call(requests).await.map(|()| client) }))
            .collect();
        for task in tasks {
            clients.push(task.await??);
        }
        Ok(began.elapsed())
    })
}
