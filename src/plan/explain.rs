use std::fmt;
use std::time::Duration;

use super::Plan;

/// A plan displayed as a table: see [`Plan::explain`].
#[derive(Clone, Copy, Debug)]
pub struct Explanation<'p> {
    pub(super) plan: &'p Plan,
}

impl fmt::Display for Explanation<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let milliseconds = |time: Duration| format!("{:.3}", time.as_secs_f64() * 1e3);
        let plan = self.plan;
        writeln!(f, "{:>7}  {:>6}  {:>6}  {:>10}  reads", "request", "values", "bytes", "ms")?;
        for (n, planned) in plan.requests.iter().enumerate() {
            let (values, bytes, time) = (planned.values, planned.bytes(), milliseconds(planned.time));
            writeln!(f, "{:>7}  {values:>6}  {bytes:>6}  {time:>10}  {}", n + 1, planned.request)?;
        }
        if !plan.proof_time.is_zero() {
            let (empty, time) = ("", milliseconds(plan.proof_time));
            writeln!(f, "{:>7}  {empty:>6}  {empty:>6}  {time:>10}  checks by the link", "proofs")?;
        }
        let (values, bytes, time) = (plan.slots.len(), plan.bytes(), milliseconds(plan.time()));
        let requests = match plan.requests.len() {
            1 => "1 request".to_owned(),
            count => format!("{count} requests"),
        };
        write!(f, "{:>7}  {values:>6}  {bytes:>6}  {time:>10}  {}", "total", requests)
    }
}
