//! Prints the tables of docs/PLAN.md: plans against one request per tag and against gap merging, and how long planning
//! takes.
//!
//! ```text
//! cargo run --release --example plan_table
//! ```

use std::error::Error;
use std::time::{Duration, Instant};

use fatek::endpoint::SerialSettings;
use fatek::plan::{CostModel, Limits, Plan};
use fatek::tag::{Tag, TagType};
use fatek::wire::Framing;
use fatek::{Discrete, Element, Register, Symbol};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

fn main() -> Result<()> {
    let serial = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(10));
    let sets = [("clustered", clustered()?), ("random", random(200)?), ("wide", wide()?)];
    println!("| tags | line | plan | requests | bytes | ms |");
    println!("|---|---|---|---:|---:|---:|");
    for (name, tags) in &sets {
        for (line, cost) in [("9600 baud", serial), ("TCP, 10 ms", network)] {
            row(name, line, "one request per tag", &one_by_one(tags, cost)?);
            // Gap merging is a plan without mixed reads: runs, with the gaps that are worth reading through.
            let merged =
                Plan::builder(cost).limits(Limits::new().no_mixed_reads()).tags(tags.iter().copied()).build()?;
            row(name, line, "gap merging", &[merged]);
            row(name, line, "`Plan`", &[Plan::builder(cost).tags(tags.iter().copied()).build()?]);
        }
    }
    println!("\n| tags | requests | planning, ms (median of 9) |");
    println!("|---:|---:|---:|");
    for n in [1_250, 2_500, 5_000, 10_000, 20_000, 40_000] {
        let tags = random(n)?;
        let mut times = Vec::new();
        let mut requests = 0;
        for _ in 0..9 {
            let builder = Plan::builder(serial).tags(tags.iter().copied());
            let start = Instant::now();
            requests = builder.build()?.requests().len();
            times.push(start.elapsed());
        }
        times.sort_unstable();
        println!("| {n} | {requests} | {:.2} |", times[4].as_secs_f64() * 1e3);
    }
    Ok(())
}

fn row(name: &str, line: &str, how: &str, plans: &[Plan]) {
    let requests: usize = plans.iter().map(|plan| plan.requests().len()).sum();
    let bytes: usize = plans.iter().map(Plan::bytes).sum();
    let time: Duration = plans.iter().map(Plan::time).sum();
    println!("| {name} | {line} | {how} | {requests} | {bytes} | {:.1} |", time.as_secs_f64() * 1e3);
}

fn one_by_one(tags: &[Tag], cost: CostModel) -> Result<Vec<Plan>> {
    tags.iter().map(|&tag| Ok(Plan::builder(cost).tag(tag).build()?)).collect()
}

/// 200 values in ten clusters, with gaps of one to seven between them, and 40 relays.
fn clustered() -> Result<Vec<Tag>> {
    let mut seed = 1;
    let mut tags = Vec::new();
    for cluster in 0..10_u16 {
        let mut address = cluster * 500;
        for n in 0..20 {
            let tag_type = if n % 4 == 0 { TagType::F32 } else { TagType::U16 };
            tags.push(Tag::new(Register::r(address), tag_type, 1)?);
            address += 2 + below(&mut seed, 7);
        }
    }
    for n in 0..40 {
        tags.push(Tag::from(Element::from(Discrete::new(Symbol::M, n * 3)?)));
    }
    Ok(tags)
}

/// Values anywhere in R0..R9999, D0..D3999 and M0..M1999.
fn random(n: usize) -> Result<Vec<Tag>> {
    let mut seed = 2;
    let one = |_| {
        Ok(match below(&mut seed, 10) {
            0..5 => Tag::from(Element::from(Register::r(below(&mut seed, 10_000)))),
            5..7 => Tag::new(Register::r(below(&mut seed, 10_000)), TagType::F32, 1)?,
            7..9 => Tag::from(Element::from(Register::d(below(&mut seed, 4000)))),
            _ => Tag::from(Element::from(Discrete::new(Symbol::M, below(&mut seed, 2000))?)),
        })
    };
    (0..n).map(one).collect()
}

/// Long ranges of each kind, and a few values far from them.
fn wide() -> Result<Vec<Tag>> {
    let texts = ["R0-R999", "D100-D399:f32", "M0-M799", "WX0-WX240", "X0-X99", "RT0-RT63", "R5000", "D9000:i32", "Y7"];
    texts.iter().map(|text| Ok(text.parse()?)).collect()
}

/// SplitMix64, so that the tables are the same each time.
fn below(seed: &mut u64, n: u16) -> u16 {
    *seed = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mut z = *seed;
    z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    u16::try_from((z ^ z >> 31) % u64::from(n)).unwrap_or(0)
}
