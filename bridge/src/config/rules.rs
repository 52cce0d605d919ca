//! Rules of several keys, and the variables that take the place of keys.

use std::path::PathBuf;
use std::time::Duration;

use super::environment::{Environment, HTTP_VARIABLE, ID_VARIABLE};
use super::error::ConfigFault;
use super::sections::ADDRESS_RULE;
use super::source::Source;
use super::values::NAME_RULE;
use super::{BridgeSection, FleetSection, Name, Sections};
use crate::buffer::{BufferError, BufferSettings};

/// Adds the faults of keys that do not fit together.
pub(super) fn check(sections: &Sections, source: &Source<'_>, faults: &mut Vec<ConfigFault>) {
    let Sections { bridge, mqtt, nats, stdout: _, fleet } = sections;
    if bridge.buffer.memory.0 == 0 {
        faults.push(source.fault(&["bridge", "buffer", "memory"], "it is more than 0"));
    }
    if !(1..=100_000).contains(&bridge.connects_per_second) {
        faults.push(source.fault(&["bridge", "connects_per_second"], "it is 1 to 100000"));
    }
    if let Err(BufferError::Limit { key, least, .. }) = BufferSettings::of(&bridge.buffer).check() {
        faults.push(source.fault(&["bridge", "buffer", key], format!("with `dir` it is at least {} KiB", least >> 10)));
    }
    if let Some(mqtt) = mqtt {
        pair("mqtt", &mqtt.cert_file, &mqtt.key_file, source, faults);
        tls("mqtt", mqtt.url.is_tls(), [&mqtt.ca_file, &mqtt.cert_file, &mqtt.key_file], source, faults);
        if mqtt.password_file.is_some() && mqtt.user.is_none() {
            faults.push(source.fault(&["mqtt", "password_file"], "it needs user"));
        }
    }
    if let Some(nats) = nats {
        pair("nats", &nats.cert_file, &nats.key_file, source, faults);
        tls("nats", nats.url.is_tls(), [&nats.ca_file, &nats.cert_file, &nats.key_file], source, faults);
        if nats.password_file.is_some() && nats.user.is_none() {
            faults.push(source.fault(&["nats", "password_file"], "it needs user"));
        }
        if nats.user.is_some() && nats.creds_file.is_some() {
            faults.push(source.fault(&["nats", "user"], "it is in place of creds_file: only one of them is allowed"));
        }
    }
    if let Some(FleetSection { lease, weight, .. }) = fleet {
        if !source.has_key(&["nats"]) {
            faults.push(source.fault(&["fleet"], "it needs the section nats: its server holds the leases"));
        }
        if !(Duration::from_millis(500)..=Duration::from_secs(60)).contains(&lease.0) {
            faults.push(source.fault(&["fleet", "lease"], "a lease is 500ms to 1m"));
        }
        if !(1..=1000).contains(weight) {
            faults.push(source.fault(&["fleet", "weight"], "a weight is 1 to 1000"));
        }
    }
}

/// A certificate and its key belong together.
fn pair(
    section: &str,
    cert: &Option<PathBuf>,
    key: &Option<PathBuf>,
    source: &Source<'_>,
    faults: &mut Vec<ConfigFault>,
) {
    match (cert, key) {
        (Some(_), Some(_)) | (None, None) => {}
        (Some(_), None) => faults.push(source.fault(&[section, "cert_file"], "it needs key_file")),
        (None, Some(_)) => faults.push(source.fault(&[section, "key_file"], "it needs cert_file")),
    }
}

/// Files of TLS have no effect without it, and a user who set them believes that it is used.
fn tls(section: &str, is_tls: bool, files: [&Option<PathBuf>; 3], source: &Source<'_>, faults: &mut Vec<ConfigFault>) {
    for (key, file) in ["ca_file", "cert_file", "key_file"].into_iter().zip(files) {
        if file.is_some() && !is_tls {
            faults.push(source.fault(&[section, key], "it is for TLS, and the scheme of the URL is without"));
        }
    }
}

/// Replaces the keys that have a variable.
pub(super) fn apply(environment: &Environment, bridge: &mut BridgeSection, faults: &mut Vec<ConfigFault>) {
    let mut fault = |variable: &str, rule: &str| {
        faults.push(ConfigFault { line: None, key: format!("${variable}"), rule: rule.to_owned() });
    };
    if let Some(id) = &environment.id {
        match Name::parse(id) {
            Some(id) => bridge.id = id,
            None => fault(ID_VARIABLE, NAME_RULE),
        }
    }
    if let Some(http) = &environment.http {
        match http.parse() {
            Ok(http) => bridge.http = http,
            Err(_) => fault(HTTP_VARIABLE, ADDRESS_RULE),
        }
    }
}
