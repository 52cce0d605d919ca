//! Prints the tables of docs/PLAN.md on twelve realistic tag sets: plans with and without words of
//! discretes, beside simpler methods, and times on the simulated line.
//!
//! ```text
//! cargo run --release --example plan_sets --features sim
//! cargo test --example plan_sets --features sim             # compares docs/PLAN.md with it
//! ```

mod sets;
mod simulated;

use std::error::Error;
use std::time::Duration;

use fatek::endpoint::SerialSettings;
use fatek::plan::{CostModel, Limits, Plan};
use fatek::tag::Tag;
use fatek::wire::Framing;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

fn main() -> Result<()> {
    print!("{}\n{}", table()?, simulated::table()?);
    Ok(())
}

/// The table of costs, as in docs/PLAN.md.
fn table() -> Result<String> {
    let mut table =
        String::from("| tags | line | one request per tag | gap merging | without words | `Plan` | ms less |\n");
    table += "|---|---|---:|---:|---:|---:|---:|\n";
    for (name, tags) in sets::all()? {
        for (line, cost) in lines()? {
            let plan = |limits: Limits| Plan::builder(cost).limits(limits).tags(tags.iter().copied()).build();
            let no_words = Limits::new().words_of_discretes(false);
            let single: Vec<Plan> = tags
                .iter()
                .map(|tag| Plan::builder(cost).limits(no_words.clone()).tag(*tag).build())
                .collect::<std::result::Result<_, _>>()?;
            let merged = plan(no_words.clone().mixed_reads(false))?;
            let (before, now) = (plan(no_words)?, plan(Limits::new())?);
            let less = before.time().saturating_sub(now.time());
            // For up to eight values, no plan is cheaper: tests compare it with all others.
            let values = tags.iter().map(Tag::value_count).sum::<usize>();
            let optimal = if values <= 8 { ", optimal" } else { "" };
            table += &format!(
                "| {name} | {line} | {} | {} | {} | {}{optimal} | {:.1} |\n",
                cell(&single),
                cell(&[merged]),
                cell(&[before]),
                cell(&[now]),
                milliseconds(less)
            );
        }
    }
    Ok(table)
}

/// The lines of the tables.
fn lines() -> Result<[(&'static str, CostModel); 3]> {
    let serial = SerialSettings::new(Framing::Ascii);
    Ok([
        ("9600 baud", CostModel::serial(serial, Framing::Ascii)),
        ("115200 baud", CostModel::serial(serial.with_baud(115_200)?, Framing::Ascii)),
        ("TCP, 5 ms", CostModel::network(Framing::Ascii, Duration::from_millis(5))),
    ])
}

/// Requests, bytes and milliseconds of plans.
fn cell(plans: &[Plan]) -> String {
    let requests: usize = plans.iter().map(|plan| plan.requests().len()).sum();
    let bytes: usize = plans.iter().map(Plan::bytes).sum();
    let time: Duration = plans.iter().map(Plan::time).sum();
    format!("{requests} / {bytes} / {:.1}", milliseconds(time))
}

fn milliseconds(time: Duration) -> f64 {
    time.as_secs_f64() * 1e3
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_tables_of_the_page_are_those_of_this_example() {
        let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/PLAN.md")).unwrap();
        for table in [super::table().unwrap(), super::simulated::table().unwrap()] {
            assert!(page.contains(&table), "docs/PLAN.md has another table:\n{table}");
        }
    }
}
