//! Benchmarks of the crate `fatek`: `cargo bench -p fatek-benches`.
