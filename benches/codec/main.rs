//! Time of the codecs for the largest reads, compared with a copy and a checksum of the same bytes.
//!
//! These are the figures of docs/PERFORMANCE.md.
//!
//! ```text
//! cargo bench -p fatek-benches --bench codec
//! FATEK_CODEC_CASE=ascii/64-registers-reply/decode FATEK_CODEC_TIMES=1000 cargo bench -p fatek-benches --bench codec
//! ```
//!
//! The second command repeats one case, for tools that count instructions.
//! `docs/performance/codec.py` runs both for all cases.

mod cases;
mod limit;

use std::time::Duration;

use criterion::{Criterion, Throughput};

use self::cases::Case;

fn main() {
    match std::env::var("FATEK_CODEC_CASE") {
        Ok(id) => repeat(&id),
        Err(_) => {
            let mut criterion = Criterion::default()
                .warm_up_time(Duration::from_millis(100))
                .measurement_time(Duration::from_millis(400))
                .sample_size(50)
                .nresamples(2000)
                .configure_from_args();
            measure(&mut criterion);
            criterion.final_summary();
        }
    }
}

fn measure(criterion: &mut Criterion) {
    for case in Case::all() {
        let mut group = criterion.benchmark_group(case.group());
        group.throughput(Throughput::Bytes(case.bytes()));
        let mut work = case.work();
        group.bench_function(case.job.name(), |b| b.iter(&mut work));
        group.finish();
    }
}

fn repeat(id: &str) {
    let case = Case::all().find(|case| format!("{}/{}", case.group(), case.job.name()) == id);
    let mut work = case.unwrap_or_else(|| panic!("unknown case {id}")).work();
    let times = std::env::var("FATEK_CODEC_TIMES").map_or(1000, |times| times.parse().expect("a number of times"));
    for _ in 0_u32..times {
        work();
    }
}
