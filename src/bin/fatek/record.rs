//! Subcommand `fatek record FILE`: a proxy that passes bytes on unchanged, and records them.

mod datagrams;
mod streams;
mod writer;

use std::time::Duration;

use fatek::Endpoint;
use fatek::endpoint::Transport;

use self::writer::RecordingWriter;
use crate::args::RecordArgs;
use crate::failure::Failure;
use crate::listen::Listener;
use crate::output::{Output, print};
use crate::signal::Stop;

/// Connections at a time. Further ones wait.
const MAX_CONNECTIONS: usize = 64;

pub(crate) async fn record(
    endpoint: Endpoint,
    args: &RecordArgs,
    timeout: Option<Duration>,
    output: &Output,
) -> Result<(), Failure> {
    let is_udp = matches!(endpoint.transport(), Transport::Udp { .. });
    if is_udp != args.listen.starts_with("udp://") {
        let rule = "a link over UDP is recorded with --listen udp://HOST:PORT, and no other is";
        return Err(Failure::Usage(rule.to_owned()));
    }
    let mut stop = Stop::new()?;
    let (listener, url) = Listener::bind(&args.listen, endpoint.framing()).await?;
    // Before the file is made: after a wrong host, it must not exist.
    let plc = datagrams::resolve(&endpoint).await?;
    let writer = RecordingWriter::create(&args.file, &endpoint, args.max_size)?;
    if writer.is_stdout() {
        output.remark(format_args!("listening {url}"));
    } else {
        print(format_args!("listening {url}"))?;
    }
    let passing = async {
        match listener {
            Listener::Tcp(listener) => streams::pass_connections(listener, &endpoint, timeout, &writer, output).await,
            Listener::Udp(socket) => datagrams::pass(socket, plc, &endpoint, &writer).await,
            Listener::Serial(port, settings) => {
                let client = streams::SerialClient { port, settings, url: &args.listen };
                Err(streams::pass_port(client, &endpoint, timeout, &writer).await)
            }
        }
    };
    let ended = tokio::select! {
        biased;
        _ = stop.signalled() => Ok(()),
        failure = writer.failed() => Err(failure),
        ended = passing => ended,
    };
    output.remark(format_args!("{}", writer.summary()));
    ended
}
