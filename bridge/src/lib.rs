//! `fatek-bridge`: carries data of FATEK / FACON PLCs to MQTT, NATS, Prometheus and a web page.
//!
//! The program is this library with a command line. The library has no stable interface of its own: it exists
//! so that tests and benchmarks reach its parts.
//!
//! ```text
//! Pool + Poller ──samples──▶ Collector ──batches──▶ Buffer ──▶ cursor ──▶ Output (stdout, MQTT, NATS)
//!                                            │                              │ commands
//!                                            ▼                              ▼
//!                                      page, metrics                    Commands ──writes──▶ Pool
//! ```
//!
//! - [`config`]: the file, and its rules. [`check`]: plans, load and missing files. [`import`]: tables of tags.
//! - [`demo`]: simulated PLCs.
//! - [`registry`]: the PLCs that are polled, shared by all parts; a reload changes it.
//! - [`collect`] and [`batch`]: samples become batches of one PLC and one time.
//! - [`buffer`]: holds batches until each output has acknowledged them.
//! - [`output`]: one task an output. [`present`]: present values after an outage.
//! - [`command`]: commands of the outputs become writes to PLCs.
//! - [`fleet`]: several bridges share the PLCs.
//! - [`availability`]: the log of PLCs that do not answer.
//! - [`http`]: page, metrics, health and API; it reads only.
//! - [`run`]: starts all of this, and ends it.

pub mod availability;
pub mod backoff;
pub mod batch;
pub mod buffer;
pub mod check;
pub mod collect;
mod columns;
pub mod command;
pub mod config;
mod database;
pub mod demo;
mod file_limit;
pub mod fleet;
pub mod http;
pub mod import;
pub mod liveness;
pub mod output;
pub mod plc_state;
pub mod present;
#[path = "../../src/printable.rs"]
mod printable;
pub mod registry;
pub mod run;
pub mod secret;
pub mod tls;
pub mod topic;
