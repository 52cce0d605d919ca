//! Output to stdout: lines of JSON, for trying and for pipes.

use std::sync::Arc;

use tokio::io::AsyncWriteExt as _;

use super::Health;
use crate::batch::Batch;
use crate::buffer::Cursor;

/// The batches that are written at once.
const MAX_BATCHES: usize = 256;

/// Writes batches until stdout is closed. A batch counts as acknowledged when the system has taken it.
pub async fn run(mut cursor: Cursor, health: Arc<Health>) {
    let mut stdout = tokio::io::stdout();
    health.set_connected(false);
    loop {
        let entries = cursor.next(MAX_BATCHES).await;
        let text: Vec<u8> = entries.iter().flat_map(|entry| line(&entry.batch, entry.replay)).collect();
        let written = match stdout.write_all(&text).await {
            Ok(()) => stdout.flush().await,
            Err(error) => Err(error),
        };
        if let Err(error) = written {
            // There is no other stdout to open.
            tracing::warn!(%error, "stdout was closed: no more lines");
            health.set_failed(error);
            return;
        }
        for entry in entries {
            health.count(entry.batch.samples);
            cursor.acknowledge(entry.position);
        }
    }
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
        let batch = Batch { plc: "mixer".into(), seq: 7, ts: 9, samples: 1, data: "{\"level\":1.5}".into() };
        assert_eq!(line(&batch, false), b"{\"plc\":\"mixer\",\"seq\":7,\"ts\":9,\"d\":{\"level\":1.5}}\n");
        assert_eq!(line(&batch, true), b"{\"plc\":\"mixer\",\"seq\":7,\"ts\":9,\"hist\":true,\"d\":{\"level\":1.5}}\n");
    }
}
