//! The oracle beside the PLCs: it sees each request with the ownership of its sender.

use std::collections::BTreeMap;
use std::sync::Arc;

/// An ownership of a link: that of one process, from its take until its end.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Owner {
    pub(super) node: usize,
    /// Counts the starts of the node.
    pub(super) start: u32,
    pub(super) session: Arc<str>,
    pub(super) token: u64,
}

/// The requests that PLCs have had.
#[derive(Debug, Default)]
pub(super) struct Oracle {
    /// The owners of each link in the order of their first requests.
    owners: BTreeMap<Arc<str>, Vec<Owner>>,
    last_request: BTreeMap<Arc<str>, (u64, usize)>,
    pub(super) requests: u64,
}

impl Oracle {
    /// Notes a request. `last_take`: the revision of the last take of the link, while revisions only rise.
    ///
    /// # Errors
    /// The sender is not the owner any more.
    pub(super) fn request(
        &mut self,
        now: u64,
        link: &Arc<str>,
        owner: &Owner,
        last_take: Option<u64>,
    ) -> Result<(), String> {
        self.requests += 1;
        self.last_request.insert(link.clone(), (now, owner.node));
        let owners = self.owners.entry(link.clone()).or_default();
        if let Some(newer) = last_take.filter(|take| *take > owner.token) {
            return Err(format!("{link}: request of {owner:?} after it was taken as revision {newer}"));
        }
        match owners.iter().position(|known| known == owner) {
            Some(index) if index + 1 < owners.len() => {
                Err(format!("{link}: request of {owner:?} after one of {:?}", owners[index + 1]))
            }
            Some(_) => Ok(()),
            None => {
                let is_older = last_take.is_some() && owners.last().is_some_and(|last| last.token >= owner.token);
                let last = owners.last().cloned();
                owners.push(owner.clone());
                if is_older {
                    return Err(format!("{link}: token of {owner:?} does not rise from {last:?}"));
                }
                Ok(())
            }
        }
    }

    /// The time of the last request to a link, and the node that sent it.
    pub(super) fn last_request(&self, link: &str) -> Option<(u64, usize)> {
        self.last_request.get(link).copied()
    }

    /// The number of times that links got another owner.
    pub(super) fn handovers(&self) -> u64 {
        let counts = self.owners.values().map(|owners| owners.len().saturating_sub(1));
        u64::try_from(counts.sum::<usize>()).unwrap_or(u64::MAX)
    }
}
