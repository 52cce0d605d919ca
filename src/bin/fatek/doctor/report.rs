//! The report of an examination, as text, Markdown and JSON.

use std::fmt::Write as _;
use std::time::Duration;

use fatek::wire::Framing;
use serde_json::{Value, json};

use super::check::{Check, Finding, Group, Verdict};
use super::evidence;
use super::facts::Facts;
use super::line::Medium;
use super::run::Examined;
use super::times::Times;
use crate::output::{Cell, Rows, hex, version};

/// Width of the lines of text.
const WIDTH: usize = 80;

/// Options of a report.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Contents {
    /// Requests and replies.
    pub(crate) evidence: bool,
    /// Values in them.
    pub(crate) values: bool,
    /// The station in them.
    pub(crate) address: bool,
}

#[derive(Debug)]
pub(crate) struct Report {
    rows: Vec<Row>,
    medium: Medium,
    framing: Framing,
    /// Link and station, if they are to be told.
    address: Option<String>,
    times: Option<Times>,
    /// Raw statuses 40 and 53.
    detailed: Option<String>,
    os_version: Option<String>,
    sent: usize,
    lasted: Duration,
    /// The reason why it is not complete.
    ended: Option<String>,
}

#[derive(Debug)]
struct Row {
    group: Group,
    name: String,
    finding: Finding,
    assumes: String,
    source: &'static str,
    evidence: Vec<String>,
}

impl Report {
    pub(crate) fn new(
        checks: &[Check],
        examined: &[Option<Examined>],
        facts: &Facts,
        contents: Contents,
        (sent, lasted): (usize, Duration),
    ) -> Self {
        let mut rows: Vec<Row> = checks
            .iter()
            .zip(examined)
            .map(|(check, examined)| row(check, examined.as_ref(), facts, contents))
            .collect();
        // The order of examination has the commands first.
        rows.sort_by_key(|row| row.group);
        let times = facts.log.iter().filter_map(|exchange| exchange.response_time(facts.framing())).collect();
        let status = facts.detailed();
        Self {
            rows,
            medium: facts.medium,
            framing: facts.framing(),
            address: None,
            times: Times::new(times),
            detailed: status.map(|status| hex(status.raw())),
            os_version: status.map(|status| version(status.os_version())),
            sent,
            lasted,
            ended: None,
        }
    }

    pub(crate) fn with_address(self, address: Option<String>) -> Self {
        Self { address, ..self }
    }

    pub(crate) fn with_ended(self, ended: Option<String>) -> Self {
        Self { ended, ..self }
    }

    pub(crate) fn count(&self, verdict: Verdict) -> usize {
        self.rows.iter().filter(|row| row.finding.verdict == verdict).count()
    }

    pub(crate) fn len(&self) -> usize {
        self.rows.len()
    }

    /// The numbers of checks by verdict, in one line.
    pub(crate) fn summary(&self) -> String {
        let [holds, contradicts, open] = [Verdict::Holds, Verdict::Contradicts, Verdict::Open].map(|v| self.count(v));
        format!(
            "{} checks: {holds} hold, {contradicts} contradict, {open} open; {} requests in {:.1} s",
            self.len(),
            self.sent,
            self.lasted.as_secs_f64()
        )
    }

    /// For a terminal: groups of lines, with the assumption where it is contradicted.
    pub(crate) fn text(&self) -> String {
        let mut text = String::new();
        for (title, rows) in self.groups() {
            // Writing to a string does not fail.
            let _ = writeln!(text, "{title}");
            for row in rows {
                let begin = format!("  {:<11}  {:<15}  ", row.finding.verdict.as_str(), row.name);
                text += &wrapped(&begin, &row.finding.text);
                if row.finding.verdict == Verdict::Contradicts {
                    let assumed = format!("assumed: {} ({})", row.assumes, row.source);
                    text += &wrapped(&" ".repeat(begin.len()), &assumed);
                }
                row.evidence.iter().for_each(|line| {
                    let _ = writeln!(text, "      {line}");
                });
            }
            text.push('\n');
        }
        if let Some(times) = &self.times {
            let _ = writeln!(text, "Response times");
            times.lines().iter().for_each(|line| {
                let _ = writeln!(text, "  {line}");
            });
        }
        text.trim_end().to_owned()
    }

    pub(crate) fn rows(&self) -> Rows {
        let mut rows = Rows::new(["group", "check", "verdict", "found", "assumed", "source"]);
        for row in &self.rows {
            let cells = [
                row.group.title(),
                &row.name,
                row.finding.verdict.as_str(),
                &row.finding.text,
                &row.assumes,
                row.source,
            ];
            rows.push(cells.map(Cell::from));
        }
        rows
    }

    pub(crate) fn json(&self) -> Value {
        let checks = self.rows.iter().map(|row| {
            let mut check = json!({
                "group": row.group.title(),
                "check": row.name,
                "verdict": row.finding.verdict.as_str(),
                "found": row.finding.text,
                "assumed": row.assumes,
                "source": row.source,
            });
            if let Some(fields) = check.as_object_mut().filter(|_| !row.evidence.is_empty()) {
                fields.insert("evidence".to_owned(), row.evidence.clone().into());
            }
            check
        });
        json!({
            "fatek": env!("CARGO_PKG_VERSION"),
            "transport": self.medium.as_str(),
            "framing": self.framing.to_string(),
            "address": self.address,
            "os_version": self.os_version,
            "detailed_status": self.detailed,
            "requests": self.sent,
            "seconds": (self.lasted.as_secs_f64() * 10.0).round() / 10.0,
            "ended_early": self.ended,
            "checks": checks.collect::<Value>(),
            "response_times_ms": self.times.as_ref().map(Times::json),
        })
    }

    pub(crate) fn markdown(&self) -> String {
        let mut text = String::new();
        let unknown = || "unknown".to_owned();
        let head = [
            ("fatek", env!("CARGO_PKG_VERSION").to_owned()),
            ("PLC, module, firmware", "(fill in, such as FBs-24MC with FBs-CBE)".to_owned()),
            ("transport", format!("{}, {}", self.medium.as_str(), self.framing)),
            ("OS version", self.os_version.clone().unwrap_or_else(unknown)),
            ("detailed status (53)", self.detailed.clone().map_or_else(unknown, |raw| format!("`{raw}`"))),
        ];
        let _ = writeln!(text, "# Examination of a PLC\n\n| | |\n|---|---|");
        let more = self.address.iter().map(|address| ("address", format!("`{}`", cell(address))));
        let ended = self.ended.iter().map(|reason| ("ended early", cell(reason)));
        for (name, value) in head.into_iter().chain(more).chain(ended) {
            let _ = writeln!(text, "| {name} | {value} |");
        }
        let _ = writeln!(text, "\n{}.\n", self.summary());
        for (title, rows) in self.groups() {
            let _ =
                writeln!(text, "## {title}\n\n| check | verdict | found | assumed | source |\n|---|---|---|---|---|");
            for row in &rows {
                let verdict = match row.finding.verdict {
                    Verdict::Contradicts => "**contradicts**",
                    verdict @ (Verdict::Holds | Verdict::Open) => verdict.as_str(),
                };
                let (found, assumes, source) = (cell(&row.finding.text), cell(&row.assumes), cell(row.source));
                let _ = writeln!(text, "| {} | {verdict} | {found} | {assumes} | {source} |", row.name);
            }
            let _ = writeln!(text);
            for row in rows.iter().filter(|row| !row.evidence.is_empty()) {
                let _ = writeln!(text, "{}:\n\n```text\n{}\n```\n", row.name, row.evidence.join("\n"));
            }
        }
        if let Some(times) = &self.times {
            let _ = writeln!(text, "## Response times\n\n```text\n{}\n```", times.lines().join("\n"));
        }
        text
    }

    fn groups(&self) -> Vec<(&'static str, Vec<&Row>)> {
        let mut groups: Vec<(&'static str, Vec<&Row>)> = Vec::new();
        for row in &self.rows {
            match groups.last_mut() {
                Some((title, rows)) if *title == row.group.title() => rows.push(row),
                Some(_) | None => groups.push((row.group.title(), vec![row])),
            }
        }
        groups
    }
}

fn row(check: &Check, examined: Option<&Examined>, facts: &Facts, contents: Contents) -> Row {
    let lines = |examined: &Examined| {
        let exchanges = examined.exchanges.iter().filter(|_| contents.evidence);
        exchanges.flat_map(|exchange| evidence::lines(exchange, facts.requests, contents)).collect()
    };
    Row {
        group: check.group,
        name: check.name.clone(),
        finding: examined.map_or_else(|| Finding::open("not examined: ended early"), |e| e.finding.clone()),
        assumes: check.assumes.clone(),
        source: check.source,
        evidence: examined.map(lines).unwrap_or_default(),
    }
}

/// A cell of a table in Markdown.
fn cell(text: &str) -> String {
    text.replace('\\', "\\\\").replace('|', "\\|").replace(['\n', '\r'], " ")
}

/// Words behind a beginning, wrapped to the width and indented like the first line.
fn wrapped(begin: &str, text: &str) -> String {
    let indent = begin.chars().count();
    let (mut lines, mut line) = (String::new(), begin.to_owned());
    let mut is_empty = true;
    for word in text.split(' ') {
        if !is_empty && line.chars().count() + 1 + word.chars().count() > WIDTH {
            lines += line.trim_end();
            lines.push('\n');
            (line, is_empty) = (" ".repeat(indent), true);
        }
        if !is_empty {
            line.push(' ');
        }
        line += word;
        is_empty = false;
    }
    format!("{lines}{}\n", line.trim_end())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_texts_are_wrapped_behind_their_beginning() {
        let text = wrapped("  name  ", &"word ".repeat(20));
        assert!(text.lines().all(|line| line.len() <= WIDTH), "{text}");
        assert!(text.lines().skip(1).all(|line| line.starts_with("        word")), "{text}");
        assert_eq!(text.lines().count(), 2);
        assert_eq!(wrapped("x ", &"y".repeat(100)).lines().count(), 1);
    }

    #[test]
    fn cells_of_markdown_stay_in_their_column() {
        assert_eq!(cell("a|b\nc\\"), "a\\|b c\\\\");
    }
}
