//! The processes of the campaign, and which of them is at the other end of a connection.

use std::collections::{BTreeMap, HashMap};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// A process that ended so shortly before may have been at the other end of a connection that none has.
const SHORTLY: Duration = Duration::from_secs(2);

/// All processes. Cheap to clone.
#[derive(Clone, Debug, Default)]
pub(crate) struct Processes(Arc<Mutex<Vec<Process>>>);

#[derive(Clone, Debug)]
struct Process {
    /// 0: it is not started yet.
    pid: u32,
    ended: Option<Instant>,
}

impl Processes {
    /// A number for a process that is to be started.
    pub(crate) fn add(&self) -> usize {
        let mut processes = self.0.lock().unwrap();
        processes.push(Process { pid: 0, ended: None });
        processes.len() - 1
    }

    pub(crate) fn started(&self, number: usize, pid: u32) {
        self.0.lock().unwrap()[number].pid = pid;
    }

    /// Notes that a process is about to be killed, or has ended.
    pub(crate) fn ended(&self, number: usize) {
        self.0.lock().unwrap()[number].ended.get_or_insert_with(Instant::now);
    }

    /// The processes of connections, which are keyed by the ports of both ends.
    pub(crate) fn find(&self, ports: &BTreeMap<(u16, u16), usize>) -> Vec<(usize, usize)> {
        let table = std::fs::read_to_string("/proc/net/tcp").unwrap();
        let inodes: HashMap<String, usize> = table.lines().skip(1).filter_map(|line| socket(line, ports)).collect();
        let mut found = Vec::new();
        for (number, process) in self.0.lock().unwrap().iter().enumerate() {
            if process.pid == 0 || process.ended.is_some_and(|ended| ended.elapsed() > SHORTLY) {
                continue;
            }
            let Ok(files) = std::fs::read_dir(format!("/proc/{}/fd", process.pid)) else { continue };
            for file in files.flatten() {
                let Ok(target) = std::fs::read_link(file.path()) else { continue };
                let Some(target) = target.to_str() else { continue };
                let inode = target.strip_prefix("socket:[").and_then(|inode| inode.strip_suffix(']'));
                if let Some(connection) = inode.and_then(|inode| inodes.get(inode)) {
                    found.push((*connection, number));
                }
            }
        }
        found
    }

    /// The only process that ended shortly before or after a time.
    pub(crate) fn ended_at(&self, time: Instant) -> Option<usize> {
        let processes = self.0.lock().unwrap();
        let is_near = |ended: Instant| ended < time + SHORTLY && time < ended + SHORTLY;
        let mut near = processes.iter().enumerate().filter(|(_, process)| process.ended.is_some_and(is_near));
        let first = near.next()?.0;
        near.next().is_none().then_some(first)
    }
}

/// The inode and the connection of a line of the table, if it is one of those.
fn socket(line: &str, ports: &BTreeMap<(u16, u16), usize>) -> Option<(String, usize)> {
    let fields: Vec<&str> = line.split_ascii_whitespace().collect();
    let port = |field: &str| u16::from_str_radix(field.rsplit(':').next()?, 16).ok();
    let connection = ports.get(&(port(fields.get(1)?)?, port(fields.get(2)?)?))?;
    Some(((*fields.get(9)?).to_owned(), *connection))
}
