//! Prints the first table of docs/PLAN.md: plans, compared with one request per tag and with gap
//! merging.
//!
//! ```text
//! cargo run --release --example plan_table
//! cargo test --example plan_table             # compares the table of docs/PLAN.md with it
//! ```

mod tags;

use std::error::Error;
use std::time::Duration;

use fatek::endpoint::SerialSettings;
use fatek::plan::{CostModel, Limits, Plan};
use fatek::tag::Tag;
use fatek::wire::Framing;

type Result<T> = std::result::Result<T, Box<dyn Error>>;

fn main() -> Result<()> {
    print!("{}", table()?);
    Ok(())
}

/// The table, as in docs/PLAN.md.
fn table() -> Result<String> {
    let serial = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(10));
    let sets =
        [("clustered", tags::clustered(240)?), ("random", tags::random(200, 10_000, 4000, 2000)?), ("wide", wide()?)];
    let mut table = String::from("| tags | line | plan | requests | bytes | ms |\n|---|---|---|---:|---:|---:|\n");
    for (name, tags) in &sets {
        for (line, cost) in [("9600 baud", serial), ("TCP, 10 ms", network)] {
            table += &row(name, line, "one request per tag", &one_by_one(tags, cost)?);
            // Gap merging: runs that read through short gaps, without mixed reads and words of discretes.
            let runs = Limits::new().mixed_reads(false).words_of_discretes(false);
            let merged = Plan::builder(cost).limits(runs.clone()).tags(tags.iter().copied()).build()?;
            table += &row(name, line, "gap merging", &[merged]);
            table += &row(name, line, "`Plan`", &[Plan::builder(cost).tags(tags.iter().copied()).build()?]);
        }
    }
    Ok(table)
}

fn row(name: &str, line: &str, method: &str, plans: &[Plan]) -> String {
    let requests: usize = plans.iter().map(|plan| plan.requests().len()).sum();
    let bytes: usize = plans.iter().map(Plan::bytes).sum();
    let time: Duration = plans.iter().map(Plan::time).sum();
    format!("| {name} | {line} | {method} | {requests} | {bytes} | {:.1} |\n", time.as_secs_f64() * 1e3)
}

fn one_by_one(tags: &[Tag], cost: CostModel) -> Result<Vec<Plan>> {
    tags.iter()
        .map(|&tag| Ok(Plan::builder(cost).limits(Limits::new().words_of_discretes(false)).tag(tag).build()?))
        .collect()
}

/// Long ranges of each symbol, and some single values far apart.
fn wide() -> Result<Vec<Tag>> {
    let texts = ["R0-R999", "D100-D399:f32", "M0-M799", "WX0-WX240", "X0-X99", "RT0-RT63", "R5000", "D9000:i32", "Y7"];
    texts.iter().map(|text| Ok(text.parse()?)).collect()
}

#[cfg(test)]
mod tests {
    #[test]
    fn the_table_of_the_page_is_that_of_this_example() {
        let page = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/docs/PLAN.md")).unwrap();
        let table = super::table().unwrap();
        assert!(page.contains(&table), "docs/PLAN.md has another table:\n{table}");
    }
}
