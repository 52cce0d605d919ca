//! Faults of a fleet of real processes with a real nats-server: no PLC gets a request of a former owner.
//!
//! Three to five processes of the bridge share ten PLCs, with a lease of 500 ms. Each has a proxy of its own on the
//! way to NATS. Faults come alone and several at once, at random times and just about renewals, deadlines, takes and
//! releases. An oracle beside the PLCs knows which process has sent each request, and by which token. After each
//! round of faults all links are polled again, and each member has its share.
//!
//! | variable | content |
//! |---|---|
//! | `FATEK_FLEET_FAULTS` | the number of faults: 1000 in a campaign, 12 otherwise |
//! | `FATEK_FLEET_SEED` | the seed of the first round, which is printed for each: the same faults come again |
//! | `FATEK_FLEET_NAIVE` | one naive variant of the feature `naive-fleet`: `gate`, `fence` or `ttl`; else all |
//! | `FATEK_NATS_SERVER` | the path of another nats-server than that of the system |
//!
//! ```text
//! FATEK_FLEET_FAULTS=1000 cargo test --release --test fleet_faults campaign -- --nocapture
//! FATEK_FLEET_FAULTS=300 cargo test --release --features naive-fleet --test fleet_faults naive -- --nocapture
//! ```

#[path = "../common/mod.rs"]
mod common;

mod campaign;
mod fleet;
mod frames;
mod harness;
mod inject;
mod member;
mod oracle;
mod plan;
mod plcs;
mod processes;
mod proxy;
mod recorder;
mod store;
#[cfg(feature = "naive-fleet")]
mod ttl;
mod view;

use campaign::Settings;

/// The first seed of the smoke version: its few rounds have all kinds of faults but a deletion of the store.
const SMOKE: u64 = 5378;

fn number(name: &str) -> Option<u64> {
    std::env::var(name).ok().map(|value| value.parse().unwrap_or_else(|_| panic!("{name} is a number")))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_campaign_of_faults_has_no_request_of_a_former_owner() {
    let faults = number("FATEK_FLEET_FAULTS");
    let seed = number("FATEK_FLEET_SEED").unwrap_or(if faults.is_some() { 1 } else { SMOKE });
    let faults = usize::try_from(faults.unwrap_or(12)).unwrap();
    let settings = Settings { seed, faults, naive: None };
    let Some(outcome) = campaign::run(&settings).await else { return };
    println!("{}", outcome.table());
    assert_eq!(outcome.judged.wrong(), 0, "{:#?}", outcome.judged.faults);
    assert!(outcome.problems.is_empty(), "{:#?}", outcome.problems);
    // Else this test shows nothing.
    assert!(outcome.judged.requests > 20 * faults as u64 && outcome.judged.used > 10, "{:?}", outcome.judged);
}

/// Each naive variant is seen to fail the same rounds.
#[cfg(feature = "naive-fleet")]
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn naive_variants_have_requests_of_former_owners() {
    let faults = usize::try_from(number("FATEK_FLEET_FAULTS").unwrap_or(300)).unwrap();
    let only = std::env::var("FATEK_FLEET_NAIVE").ok();
    // Without a fence, two masters need a process that is stopped for little more than a lease, and late entries.
    for (naive, seed) in [("gate", 1), ("fence", 2519), ("ttl", 1)] {
        if only.as_ref().is_some_and(|only| only != naive) {
            continue;
        }
        let seed = number("FATEK_FLEET_SEED").unwrap_or(seed);
        let settings = Settings { seed, faults, naive: Some(naive) };
        let Some(outcome) = campaign::run(&settings).await else { return };
        println!("{naive}: {}", outcome.table());
        println!("{:#?}", outcome.judged.faults);
        assert!(outcome.judged.stale + outcome.judged.late > 0, "{naive} was not caught");
    }
}
