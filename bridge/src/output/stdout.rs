//! Output to stdout: lines of JSON, for trying and for pipes.

use std::io;
use std::sync::Arc;

use futures::future::OptionFuture;
use tokio::io::{AsyncWriteExt as _, Stdout};
use tokio_util::sync::CancellationToken;

use super::Health;
use crate::batch::Batch;
use crate::buffer::{Cursor, Entry};
use crate::registry::Registry;

/// The batches that are written at once.
const MAX_BATCHES: usize = 256;

/// Writes batches until `stop`. A batch counts as acknowledged when the system has taken it. After stdout was
/// closed, batches are discarded, so that they do not fill the buffer.
pub async fn run(mut cursor: Cursor, health: Arc<Health>, registry: Registry, stop: CancellationToken) {
    let mut stdout = Some(tokio::io::stdout());
    health.set_connected(false);
    let deliver = async {
        loop {
            let entries = cursor.next(MAX_BATCHES).await;
            if let Some(Err(error)) =
                OptionFuture::from(stdout.as_mut().map(|out| write(out, &entries, &registry))).await
            {
                // There is no other stdout to open.
                tracing::warn!(%error, "stdout was closed: no more lines");
                health.set_failed(error);
                stdout = None;
            }
            for entry in entries {
                if stdout.is_some() {
                    health.count(entry.batch.samples);
                }
                cursor.acknowledge(entry.position);
            }
        }
    };
    tokio::select! {
        () = deliver => {}
        () = stop.cancelled() => {}
    }
}

async fn write(stdout: &mut Stdout, entries: &[Entry], registry: &Registry) -> io::Result<()> {
    let line_of = |entry: &Entry| line(&entry.batch, entry.replay || registry.is_former(&entry.batch));
    let text: Vec<u8> = entries.iter().flat_map(line_of).collect();
    stdout.write_all(&text).await?;
    stdout.flush().await
}

/// The message with the name of the PLC: `{"plc":"mixer","seq":…}`.
fn line(batch: &Batch, replay: bool) -> Vec<u8> {
    let message = batch.message(replay);
    // The name has no character that JSON escapes.
    let mut line = format!(r#"{{"plc":"{}","#, batch.plc).into_bytes();
    line.extend_from_slice(message.get(1..).unwrap_or_default());
    line.push(b'\n');
    line
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_a_document_with_the_name_of_the_plc() {
        let batch =
            Batch { plc: "mixer".into(), revision: 0, seq: 7, ts: 9, samples: 1, data: "{\"level\":1.5}".into() };
        assert_eq!(line(&batch, false), b"{\"plc\":\"mixer\",\"seq\":7,\"ts\":9,\"d\":{\"level\":1.5}}\n");
        assert_eq!(line(&batch, true), b"{\"plc\":\"mixer\",\"seq\":7,\"ts\":9,\"hist\":true,\"d\":{\"level\":1.5}}\n");
    }
}
