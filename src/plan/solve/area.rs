//! Chooses runs or mixed reads for the values of one area.

use std::collections::VecDeque;

use super::super::cost::CostModel;
use super::super::layout::{Cells, Draft, ItemCost};
use super::super::limits::Limits;
use super::Outcome;

/// How the last of the values considered so far is read.
#[derive(Clone, Copy)]
enum ReadMode {
    /// At the end of a run that begins with the value `from`.
    Run { from: usize },
    /// In a mixed read, behind values with this tail.
    Mixed { before: Tail },
}

/// The end of the values considered so far: a run, or a stretch of cells of even or odd length in a
/// mixed read.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Tail {
    Run,
    Even,
    Odd,
}

/// Finds the cheapest way to read the values of one area: appends runs to `shares`, and the values
/// for mixed reads to `left`. Returns its cost with `unit_price`.
///
/// `unit_price` is the price of a unit of a mixed read without bytes; `None`: no mixed reads.
///
/// Values are sorted and none contains another. In an optimum the values of a run are consecutive:
/// where two runs overlap, one of them can read all common values. `costs[i]` is the cost of the
/// first `i` values for each tail. A monotonic queue has the best start of a run, because the cost
/// of a run is linear in its length: O(n).
pub(super) fn solve_area(
    values: &[(usize, Cells)],
    unit_price: Option<u64>,
    limits: &Limits,
    cost: &CostModel,
    shares: &mut Outcome,
    left: &mut Vec<(usize, Cells)>,
) -> u64 {
    let Some((_, first)) = values.first() else { return 0 };
    let area = first.area;
    let max_run = area.max_run(limits);
    let (run_fixed, per_cell) = {
        let one = Draft::Run(Cells { len: 1, ..*first }).cost(cost);
        let cell = cost.bytes_cost(cost.value_bytes(area.width()));
        (one - cell, cell)
    };
    let item = ItemCost::new(area, cost);
    let cell_price = unit_price.map(|price| price.saturating_mul(u64::from(area.units())));

    const INFINITE: u64 = u64::MAX / 4;
    // Indexed by `Tail`.
    let mut costs = vec![[0, INFINITE, INFINITE]];
    let mut modes: Vec<[ReadMode; 3]> = Vec::with_capacity(values.len());
    let mut run_starts: VecDeque<(u64, usize)> = VecDeque::new();
    let distance = |cell: u32| u64::from(cell - first.first) * per_cell;
    // Added to keep the keys positive: cells before the start of a run are not read.
    let all = distance(values.last().map_or(first.first, |(_, last)| last.first));

    for (i, (_, value)) in values.iter().enumerate() {
        let before = costs[i];
        let cheapest = before.into_iter().min().unwrap_or(INFINITE);
        let key = cheapest + (all - distance(value.first));
        if i > 0 && !limits.has_no_ranges() && values[i - 1].1.must_split_from(*value, limits) {
            run_starts.clear();
        }
        while run_starts.back().is_some_and(|(worse, _)| *worse >= key) {
            run_starts.pop_back();
        }
        run_starts.push_back((key, i));
        while run_starts.front().is_some_and(|(_, from)| value.end() - values[*from].1.first > max_run) {
            run_starts.pop_front();
        }
        let (run, from) = match run_starts.front() {
            Some((key, from)) => (*key + run_fixed + distance(value.end()) - all, *from),
            None => (INFINITE, i),
        };
        let mut here = [run, INFINITE, INFINITE];
        let mut mode = [ReadMode::Run { from }; 3];
        let fits = value.len * area.units() <= limits.mixed_units();
        if let Some(cell_price) = cell_price.filter(|_| fits) {
            let neighbour = i > 0 && value.first <= values[i - 1].1.end();
            for tail in [Tail::Run, Tail::Even, Tail::Odd] {
                let continues = neighbour && tail != Tail::Run;
                let new = if continues { value.end() - values[i - 1].1.end() } else { value.len };
                let odd = continues && tail == Tail::Odd;
                let price = before[tail as usize] + item.cost(new, odd) + cell_price * u64::from(new);
                let now = if (new % 2 == 1) == odd { 1 } else { 2 };
                if price < here[now] {
                    here[now] = price;
                    mode[now] = ReadMode::Mixed { before: tail };
                }
            }
        }
        costs.push(here);
        modes.push(mode);
    }

    // Traces the decisions back from the last value.
    let mut at = values.len();
    let cheapest = |costs: &[u64; 3]| (0..3).min_by_key(|n| costs[*n]).unwrap_or(0);
    let mut tail = cheapest(&costs[at]);
    let least = costs[at][tail];
    let mut mixed = Vec::new();
    while at > 0 {
        match modes[at - 1][tail] {
            ReadMode::Run { from } => {
                let (start, end) = (values[from].1, values[at - 1].1);
                let run = Cells { len: end.end() - start.first, ..start };
                shares.push((Draft::Run(run), values[from..at].iter().map(|(n, _)| *n).collect()));
                at = from;
                tail = cheapest(&costs[at]);
            }
            ReadMode::Mixed { before } => {
                at -= 1;
                mixed.push(values[at]);
                tail = before as usize;
            }
        }
    }
    left.extend(mixed.into_iter().rev());
    least
}
