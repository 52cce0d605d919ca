//! Check of a configuration without a connection to anything: plans, load of the links, files, and settings
//! that are allowed and probably not meant.
//!
//! The load of a link is the share of its time that the requests of all scan classes take, by the cost model
//! of the planner: of a serial line by its speed, of a network by its round trip.

#[path = "../../src/bin/fatek/ports/access.rs"]
#[allow(dead_code, reason = "the command line shows more of it")]
mod access;
mod files;
mod load;
mod settings;
mod text;

use std::fmt;
use std::path::{Path, PathBuf};
use std::time::Duration;

use serde_json::{Value, json};

pub use self::files::TOKEN_RULE;
pub use self::load::{ClassPlan, LinkLoad};
use crate::config::{Config, ConfigError, Environment};
use crate::topic::Topics;

/// Result of a check.
#[derive(Clone, Debug)]
pub struct Report {
    /// The file.
    pub path: PathBuf,
    /// The plans of each PLC and scan class.
    pub plans: Vec<ClassPlan>,
    /// `true`: a fleet shares the links.
    pub is_fleet: bool,
    /// The links, with their load.
    pub links: Vec<LinkLoad>,
    /// The outputs.
    pub outputs: Vec<OutputSummary>,
    /// Faults and warnings: first the faults.
    pub findings: Vec<Finding>,
}

/// An output of a [`Report`].
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OutputSummary {
    /// Its name.
    pub name: &'static str,
    /// The URL of its server.
    pub server: Option<String>,
    /// The topic or subject of the data, with `PLC` in place of the name.
    pub topic: Option<String>,
    /// `true`: it takes commands.
    pub commands: bool,
}

/// The weight of a [`Finding`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// The configuration cannot be run here.
    Fault,
    /// It can be run, and is probably not as it is meant.
    Warning,
}

/// A fault or a warning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// Its weight.
    pub severity: Severity,
    /// The line of the file, if it has one.
    pub line: Option<usize>,
    /// The path of the key, such as `mqtt.url`.
    pub key: String,
    /// The rule, or the reason.
    pub text: String,
}

/// A finding without a line.
fn finding(severity: Severity, key: impl Into<String>, text: impl Into<String>) -> Finding {
    Finding { severity, line: None, key: key.into(), text: text.into() }
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Fault => "fault",
            Self::Warning => "warning",
        })
    }
}

impl Report {
    /// Checks a file. `round_trip`: the time of a request on a network, and the response time of the PLCs on
    /// a serial line. Blocks until the disk has read all files.
    #[must_use]
    pub fn of(path: &Path, environment: &Environment, round_trip: Duration) -> Self {
        let mut report = Self {
            path: path.to_owned(),
            plans: Vec::new(),
            is_fleet: false,
            links: Vec::new(),
            outputs: Vec::new(),
            findings: Vec::new(),
        };
        match Config::read(path, environment) {
            Ok(config) => report.fill(&config, environment, round_trip),
            Err(ConfigError::Io { error, .. }) => {
                report.findings.push(finding(Severity::Fault, "", format!("the file cannot be read: {error}")));
            }
            Err(ConfigError::Faults { faults, .. }) => report.findings.extend(faults.into_iter().map(|fault| {
                Finding { severity: Severity::Fault, line: fault.line, key: fault.key, text: fault.rule }
            })),
        }
        report
    }

    fn fill(&mut self, config: &Config, environment: &Environment, round_trip: Duration) {
        let findings = &mut self.findings;
        self.plans = load::plans(config, round_trip, findings);
        self.is_fleet = config.fleet.is_some();
        self.links = load::links(config, &self.plans, findings);
        self.outputs = outputs(config);
        files::check(config, environment, findings);
        settings::check(config, findings);
        // Stable: in the order in which they were found.
        findings.sort_by_key(|finding| finding.severity);
    }

    /// The number of findings of this weight.
    #[must_use]
    pub fn count(&self, severity: Severity) -> usize {
        self.findings.iter().filter(|finding| finding.severity == severity).count()
    }

    /// The report as a JSON document.
    #[must_use]
    pub fn to_json(&self) -> Value {
        let rounded = |number: f64| (number * 1000.0).round() / 1000.0;
        let milliseconds = |time: Duration| rounded(time.as_secs_f64() * 1000.0);
        let plan = |plan: &ClassPlan| {
            json!({
                "plc": plan.plc, "station": plan.station, "link": plan.link, "class": plan.class,
                "every_ms": milliseconds(plan.every), "tags": plan.tags, "requests": plan.requests,
                "bytes": plan.bytes, "time_ms": milliseconds(plan.time),
            })
        };
        let link = |link: &LinkLoad| {
            json!({
                "link": link.link, "id": link.id, "hosts": link.hosts, "plcs": link.plcs,
                "requests_per_second": rounded(link.requests_per_second),
                "bytes_per_second": rounded(link.bytes_per_second), "load_percent": rounded(link.load * 100.0),
            })
        };
        let output = |output: &OutputSummary| {
            json!({
                "name": output.name, "server": output.server, "topic": output.topic, "commands": output.commands,
            })
        };
        let finding = |finding: &Finding| {
            json!({
                "severity": finding.severity.to_string(), "line": finding.line, "key": finding.key,
                "text": finding.text,
            })
        };
        json!({
            "file": self.path.to_string_lossy(),
            "plans": self.plans.iter().map(plan).collect::<Vec<_>>(),
            "links": self.links.iter().map(link).collect::<Vec<_>>(),
            "outputs": self.outputs.iter().map(output).collect::<Vec<_>>(),
            "findings": self.findings.iter().map(finding).collect::<Vec<_>>(),
        })
    }
}

fn outputs(config: &Config) -> Vec<OutputSummary> {
    let id = config.topic_id();
    let mut outputs = Vec::new();
    if config.stdout.is_some() {
        outputs.push(OutputSummary { name: "stdout", server: None, topic: None, commands: false });
    }
    if let Some(mqtt) = &config.mqtt {
        let topic = Topics::mqtt(&mqtt.prefix, id).data("PLC");
        let server = mqtt.url.to_string();
        outputs.push(OutputSummary { name: "mqtt", server: Some(server), topic: Some(topic), commands: mqtt.write });
    }
    if let Some(nats) = &config.nats {
        let topic = Topics::nats(&nats.prefix, id).data("PLC");
        let server = nats.url.to_string();
        outputs.push(OutputSummary { name: "nats", server: Some(server), topic: Some(topic), commands: nats.write });
    }
    outputs
}

#[cfg(test)]
mod tests;
