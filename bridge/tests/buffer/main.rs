//! Tests of the buffer on disk, with real files and real processes.
//!
//! Long campaigns, from `bridge/`:
//!
//! ```text
//! FATEK_BUFFER_KILLS=50 FATEK_BUFFER_STRICT=1 cargo test --release --test buffer kill -- --nocapture
//! FATEK_BUFFER_FLIPS=5000 cargo test --release --test buffer damage -- --nocapture
//! FATEK_BUFFER_SEEDS=5000 cargo test --release --lib buffer::model -- --nocapture
//! FATEK_BUFFER_MIB=1024 cargo test --release --test buffer figures -- --ignored --nocapture --test-threads 1
//! ```

mod common;
mod damage;
mod figures;
mod full;
mod growth;
mod kill;
mod restart;
