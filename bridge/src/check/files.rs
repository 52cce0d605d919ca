//! Files, folders and ports that a configuration needs.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use fatek::endpoint::Transport;
use fatek::plant::PlantPlc;
use rustix::fs::Access as Rights;

use super::access::Access;
use super::{Finding, Severity, finding};
use crate::config::{Config, Environment};
use crate::secret::{Secret, SecretError};
use crate::tls::TlsFiles;

/// The effect of a token.
pub const TOKEN_RULE: &str = "it has no effect yet: no request over HTTP writes anything, and reading needs no token";

/// Adds what is missing. Files are read, and nothing is opened or made.
pub(super) fn check(config: &Config, environment: &Environment, findings: &mut Vec<Finding>) {
    let Config { bridge, mqtt, nats, .. } = config;
    // A token that cannot be read is no fault, since nothing uses it.
    let token = bridge.token();
    if !matches!(token, Ok(None)) {
        findings.push(finding(Severity::Warning, "bridge.token_file", TOKEN_RULE));
    }
    if token.is_ok() {
        secret("bridge.token_file", bridge.token_file.as_deref(), token, environment, findings);
    }
    if let Some(mqtt) = mqtt {
        secret("mqtt.password_file", mqtt.password_file.as_deref(), mqtt.password(), environment, findings);
        let files = [&mqtt.ca_file, &mqtt.cert_file, &mqtt.key_file];
        tls("mqtt", mqtt.url.is_tls(), files, findings);
    }
    if let Some(nats) = nats {
        secret("nats.creds_file", nats.creds_file.as_deref(), nats.credentials(), environment, findings);
        secret("nats.password_file", nats.password_file.as_deref(), nats.password(), environment, findings);
        let files = [&nats.ca_file, &nats.cert_file, &nats.key_file];
        tls("nats", nats.url.is_tls(), files, findings);
    }
    if let Some(dir) = &bridge.buffer.dir
        && let Some(text) = folder_fault(dir)
    {
        findings.push(finding(Severity::Warning, "bridge.buffer.dir", text));
    }
    ports(config, findings);
}

/// A secret that cannot be read is a fault: its output cannot connect.
fn secret(
    key: &str,
    file: Option<&Path>,
    found: Result<Option<Secret>, SecretError>,
    environment: &Environment,
    findings: &mut Vec<Finding>,
) {
    if let Err(error) = found {
        let hint = match environment.credentials {
            Some(_) => "",
            None => " (a service has it in $CREDENTIALS_DIRECTORY)",
        };
        findings.push(finding(Severity::Fault, key, format!("{error}{hint}")));
    } else if let Some(file) = file
        && let Ok(metadata) = std::fs::metadata(file)
        && metadata.permissions().mode() & 0o004 != 0
    {
        let text = format!("{}: every user of this host can read it: chmod 600 prevents that", file.display());
        findings.push(finding(Severity::Warning, key, text));
    }
}

fn tls(section: &str, is_tls: bool, [ca, cert, key]: [&Option<PathBuf>; 3], findings: &mut Vec<Finding>) {
    if !is_tls {
        return;
    }
    let files = TlsFiles { ca: ca.as_deref(), cert: cert.as_deref(), key: key.as_deref() };
    if let Err(error) = files.load() {
        findings.push(finding(Severity::Fault, section, error.to_string()));
    }
}

/// The reason why the folder of the buffer cannot be used, or made, by this user.
fn folder_fault(dir: &Path) -> Option<String> {
    let existing = dir.ancestors().find(|folder| folder.exists())?;
    let fault = if !existing.is_dir() {
        format!("{} is not a folder", existing.display())
    } else if rustix::fs::access(existing, Rights::WRITE_OK | Rights::EXEC_OK).is_err() {
        format!("this user cannot write to {}", existing.display())
    } else {
        return None;
    };
    Some(fault)
}

/// Serial ports of this host that are missing, or not for this user. Another user may run the bridge, and an
/// adapter may be plugged in later.
fn ports(config: &Config, findings: &mut Vec<Finding>) {
    let mut paths: Vec<&str> = Vec::new();
    let id = config.bridge.id.as_str();
    let is_here = |plc: &&PlantPlc| config.fleet.is_none() || plc.hosts().any(|host| host == id);
    for plc in config.plant.plcs().filter(is_here) {
        if let Transport::Serial { path, .. } = plc.endpoint().transport()
            && !paths.contains(&path.as_str())
        {
            paths.push(path);
        }
    }
    for path in paths {
        let access = Access::of(Path::new(path), Path::new("/"));
        if let Some(reason) = access.reason() {
            let remedy = access.remedy().map_or_else(String::new, |remedy| format!(": {remedy}"));
            findings.push(finding(Severity::Warning, path, format!("{reason}{remedy}")));
        }
    }
}
