//! The report as text of at most 80 columns.

use std::fmt;
use std::time::Duration;

use super::{ClassPlan, Finding, LinkLoad, Report, Severity};
use crate::columns::{Columns, cut};
use crate::printable::excerpt;

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if !self.plans.is_empty() {
            writeln!(f, "{}", plans(&self.plans))?;
        }
        match (self.links.is_empty(), self.is_fleet) {
            (true, _) => {}
            (false, true) => writeln!(f, "{}", fleet_links(&self.links))?,
            (false, false) => writeln!(f, "{}", links(&self.links))?,
        }
        if !self.outputs.is_empty() {
            let mut columns = Columns::new(["OUTPUT", "SERVER", "TOPIC", "COMMANDS"]);
            for output in &self.outputs {
                let text = |text: &Option<String>, width| cut(text.as_deref().unwrap_or("-"), width);
                let commands = if output.commands { "yes" } else { "no" };
                columns.row([
                    output.name.to_owned(),
                    text(&output.server, 32),
                    text(&output.topic, 27),
                    commands.to_owned(),
                ]);
            }
            writeln!(f, "{columns}")?;
        }
        self.findings.iter().try_for_each(|finding| writeln!(f, "{finding}"))?;
        write!(f, "{}: {}", excerpt(&self.path.to_string_lossy()), self.summary())
    }
}

impl Report {
    fn summary(&self) -> String {
        let number = |count: usize, word: &str| match count {
            1 => format!("1 {word}"),
            _ => format!("{count} {word}s"),
        };
        let (faults, warnings) = (self.count(Severity::Fault), self.count(Severity::Warning));
        if faults == 0 && warnings == 0 {
            return "no faults".to_owned();
        }
        format!("{}, {}", number(faults, "fault"), number(warnings, "warning"))
    }
}

impl fmt::Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { severity, line, key, text } = self;
        write!(f, "{severity}: ")?;
        if let Some(line) = line {
            write!(f, "line {line}{} ", if key.is_empty() { ":" } else { "," })?;
        }
        if !key.is_empty() {
            write!(f, "{}: ", excerpt(key))?;
        }
        // A table of tags has a line for each of its faults.
        for (number, line) in text.lines().enumerate() {
            write!(f, "{}{}", if number > 0 { "\n  " } else { "" }, excerpt(line))?;
        }
        Ok(())
    }
}

fn plans(plans: &[ClassPlan]) -> Columns<8> {
    let titles = ["PLC", "STATION", "CLASS", "EVERY", "TAGS", "REQUESTS", "BYTES", "TIME"];
    let mut columns = Columns::new(titles).right([1, 3, 4, 5, 6, 7]);
    let mut last = "";
    for plan in plans {
        let is_new = plan.plc != last;
        last = &plan.plc;
        let of_plc = |text: String| if is_new { text } else { String::new() };
        columns.row([
            of_plc(cut(&plan.plc, 17)),
            of_plc(plan.station.to_string()),
            cut(plan.class.as_deref().unwrap_or("(none)"), 12),
            humantime::format_duration(plan.every).to_string(),
            plan.tags.to_string(),
            plan.requests.to_string(),
            plan.bytes.to_string(),
            milliseconds(plan.time),
        ]);
    }
    columns
}

fn links(links: &[LinkLoad]) -> Columns<5> {
    let mut columns = Columns::new(["LINK", "PLCS", "REQUESTS/S", "BYTES/S", "LOAD"]).right([1, 2, 3, 4]);
    for link in links {
        columns.row([
            cut(&link.link, 40),
            link.plcs.to_string(),
            format!("{:.1}", link.requests_per_second),
            format!("{:.0}", link.bytes_per_second),
            format!("{:.1} %", link.load * 100.0),
        ]);
    }
    columns
}

/// The links of a fleet, with the members that can reach them.
fn fleet_links(links: &[LinkLoad]) -> Columns<6> {
    let mut columns = Columns::new(["ID", "LINK", "HOSTS", "PLCS", "REQUESTS/S", "LOAD"]).right([3, 4, 5]);
    for link in links {
        let hosts = if link.hosts.is_empty() { "all".to_owned() } else { link.hosts.join(",") };
        columns.row([
            cut(link.id.as_deref().unwrap_or("-"), 16),
            cut(&link.link, 20),
            cut(&hosts, 12),
            link.plcs.to_string(),
            format!("{:.1}", link.requests_per_second),
            format!("{:.0} %", link.load * 100.0),
        ]);
    }
    columns
}

fn milliseconds(time: Duration) -> String {
    format!("{:.1}ms", time.as_secs_f64() * 1000.0)
}
