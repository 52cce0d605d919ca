//! A line per reading, with a column for each tag. No clock.
//!
//! A reading is a cycle of one PLC. Samples come in any order within a cycle, and those of one cycle
//! before those of the next.
//!
//! ```text
//! collecting ──the sample of its last tag──▶ complete: a line
//!     └──a sample of a later cycle (samples were missed): a line with what is there
//! ```
//!
//! Invariants: a line has samples of one cycle only; a cycle has at most one line.

use std::collections::HashMap;
use std::time::SystemTime;

use fatek::poll::{Quality, Sample, TagId};
use serde_json::Map;

use super::printer::{Line, Place};
use crate::output::Cell;

/// Lines with a column for each tag, and one with the quality of the whole reading.
#[derive(Debug)]
pub(super) struct Wide {
    /// The names of the PLCs, if there are several.
    plcs: Option<Vec<String>>,
    /// Width of their column in characters.
    plc_width: usize,
    /// The names of the tags. PLCs that have a tag of the same name share its column.
    tags: Vec<String>,
    /// The width of each column in characters. A longer text moves those after it.
    widths: Vec<usize>,
    /// PLC and column of each tag.
    places: HashMap<TagId, (usize, usize)>,
    readings: Vec<Reading>,
    on_change: bool,
}

/// The reading of a PLC that is being collected.
#[derive(Debug, Default)]
struct Reading {
    cycle: u64,
    /// A sample in each of its columns.
    samples: Vec<Option<Sample>>,
    /// Number of samples that are there.
    found: usize,
    /// Number of samples of a complete reading.
    tags: usize,
    is_printed: bool,
    /// The cells of its last line.
    last: Option<Vec<Cell>>,
}

const MIN_WIDTH: usize = 8;
const QUALITY: &str = "quality";

impl Wide {
    /// `on_change`: a line only if it differs from the last one of its PLC, without the time.
    pub(super) fn new(places: &HashMap<TagId, Place>, plcs: &[String], on_change: bool) -> Self {
        let mut ids: Vec<TagId> = places.keys().copied().collect();
        // The order in which they were added.
        ids.sort_unstable();
        let (mut tags, mut columns, mut at) = (Vec::new(), HashMap::new(), HashMap::new());
        let mut readings: Vec<Reading> = plcs.iter().map(|_| Reading::default()).collect();
        let mut used: Vec<Vec<bool>> = vec![Vec::new(); plcs.len()];
        let mut widths: Vec<usize> = Vec::new();
        for id in ids {
            let Some(Place { plc, label, bits }) = places.get(&id) else { continue };
            let (Some(reading), Some(used)) = (readings.get_mut(*plc), used.get_mut(*plc)) else { continue };
            let mut column = *columns.entry(label.clone()).or_insert_with(|| {
                tags.push(label.clone());
                tags.len() - 1
            });
            used.resize(tags.len(), false);
            if used.get(column) == Some(&true) {
                // The tag was given twice for this PLC.
                tags.push(label.clone());
                column = tags.len() - 1;
                used.resize(tags.len(), false);
            }
            if let Some(used) = used.get_mut(column) {
                *used = true;
            }
            widths.resize(tags.len(), MIN_WIDTH);
            if let Some(width) = widths.get_mut(column) {
                *width = label.chars().count().max(width_of(*bits)).max(*width);
            }
            reading.tags += 1;
            at.insert(id, (*plc, column));
        }
        readings.iter_mut().for_each(|reading| reading.samples.resize(tags.len(), None));
        let plc_width = plcs.iter().map(|plc| plc.chars().count()).max().unwrap_or(0).max(3);
        let plcs = (plcs.len() > 1).then(|| plcs.to_vec());
        Self { plcs, plc_width, tags, widths, places: at, readings, on_change }
    }

    pub(super) fn columns(&self) -> Vec<String> {
        let plc = self.plcs.iter().map(|_| "plc".to_owned());
        plc.chain(self.tags.iter().cloned()).chain([QUALITY.to_owned()]).collect()
    }

    pub(super) fn header(&self) -> String {
        let tags = self.tags.iter().zip(&self.widths).map(|(tag, width)| format!("{tag:>width$}"));
        let plc = self.plcs.iter().map(|_| format!("{:1$}", "PLC", self.plc_width));
        plc.chain(tags).chain(["QUALITY".to_owned()]).collect::<Vec<_>>().join("  ")
    }

    /// Takes a sample and returns the lines that are complete with it. `now`: the time of a line
    /// without a good value.
    pub(super) fn take(&mut self, sample: Sample, now: SystemTime) -> Vec<Line> {
        let Some(&(plc, column)) = self.places.get(&sample.id) else { return Vec::new() };
        let Some(reading) = self.readings.get_mut(plc) else { return Vec::new() };
        let mut lines = Vec::new();
        if sample.cycle > reading.cycle {
            if !reading.is_printed && reading.found > 0 {
                lines.extend(self.finish(plc, now));
            }
            let Some(reading) = self.readings.get_mut(plc) else { return lines };
            reading.cycle = sample.cycle;
            reading.is_printed = false;
            reading.samples.fill(None);
            reading.found = 0;
        }
        let Some(reading) = self.readings.get_mut(plc) else { return lines };
        // A sample that became stale or bad by its age belongs to a line that was printed.
        if sample.cycle < reading.cycle || reading.is_printed || sample.cycle == 0 {
            return lines;
        }
        if let Some(place) = reading.samples.get_mut(column) {
            reading.found += usize::from(place.is_none());
            *place = Some(sample);
        }
        if reading.found == reading.tags {
            lines.extend(self.finish(plc, now));
        }
        lines
    }

    /// The lines of the last readings, if samples of them were missed. `ended`: the number of readings of
    /// each PLC that have ended; one under way has no line.
    pub(super) fn finish_missed(&mut self, ended: &[u64], now: SystemTime) -> Vec<Line> {
        let is_missed =
            |(reading, ended): (&Reading, &u64)| !reading.is_printed && reading.found > 0 && reading.cycle <= *ended;
        let missed: Vec<bool> = self.readings.iter().zip(ended).map(is_missed).collect();
        let missed = missed.into_iter().enumerate().filter(|(_, is_missed)| *is_missed);
        missed.filter_map(|(plc, _)| self.finish(plc, now)).collect()
    }

    /// The line of the reading of a PLC; `None` if it is not to be printed.
    fn finish(&mut self, plc: usize, now: SystemTime) -> Option<Line> {
        let name = self.plcs.as_ref().and_then(|plcs| plcs.get(plc));
        let reading = self.readings.get_mut(plc)?;
        reading.is_printed = true;
        let values: Vec<Cell> = reading.samples.iter().map(value).collect();
        let quality = quality(&reading.samples);
        let cells: Vec<Cell> = values.iter().cloned().chain([quality.as_str().into()]).collect();
        if self.on_change && reading.last.as_ref() == Some(&cells) {
            return None;
        }
        reading.last = Some(cells.clone());
        let good = reading.samples.iter().flatten().filter(|sample| sample.is_good());
        let time = good.map(|sample| sample.at.time).min().unwrap_or(now);
        let shown = |(width, sample): (&usize, &Option<Sample>)| format!("{:>1$}", shown(sample), width);
        let shown = self.widths.iter().zip(&reading.samples).map(shown);
        let plc_cell = name.map(|name| format!("{name:0$}", self.plc_width));
        let table = plc_cell.into_iter().chain(shown).chain([quality.clone()]).collect::<Vec<_>>().join("  ");
        let mut json = Map::new();
        json.extend(name.map(|name| ("plc".to_owned(), name.as_str().into())));
        let own = reading.samples.iter().map(Option::is_some);
        let own = self.tags.iter().zip(&values).zip(own).filter(|(_, own)| *own);
        let values: Map<_, _> = own.map(|((tag, value), _)| (tag.clone(), value.json.clone())).collect();
        json.insert("values".to_owned(), values.into());
        json.insert(QUALITY.to_owned(), quality.into());
        let cells = name.map(|name| name.as_str().into()).into_iter().chain(cells).collect();
        Some(Line { table, time, cells, json })
    }
}

/// The characters of most values with this many bits.
fn width_of(bits: usize) -> usize {
    match bits {
        0..=16 => MIN_WIDTH,
        17..=32 => 11,
        33.. => 20,
    }
}

/// The value of a good sample; empty and `null` otherwise.
fn value(sample: &Option<Sample>) -> Cell {
    let good = sample.as_ref().filter(|sample| sample.is_good());
    Cell::from(good.and_then(Sample::value).cloned())
}

fn shown(sample: &Option<Sample>) -> String {
    match sample.as_ref().map(|sample| &sample.quality) {
        None => "-".to_owned(),
        Some(Quality::Stale(_)) => "(stale)".to_owned(),
        Some(Quality::Bad(_)) => "(bad)".to_owned(),
        // Good, and qualities of later versions.
        Some(_) => value(sample).text,
    }
}

/// `good`, or the first tag that is not, with its reason and the number of the others.
fn quality(samples: &[Option<Sample>]) -> String {
    let mut others = samples.iter().flatten().filter(|sample| !sample.is_good());
    let Some(first) = others.next() else { return "good".to_owned() };
    let more = match others.count() {
        0 => String::new(),
        more => format!(" (and {more} more)"),
    };
    format!("{}: {}{more}", first.name, first.quality)
}

#[cfg(test)]
mod tests {
    use super::*;

    // Samples cannot be made here: a poller makes them.
    #[test]
    fn a_tag_given_twice_has_two_columns_and_plcs_share_columns() {
        let mut poller = Columns::default();
        let plcs = ["mixer".to_owned(), "boiler".to_owned()];
        let places = poller.places(&[(0, "R0"), (0, "R0"), (0, "M5"), (1, "M5"), (1, "R0"), (1, "R7")]);
        let wide = Wide::new(&places, &plcs, false);
        assert_eq!(wide.columns(), ["plc", "R0", "R0", "M5", "R7", "quality"]);
        assert_eq!(wide.header(), "PLC           R0        R0        M5        R7  QUALITY");
        let columns: Vec<_> = poller.ids.iter().map(|id| wide.places[id]).collect();
        assert_eq!(columns, [(0, 0), (0, 1), (0, 2), (1, 2), (1, 0), (1, 3)]);
        assert_eq!(wide.readings.iter().map(|reading| reading.tags).collect::<Vec<_>>(), [3, 3]);
    }

    /// Ids of tags, from a poller.
    #[derive(Default)]
    struct Columns {
        ids: Vec<TagId>,
    }

    impl Columns {
        fn places(&mut self, tags: &[(usize, &str)]) -> HashMap<TagId, Place> {
            let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
            let _entered = runtime.enter();
            let poller = fatek::poll::Poller::new();
            let link = fatek::Link::builder("tcp://127.0.0.1:9".parse().unwrap()).build();
            let station = poller.station(&link.station(1).unwrap()).unwrap();
            let polled = tags.iter().map(|_| fatek::poll::PollTag::from("R0".parse::<fatek::tag::Tag>().unwrap()));
            let class = fatek::poll::ScanClass::every(std::time::Duration::from_secs(1));
            self.ids = station.add(class, polled).unwrap();
            let places = tags.iter().map(|&(plc, label)| Place { plc, label: label.to_owned(), bits: 16 });
            self.ids.iter().copied().zip(places).collect()
        }
    }
}
