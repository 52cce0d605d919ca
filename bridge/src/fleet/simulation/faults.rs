//! Faults, and the moments at which they strike.

use super::super::core::Input;
use super::super::keys::{DRAIN, Key};
use super::world::{Event, World, id_of};
use super::{LEASE, Variant};

/// A fault, or an act of an operator.
#[derive(Clone, Debug)]
pub(super) enum Fault {
    /// A process is killed, and starts again later.
    Kill { node: usize, again: u64 },
    /// A process is stopped for a time, and then goes on.
    Stop { node: usize, time: u64 },
    /// A node is cut off from the server.
    Cut { node: usize, time: u64 },
    /// Messages to a node are slow for a time, and then it is cut off.
    Slow { node: usize, time: u64, cut: u64 },
    /// The server is killed, and starts again, with its data or older ones.
    Server { time: u64, is_set_back: bool },
    /// The store is deleted, and made again later.
    Delete { again: u64 },
    /// A process is told to leave.
    Leave { node: usize },
    /// A process that has ended is replaced by a new one.
    Replace { node: usize, start: u32 },
    /// A link is moved to a node by hand, or back to its placement.
    Override { link: usize, node: Option<usize> },
    /// A member is drained, or not any more.
    Drain { node: usize, is_on: bool },
}

impl World {
    /// Plans the faults that strike at random times. Others strike at moments.
    pub(super) fn plan_faults(&mut self) {
        for _ in 0..self.faults_left / 2 {
            let fault = self.draw(None);
            let at = self.rng.u64(..self.heal_at);
            self.at(at, Event::Fault(fault));
        }
        self.faults_left -= self.faults_left / 2;
    }

    /// A moment that matters for a node: a fault may strike around it.
    pub(super) fn moment(&mut self, node: usize, ahead: u64) {
        let is_over = self.is_healed || self.now + ahead >= self.heal_at;
        if is_over || self.faults_left == 0 || self.rng.u16(..250) > 0 {
            return;
        }
        self.faults_left -= 1;
        let fault = self.draw(Some(node));
        let early = self.rng.u64(..LEASE / 50).min(ahead);
        let late = if self.rng.bool() { self.rng.u64(..LEASE / 50) } else { 0 };
        self.after(ahead - early + late, Event::Fault(fault));
    }

    fn draw(&mut self, node: Option<usize>) -> Fault {
        let node = node.unwrap_or_else(|| self.rng.usize(..self.nodes.len()));
        let time = self.rng.u64(1..LEASE * 4);
        let again = self.rng.u64(LEASE / 20..LEASE * 6);
        match self.rng.u8(..100) {
            0..=17 => Fault::Kill { node, again },
            18..=44 => Fault::Stop { node, time },
            45..=56 => Fault::Cut { node, time },
            57..=62 => Fault::Slow { node, time: time / 2, cut: again },
            63..=74 => Fault::Server { time: time / 2, is_set_back: false },
            75..=80 => Fault::Server { time: if self.rng.bool() { 1 } else { time / 2 }, is_set_back: true },
            81..=83 => Fault::Delete { again: if self.rng.bool() { 1 } else { again } },
            84..=91 => Fault::Leave { node },
            92..=96 => Fault::Override { link: self.rng.usize(..6), node: self.rng.bool().then_some(node) },
            97.. => Fault::Drain { node, is_on: self.rng.u8(..3) > 0 },
        }
    }

    pub(super) fn strike(&mut self, fault: Fault) {
        if let Fault::Replace { node, start } = fault {
            if self.process(node, start).is_some() {
                self.end_process(node);
                self.after(1, Event::Start { node });
            }
            return;
        }
        if self.is_healed {
            return;
        }
        self.note(|| format!("fault: {fault:?}"));
        self.figures.faults += 1;
        match fault {
            Fault::Kill { node, again } => {
                self.end_process(node);
                self.after(again, Event::Start { node });
            }
            Fault::Stop { node, time } => {
                if self.nodes[node].process.is_some() && !self.nodes[node].is_stopped {
                    self.nodes[node].is_stopped = true;
                    self.after(time, Event::Resume { node });
                }
            }
            Fault::Cut { node, time } => self.cut(node, time),
            Fault::Slow { node, time, cut } => {
                self.nodes[node].slow_until = self.now + time;
                self.after(time, Event::Fault(Fault::Cut { node, time: cut }));
            }
            Fault::Server { time, is_set_back } => {
                if self.store.is_up {
                    self.store.is_up = false;
                    self.store.life += 1;
                    // Most notice it at once.
                    let within = if self.rng.u8(..4) == 0 { LEASE * 2 } else { LEASE / 20 };
                    self.drop_connections(within);
                    let step = if self.rng.bool() { self.rng.u64(..LEASE * 2) } else { 0 };
                    self.after(time, Event::ServerUp { is_set_back, step });
                    if is_set_back && self.rng.bool() {
                        // A process that knows no older state.
                        let node = self.rng.usize(..self.nodes.len());
                        self.end_process(node);
                        let delay = self.rng.u64(1..LEASE / 4);
                        self.after(time + delay, Event::Start { node });
                    }
                }
            }
            Fault::Delete { again } => {
                if self.store.is_up && self.store.created.is_some() {
                    self.deleted = self.store.created.unwrap_or(1);
                    self.store.delete();
                    self.drop_connections(LEASE * 2);
                    self.after(again, Event::MakeStore);
                }
            }
            Fault::Leave { node } => {
                let start = self.nodes[node].starts;
                let is_stopped = self.nodes[node].is_stopped;
                let process = self.process(node, start).filter(|process| !process.has_failed && !is_stopped);
                if let Some(process) = process {
                    process.is_leaving = true;
                    self.feed(node, start, Input::Leave);
                    // The service manager kills it after a while.
                    self.after(LEASE * 4, Event::Fault(Fault::Replace { node, start }));
                }
            }
            Fault::Override { link, node } => {
                let value = node.map(id_of).unwrap_or_default();
                self.order(&Key::Override(&format!("plc{link}")).text(), value);
            }
            Fault::Drain { node, is_on } => {
                let value = if is_on { DRAIN } else { "" };
                self.order(&Key::Drain(&id_of(node)).text(), value.to_owned());
            }
            Fault::Replace { .. } => {}
        }
    }

    /// An operator stores a value.
    fn order(&mut self, key: &str, value: String) {
        if self.store.is_up && self.store.created.is_some() {
            let change = self.store.put(key, Some(value), self.wall());
            self.publish(&change);
        }
    }

    fn cut(&mut self, node: usize, time: u64) {
        if self.nodes[node].is_cut {
            return;
        }
        self.nodes[node].is_cut = true;
        self.after(time, Event::EndCut { node });
        // A client notices a long cut by its pings.
        let patience = self.rng.u64(LEASE / 2..LEASE * 3);
        if let Some(connection) = self.nodes[node].connection.filter(|_| time > patience) {
            let start = self.nodes[node].starts;
            let lost = super::network::Message::Lost { node, start, connection };
            self.after(patience, Event::Network(lost));
        }
    }

    pub(super) fn server_up(&mut self, is_set_back: bool, step: u64) {
        if self.store.is_up {
            return;
        }
        self.store.is_up = true;
        self.wall_step += step;
        if is_set_back {
            let mut rng = self.rng.fork();
            self.store.set_back(&mut rng);
        }
        self.note(|| format!("server is up, set back: {is_set_back}"));
    }

    /// An operator makes a new store.
    pub(super) fn make_store(&mut self) {
        if self.store.created.is_none() {
            self.store.created = Some(self.deleted + 1);
            self.note(|| "the store is made again".to_owned());
        }
    }

    /// The server expires sessions, in the variant in which it does.
    pub(super) fn expire(&mut self) {
        if self.variant == Variant::ServerTtl && self.store.is_up && self.store.created.is_some() {
            let wall = self.wall();
            for change in self.store.expire(wall, LEASE) {
                self.publish(&change);
            }
        }
        self.after(LEASE / 2, Event::Expire);
    }
}
