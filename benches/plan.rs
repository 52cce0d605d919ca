//! Time to build plans, for docs/PLAN.md.
//!
//! ```text
//! cargo bench -p fatek-benches --bench plan
//! ```

#[path = "../examples/plan_table/tags.rs"]
mod tags;

use std::time::Duration;

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use fatek::endpoint::SerialSettings;
use fatek::plan::{CostModel, Limits, Plan};
use fatek::tag::{Tag, TagType};
use fatek::wire::Framing;

fn planning(c: &mut Criterion) {
    let cost = CostModel::serial(SerialSettings::new(Framing::Ascii), Framing::Ascii);
    let all = Limits::new();
    let cases = [
        ("clustered", clustered as Tags, all.clone()),
        ("random", random, all.clone()),
        ("random, with texts", texts, all.clone()),
        ("random, no mixed reads", random, all.mixed_reads(false)),
    ];
    for (name, tags, limits) in cases {
        let mut group = c.benchmark_group(name);
        for n in [1000, 10_000, 100_000] {
            let builder = Plan::builder(cost).limits(limits.clone()).tags(tags(n));
            group.throughput(Throughput::Elements(n as u64));
            group.sample_size(20);
            group.bench_function(BenchmarkId::from_parameter(n), |b| {
                b.iter_batched(|| builder.clone(), |builder| builder.build().expect("a plan"), BatchSize::LargeInput);
            });
        }
        group.finish();
    }
}

/// Plans of thousands of one-scan groups: three random tags in each.
fn planning_groups(c: &mut Criterion) {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let mut group = c.benchmark_group("one-scan groups");
    for n in [1000_usize, 4000, 16_000] {
        let groups = tags::random(3 * n, 65_535, 65_535, 10_000).expect("good tags");
        let builder =
            groups.chunks(3).fold(Plan::builder(network), |builder, tags| builder.one_scan(tags.iter().copied()));
        group.throughput(Throughput::Elements(n as u64));
        group.sample_size(20);
        group.bench_function(BenchmarkId::from_parameter(n), |b| {
            b.iter_batched(|| builder.clone(), |builder| builder.build().expect("a plan"), BatchSize::LargeInput);
        });
    }
    group.finish();
}

/// Returns this number of tags.
type Tags = fn(usize) -> Vec<Tag>;

fn clustered(n: usize) -> Vec<Tag> {
    tags::clustered(n).expect("good tags")
}

fn random(n: usize) -> Vec<Tag> {
    tags::random(n, 65_535, 65_535, 10_000).expect("good tags")
}

/// Random tags, one in ten replaced by a text of up to 32 registers.
fn texts(n: usize) -> Vec<Tag> {
    let text = |(n, tag): (usize, Tag)| {
        let spanning = Tag::spanning(tag.first(), TagType::Text, n % 32 + 1);
        if n % 10 == 0 { spanning.unwrap_or(tag) } else { tag }
    };
    random(n).into_iter().enumerate().map(text).collect()
}

/// A plan of eight longest requests of one length: the comparison of all ways to join them for fewer proofs.
fn planning_longest_requests(c: &mut Criterion) {
    let network = CostModel::network(Framing::Ascii, Duration::from_millis(5));
    let cases = [
        ("registers", "R0-R511", Limits::new().mixed_reads(false)),
        ("discretes", "M0-M2047", Limits::new().mixed_reads(false).words_of_discretes(false)),
        ("words of discretes", "M0-M8191", Limits::new()),
    ];
    let mut group = c.benchmark_group("eight longest requests");
    for (name, tag, limits) in cases {
        let builder = Plan::builder(network).limits(limits).tag(tag.parse::<Tag>().expect("a tag"));
        group.sample_size(20);
        group.bench_function(name, |b| {
            b.iter_batched(|| builder.clone(), |builder| builder.build().expect("a plan"), BatchSize::LargeInput);
        });
    }
    group.finish();
}

criterion_group!(benches, planning, planning_groups, planning_longest_requests);
criterion_main!(benches);
