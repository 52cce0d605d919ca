//! Output: a row per method and setting, on stdout and in a CSV file.

use std::fmt::Write as _;
use std::fs;

use crate::clients::{Bytes, Way};
use crate::{Result, Setting};

/// Result of one method in one setting.
pub(crate) struct Row {
    runtime: &'static str,
    setting: Setting,
    way: Way,
    /// Requests per second, median of all rounds.
    rate: f64,
    limit: Option<Ratio>,
    peer: Option<Ratio>,
    timed: Option<Ratio>,
}

/// Quartiles of the ratios of two rates of the same round.
#[derive(Clone, Copy)]
struct Ratio {
    low: f64,
    median: f64,
    high: f64,
}

pub(crate) struct Table {
    rows: Vec<Row>,
}

pub(crate) fn rows(runtime: &'static str, setting: Setting, rates: &[(Way, Vec<f64>)]) -> Vec<Row> {
    let of = |way: Way| rates.iter().find(|(other, _)| *other == way).map(|(_, rates)| rates);
    let row = |(way, own): &(Way, Vec<f64>)| {
        let limit = match way {
            Way::Fatek(bytes) | Way::Into(bytes) | Way::Task(bytes) => of(Way::Bare(*bytes)),
            Way::Single => of(Way::Bare(Bytes::Binary)),
            Way::Modbus | Way::Timed | Way::Bare(_) => None,
        };
        let ours = matches!(way, Way::Fatek(_) | Way::Into(_) | Way::Single);
        let peer = if ours || *way == Way::Timed { of(Way::Modbus) } else { None };
        let timed = if ours { of(Way::Timed) } else { None };
        Row {
            runtime,
            setting,
            way: *way,
            rate: quantile(own.clone(), 0.5),
            limit: limit.map(|limit| ratio(own, limit)),
            peer: peer.map(|peer| ratio(own, peer)),
            timed: timed.map(|timed| ratio(own, timed)),
        }
    };
    rates.iter().map(row).collect()
}

fn ratio(own: &[f64], other: &[f64]) -> Ratio {
    let ratios: Vec<f64> = own.iter().zip(other).map(|(own, other)| own / other).collect();
    let at = |share| quantile(ratios.clone(), share);
    Ratio { low: at(0.25), median: at(0.5), high: at(0.75) }
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    let at = (values.len().saturating_sub(1) as f64 * share).round() as usize;
    values.get(at).copied().unwrap_or(f64::NAN)
}

impl Table {
    pub(crate) fn new() -> Self {
        Self { rows: Vec::new() }
    }

    pub(crate) fn head(&self) {
        println!(
            "{:<15} {:>5} {:>7}  {:<13} {:>10}  {:<22} {:<22} {:<22}",
            "runtime", "links", "callers", "way", "requests/s", "of the limit", "of the peer", "of the timed peer"
        );
    }

    pub(crate) fn add(&mut self, row: Row) {
        let Setting { links, callers } = row.setting;
        println!(
            "{:<15} {:>5} {:>7}  {:<13} {:>10.0}  {:<22} {:<22} {:<22}",
            row.runtime,
            links,
            callers,
            row.way.name(),
            row.rate,
            row.limit.map_or(String::new(), Ratio::text),
            row.peer.map_or(String::new(), Ratio::text),
            row.timed.map_or(String::new(), Ratio::text),
        );
        self.rows.push(row);
    }

    /// Writes docs/performance/call.csv.
    pub(crate) fn save(&self) -> Result<()> {
        let mut text = String::from(
            "runtime,links,callers,way,requests_per_s,\
             limit_low,limit_median,limit_high,peer_low,peer_median,peer_high,timed_low,timed_median,timed_high\n",
        );
        for Row { runtime, setting: Setting { links, callers }, way, rate, limit, peer, timed } in &self.rows {
            let name = way.name();
            let [limit, peer, timed] = [limit, peer, timed].map(|of| of.map_or(",,".to_owned(), Ratio::csv));
            writeln!(text, "{runtime},{links},{callers},{name},{rate:.0},{limit},{peer},{timed}")?;
        }
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/performance/call.csv");
        fs::create_dir_all(concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/performance"))?;
        fs::write(path, text)?;
        println!("written to {path}");
        Ok(())
    }
}

impl Ratio {
    fn text(self) -> String {
        format!("{:.3} ({:.3} to {:.3})", self.median, self.low, self.high)
    }

    fn csv(self) -> String {
        format!("{:.4},{:.4},{:.4}", self.low, self.median, self.high)
    }
}
