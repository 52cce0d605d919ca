//! Measures the bridge: `cargo run --release --example load -- --help`.
//!
//! It starts simulated PLCs in a process of their own, a server if the output needs one, and the bridge; it
//! subscribes, and prints for each period: samples a second, samples for each second of processor time of the
//! bridge, the age of the samples at the subscriber, and the memory of the bridge.
//!
//! The age is the time between the reply of the PLC and the arrival at the subscriber.

mod common;

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use clap::{Parser, ValueEnum};
use futures::StreamExt as _;
use rumqttc::v5::mqttbytes::QoS;
use rumqttc::v5::{AsyncClient, Event, Incoming, MqttOptions};
use tokio::sync::mpsc::{UnboundedSender, unbounded_channel};

use common::{Process, Result, cpu_time, free_port, memory, nats_server, program, serve, start_plcs, start_server};

/// Measures the bridge with simulated PLCs
#[derive(Debug, Parser)]
struct Args {
    /// Number of PLCs
    #[arg(long, default_value_t = 200)]
    plcs: usize,
    /// Tags of each PLC
    #[arg(long, default_value_t = 64)]
    tags: usize,
    /// Period of the readings
    #[arg(long, default_value = "100ms")]
    every: String,
    /// Output that is measured
    #[arg(long, value_enum, default_value_t = Output::Stdout)]
    output: Output,
    /// Time of the measurement
    #[arg(long = "for", default_value = "30s")]
    duration: humantime::Duration,
    /// Periods that are printed
    #[arg(long, default_value = "10s")]
    period: humantime::Duration,
    /// Buffer in memory alone, without a file
    #[arg(long)]
    memory_only: bool,
    /// Bridge; by default fatek-bridge of the same profile
    #[arg(long)]
    bridge: Option<PathBuf>,
    /// Serve the PLCs: used by this program itself
    #[arg(long, hide = true)]
    serve: bool,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Output {
    Stdout,
    Mqtt,
    Nats,
}

/// A message at the subscriber.
struct Arrival {
    samples: usize,
    age: Duration,
}

#[tokio::main]
async fn main() -> Result<()> {
    let args = Args::parse();
    if args.serve { serve(args.plcs, 0).await } else { measure(args).await }
}

async fn measure(args: Args) -> Result<()> {
    let folder = tempfile::tempdir()?;
    let (_plcs, addresses) = start_plcs(args.plcs, 0)?;
    let port = free_port()?;
    let _server = start_output(args.output, port, folder.path())?;
    let config = folder.path().join("plant.toml");
    std::fs::write(&config, configuration(&args, &addresses, port))?;
    let (sender, mut arrivals) = unbounded_channel();
    subscribe(args.output, port, sender.clone()).await?;

    let program = program(args.bridge.as_deref())?;
    let mut command = Command::new(program);
    command.arg("run").arg(&config).env("STATE_DIRECTORY", folder.path()).stdout(Stdio::piped());
    let mut bridge = Process(command.spawn()?);
    let stdout = bridge.0.stdout.take().ok_or("no stdout of the bridge")?;
    if args.output == Output::Stdout {
        std::thread::spawn(move || {
            BufReader::new(stdout).lines().map_while(std::result::Result::ok).for_each(|line| {
                let _ = sender.send(arrival(line.as_bytes()));
            });
        });
    }
    // Plans and connections are made first.
    tokio::time::sleep(Duration::from_secs(3)).await;
    while arrivals.try_recv().is_ok() {}

    println!("{} PLCs of {} tags, each {}, to {:?}", args.plcs, args.tags, args.every, args.output);
    let end = Instant::now() + *args.duration;
    while Instant::now() < end {
        let (begun, cpu) = (Instant::now(), cpu_time(bridge.0.id())?);
        let (mut samples, mut messages, mut ages) = (0, 0, Vec::new());
        let period = tokio::time::sleep((*args.period).min(end - begun));
        tokio::pin!(period);
        loop {
            tokio::select! {
                () = &mut period => break,
                arrival = arrivals.recv() => {
                    let Arrival { samples: more, age } = arrival.ok_or("the subscription has ended")?;
                    samples += more;
                    messages += 1;
                    ages.push(age);
                }
            }
        }
        ages.sort_unstable();
        let oldest = ages.last().copied().ok_or("no message has arrived in this period")?;
        let age = |share: f64| ages.get((ages.len() as f64 * share) as usize).copied().unwrap_or(oldest);
        let (seconds, cpu) = (begun.elapsed().as_secs_f64(), (cpu_time(bridge.0.id())? - cpu).as_secs_f64());
        println!(
            "{:.0} samples/s in {:.0} messages/s; {:.1} % of a core: {:.0} samples a core-second; \
             age p50 {:.1?}, p99 {:.1?}, max {:.1?}; memory {:.1} MiB",
            samples as f64 / seconds,
            f64::from(messages) / seconds,
            cpu / seconds * 100.0,
            samples as f64 / cpu,
            age(0.5),
            age(0.99),
            oldest,
            memory(bridge.0.id())? as f64 / 1048576.0,
        );
    }
    Ok(())
}

fn configuration(args: &Args, addresses: &[String], port: u16) -> String {
    let dir = if args.memory_only { "" } else { "dir = 'buffer', " };
    let mut text = format!("[bridge]\nid = 'load'\nhttp = '127.0.0.1:0'\nbuffer = {{ {dir}memory = '64MiB' }}\n");
    text += &match args.output {
        Output::Stdout => "[stdout]\n".to_owned(),
        Output::Mqtt => format!("[mqtt]\nurl = 'mqtt://127.0.0.1:{port}'\n"),
        Output::Nats => format!("[nats]\nurl = 'nats://127.0.0.1:{port}'\n"),
    };
    text += &format!("[class]\nall = {{ every = '{}' }}\n[template.all]\n", args.every);
    for tag in 0..args.tags {
        text += &format!("value_{tag} = {{ at = 'R{tag}:i16', class = 'all' }}\n");
    }
    for (plc, address) in addresses.iter().enumerate() {
        text += &format!("[plc.plc_{plc}]\nlink = 'tcp://{address}'\nstation = 1\nuse = ['all']\n");
    }
    text
}

fn start_output(output: Output, port: u16, folder: &Path) -> Result<Option<Process>> {
    let command = match output {
        Output::Stdout => return Ok(None),
        Output::Mqtt => {
            let config = folder.join("mosquitto.conf");
            std::fs::write(
                &config,
                format!("listener {port} 127.0.0.1\nallow_anonymous true\nmax_queued_messages 0\n"),
            )?;
            let mut command = Command::new("mosquitto");
            command.arg("-c").arg(config);
            command
        }
        Output::Nats => nats_server(port, folder),
    };
    start_server(command, port).map(Some)
}

async fn subscribe(output: Output, port: u16, arrivals: UnboundedSender<Arrival>) -> Result<()> {
    match output {
        Output::Stdout => {}
        Output::Mqtt => {
            let (client, mut events) = AsyncClient::new(MqttOptions::new("load-subscriber", "127.0.0.1", port), 64);
            client.subscribe("fatek/load/+/data", QoS::AtMostOnce).await?;
            tokio::spawn(async move {
                let _client = client;
                loop {
                    match events.poll().await {
                        Ok(Event::Incoming(Incoming::Publish(publish))) => {
                            let _ = arrivals.send(arrival(&publish.payload));
                        }
                        Ok(Event::Incoming(_) | Event::Outgoing(_)) => {}
                        Err(error) => return eprintln!("subscriber: {error}"),
                    }
                }
            });
        }
        Output::Nats => {
            let client = async_nats::connect(format!("nats://127.0.0.1:{port}")).await?;
            let mut messages = client.subscribe("fatek.load.*.data").await?;
            tokio::spawn(async move {
                while let Some(message) = messages.next().await {
                    let _ = arrivals.send(arrival(&message.payload));
                }
            });
        }
    }
    Ok(())
}

/// The samples of a message, and their age now.
fn arrival(message: &[u8]) -> Arrival {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let text = String::from_utf8_lossy(message);
    let ts = text.split("\"ts\":").nth(1).and_then(|rest| rest.split(',').next()).and_then(|ts| ts.parse().ok());
    let ts = ts.unwrap_or_else(|| panic!("a message without a time: {text}"));
    let samples = text.matches("value_").count();
    Arrival { samples, age: now.saturating_sub(Duration::from_millis(ts)) }
}
