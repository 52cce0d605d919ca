//! The core, action by action: what it sends when, and what each received frame leads to.

mod bus_time;
mod calls;
mod checks;
mod echoes;
mod gate;
mod refusals;
mod seen;
mod stations;
mod test_link;
