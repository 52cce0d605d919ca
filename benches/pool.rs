//! The cost of a station of a pool that is full: of an endpoint that it has, and of one for which it evicts another.
//!
//! ```sh
//! cargo bench -p fatek-benches --bench pool
//! ```

use std::hint::black_box;

use criterion::{Criterion, criterion_group, criterion_main};
use fatek::Pool;
use fatek::endpoint::Endpoint;

const ENDPOINTS: usize = 20_000;

fn endpoint(number: usize) -> Endpoint {
    let [_, .., a, b, c] = number.to_be_bytes();
    Endpoint::tcp(format!("10.{a}.{b}.{c}"), 500)
}

fn pool(c: &mut Criterion) {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().expect("a runtime");
    let _guard = runtime.enter();
    let pool = Pool::builder().max_endpoints(ENDPOINTS).build();
    for number in 0..ENDPOINTS {
        pool.station(endpoint(number), 1).expect("a station");
    }
    let known = endpoint(ENDPOINTS / 2);
    c.bench_function("pool/known", |bench| bench.iter(|| black_box(pool.station(known.clone(), 1))));
    let mut next = ENDPOINTS;
    c.bench_function("pool/evict", |bench| {
        bench.iter(|| {
            next += 1;
            black_box(pool.station(endpoint(next), 1))
        });
    });
    assert!(pool.stats().evicted > 0, "the pool is full");
}

criterion_group!(benches, pool);
criterion_main!(benches);
