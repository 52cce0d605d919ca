//! The stream of the batches: made if it is missing, and checked otherwise.

use std::time::Duration;

use async_nats::jetstream::context::{Context, GetStreamErrorKind};
use async_nats::jetstream::stream::{Config, DiscardPolicy, StorageType};

use super::connection::with_sources;
use crate::topic::Topics;

/// The age of the oldest message of a stream that the bridge has made.
const MAX_AGE: Duration = Duration::from_secs(7 * 24 * 3600);
/// The time in which a stream that the bridge has made finds duplicates.
const DUPLICATES: Duration = Duration::from_secs(120);
/// The shortest such time: that of a lost connection, which is opened again, with room for a restart of the server.
const MIN_DUPLICATES: Duration = Duration::from_secs(60);
/// The JetStream error of a stream that does not exist.
const NOT_FOUND: u64 = 10059;

/// Makes the stream, or checks that it captures the batches, and no commands.
///
/// # Errors
/// The rule that it breaks, or the error of the server.
pub(super) async fn prepare(
    context: &Context,
    name: &str,
    prefix: &str,
    topics: &Topics,
    takes_commands: bool,
) -> Result<(), String> {
    let error = match context.get_stream(name).await {
        Ok(stream) => {
            let config = &stream.cached_info().config;
            check(config, topics, takes_commands)?;
            if let Some(fault) = duplicates_fault(config) {
                tracing::warn!("nats: {fault}");
            }
            return Ok(());
        }
        Err(error) => error,
    };
    let is_missing = matches!(error.kind(), GetStreamErrorKind::JetStream(reply) if reply.error_code().0 == NOT_FOUND);
    if !is_missing {
        return Err(format!("the stream {name} cannot be read (is JetStream enabled?): {}", with_sources(&error)));
    }
    let created = context.create_stream(new_config(name, prefix)).await;
    created.map_err(|error| format!("the stream {name} cannot be made: {}", with_sources(&error)))?;
    tracing::info!(stream = name, "nats: the stream was made");
    Ok(())
}

/// The stream of all bridges with this prefix.
fn new_config(name: &str, prefix: &str) -> Config {
    Config {
        name: name.to_owned(),
        subjects: vec![format!("{prefix}.*.*.data")],
        storage: StorageType::File,
        discard: DiscardPolicy::Old,
        max_age: MAX_AGE,
        duplicate_window: DUPLICATES,
        description: Some("Batches of fatek-bridge".to_owned()),
        ..Config::default()
    }
}

fn check(config: &Config, topics: &Topics, takes_commands: bool) -> Result<(), String> {
    let captures = |subject: &str| config.subjects.iter().any(|pattern| covers(pattern, subject));
    let (name, data, commands) = (&config.name, topics.all_data(), topics.all_commands());
    if !captures(&data) {
        let subjects = config.subjects.join(", ");
        return Err(format!(
            "the stream {name} captures {subjects}, and not {data}: add it (nats stream edit {name} --subjects=…), \
             or set nats.stream to another name"
        ));
    }
    if takes_commands && captures(&commands) {
        return Err(format!(
            "the stream {name} captures the commands {commands} as well, and would answer in place of the bridge: \
             its subjects must be {data} alone"
        ));
    }
    if config.no_ack {
        return Err(format!("the stream {name} acknowledges nothing (no_ack): batches could be lost unnoticed"));
    }
    Ok(())
}

/// The fault of a stream that finds duplicates for a short time alone.
fn duplicates_fault(config: &Config) -> Option<String> {
    let (name, window) = (&config.name, config.duplicate_window);
    let fault = format!(
        "the stream {name} finds duplicates for {window:?} alone: after a lost connection batches are stored twice \
         (nats stream edit {name} --dupe-window=2m)"
    );
    (window < MIN_DUPLICATES).then_some(fault)
}

/// Returns whether all subjects of one pattern are subjects of another.
fn covers(pattern: &str, subject: &str) -> bool {
    let mut tokens = subject.split('.');
    let mut wanted = pattern.split('.');
    loop {
        match (wanted.next(), tokens.next()) {
            (Some(">"), Some(_)) | (None, None) => return true,
            (Some("*"), Some(token)) if token != ">" => {}
            (Some(literal), Some(token)) if literal == token => {}
            (_, _) => return false,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Name;

    #[test]
    fn a_pattern_covers_those_that_are_narrower() {
        for (pattern, subject, expected) in [
            ("fatek.*.*.data", "fatek.hall-2.*.data", true),
            ("fatek.hall-2.*.data", "fatek.hall-2.*.data", true),
            ("fatek.>", "fatek.hall-2.*.data", true),
            (">", "fatek.hall-2.*.data", true),
            ("fatek.hall-1.*.data", "fatek.hall-2.*.data", false),
            ("fatek.hall-2.mixer.data", "fatek.hall-2.*.data", false),
            ("fatek.*.data", "fatek.hall-2.*.data", false),
            ("fatek.hall-2.*.data.>", "fatek.hall-2.*.data", false),
            ("fatek.hall-2.*.data", "fatek.>", false),
            ("fatek.*", "fatek.>", false),
            ("fatek", "fatek", true),
        ] {
            assert_eq!(covers(pattern, subject), expected, "{pattern} {subject}");
        }
    }

    #[test]
    fn a_stream_that_finds_duplicates_for_a_short_time_is_warned_of() {
        let config = |duplicate_window| Config { duplicate_window, ..new_config("FATEK", "fatek") };
        assert_eq!(duplicates_fault(&new_config("FATEK", "fatek")), None);
        assert_eq!(duplicates_fault(&config(MIN_DUPLICATES)), None);
        for window in [Duration::ZERO, Duration::from_millis(100), Duration::from_millis(59_999)] {
            let fault = duplicates_fault(&config(window)).unwrap();
            assert!(fault.starts_with(&format!("the stream FATEK finds duplicates for {window:?} alone")), "{fault}");
        }
    }

    #[test]
    fn an_existing_stream_captures_the_batches_and_no_commands() {
        let topics = Topics::nats(&Name::constant("fatek"), &Name::constant("hall-2"));
        let config = |subjects: &[&str], no_ack| Config {
            name: "FATEK".to_owned(),
            subjects: subjects.iter().map(|subject| (*subject).to_owned()).collect(),
            no_ack,
            ..Config::default()
        };
        assert_eq!(check(&new_config("FATEK", "fatek"), &topics, true), Ok(()));
        assert_eq!(check(&config(&["other", "fatek.hall-2.*.data"], false), &topics, true), Ok(()));
        assert_eq!(check(&config(&["fatek.>"], false), &topics, false), Ok(()));
        let error = |config: &Config| check(config, &topics, true).unwrap_err();
        assert!(error(&config(&["fatek.>"], false)).contains("captures the commands fatek.hall-2.*.cmd as well"));
        assert!(error(&config(&["fatek.hall-1.*.data"], false)).contains("and not fatek.hall-2.*.data: add it"));
        assert!(error(&config(&["fatek.*.*.data"], true)).contains("no_ack"));
    }
}
