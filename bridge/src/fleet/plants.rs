//! The plant of a fleet in the store: a bucket of its own, beside that of the leases.
//!
//! | key | value |
//! |---|---|
//! | `plant` | the sections of the plant, TOML; its revision is the version; empty: there is none |
//! | `r.<member>` | a [`Refusal`]: the last version that a member has refused, and why |

use std::collections::BTreeMap;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::time::Instant;

use super::bucket::{self, Bucket, Content, Entry, InitError, Initialized, OpenError, Opened, Seen, Watch};
use super::core::{Operation, Outcome};
use super::operator::{OrderError, PATIENCE, no_answer};
use crate::config::{Name, NatsSection, StoredPlant};

/// The ending of the name of the bucket.
const ENDING: &str = "_config";
const PLANT: &str = "plant";
const REFUSAL: &str = "r.";
/// The time between two reads of the plant besides the watch.
const REREAD: Duration = Duration::from_secs(5);
/// The characters of a reason that are stored.
const REASON: usize = 2000;

/// The version that a member has refused.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize, Serialize)]
pub struct Refusal {
    /// The version.
    pub version: u64,
    /// The faults.
    pub why: String,
}

/// The plant in the store, over one connection, with its changes.
pub struct PlantStore {
    bucket: Bucket,
    watch: Watch,
    current: Option<StoredPlant>,
    /// The revision of the key, also without a plant; 0: it has never had a value.
    revision: u64,
    refusals: BTreeMap<String, Refusal>,
    /// The plant is read again then.
    reread_at: Instant,
}

impl std::fmt::Debug for PlantStore {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PlantStore").field("revision", &self.revision).finish_non_exhaustive()
    }
}

/// A plant that was not stored, or a store that cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum PlantStoreError {
    /// There is no such store.
    #[error("{0}")]
    Missing(String),
    /// Another version was stored meanwhile.
    #[error("another version was stored meanwhile: look at it before you try again")]
    Changed,
    /// The server takes no message of this size.
    #[error(
        "the plant has {size} bytes, and the server takes {limit}: raise max_payload of nats-server, and use templates"
    )]
    TooLarge {
        /// The size of the plant.
        size: usize,
        /// The limit of the server.
        limit: usize,
    },
    /// The server does not answer, or with an error.
    #[error("{0}")]
    Other(String),
}

impl From<OpenError> for PlantStoreError {
    fn from(error: OpenError) -> Self {
        let text = error.to_string();
        match error {
            OpenError::Missing(_) => Self::Missing(text),
            OpenError::NoAnswer | OpenError::Other(_) => Self::Other(text),
        }
    }
}

impl From<OrderError> for PlantStoreError {
    fn from(OrderError(error): OrderError) -> Self {
        Self::Other(error)
    }
}

/// Makes the store of the plant. `bucket`: that of the leases.
///
/// # Errors
/// [`InitError`] with the error of the server.
pub async fn init_plants(nats: &NatsSection, id: &Name, bucket: &Name) -> Result<Initialized, InitError> {
    bucket::make(nats, id, &bucket.with_ending(ENDING), Content::Plants).await
}

impl PlantStore {
    /// Opens the store, and reads it. `bucket`: that of the leases.
    ///
    /// # Errors
    /// [`PlantStoreError`] if there is none, or if it does not answer.
    pub async fn open(nats: &NatsSection, id: &Name, bucket: &Name) -> Result<Self, PlantStoreError> {
        let Opened { bucket, watch, .. } = bucket::open(nats, id, &bucket.with_ending(ENDING), bucket::OPEN).await?;
        let mut store = Self {
            bucket,
            watch,
            current: None,
            revision: 0,
            refusals: BTreeMap::new(),
            reread_at: Instant::now() + REREAD,
        };
        tokio::time::timeout(PATIENCE, store.read()).await.unwrap_or_else(|_| Err(no_answer()))?;
        Ok(store)
    }

    /// The present version; `None`: there is no plant yet.
    #[must_use]
    pub fn current(&self) -> Option<&StoredPlant> {
        self.current.as_ref()
    }

    /// The members that have refused the present version, and why.
    pub fn refusals(&self) -> impl Iterator<Item = (&str, &str)> {
        let of_current = self.refusals.iter().filter(|(_, refusal)| refusal.version == self.revision);
        of_current.map(|(member, refusal)| (member.as_str(), refusal.why.as_str()))
    }

    /// Waits for a change, of the plant or of refusals, for 5 s at most. Cancel-safe.
    ///
    /// # Errors
    /// [`PlantStoreError`] when the store is lost: changes may be missing.
    pub async fn changed(&mut self) -> Result<(), PlantStoreError> {
        let Self { bucket, watch, .. } = self;
        let seen = tokio::select! {
            why = bucket.lost() => Err(why),
            seen = watch.next() => seen,
            () = tokio::time::sleep_until(self.reread_at) => return self.reread().await,
        };
        match seen.map_err(PlantStoreError::Other)? {
            Seen::Entry(entry) => self.take(entry),
            Seen::Complete => {}
        }
        Ok(())
    }

    #[cfg(test)]
    pub(super) fn set_watch(&mut self, watch: Watch) {
        (self.watch, self.reread_at) = (watch, Instant::now());
    }

    /// Reads the plant: a watch of nats-server 2.9 can lack entries.
    async fn reread(&mut self) -> Result<(), PlantStoreError> {
        let get = self.bucket.store().perform(Operation::Get { key: PLANT.to_owned() });
        let found = tokio::time::timeout(PATIENCE, get).await.unwrap_or(Outcome::Unknown);
        self.reread_at = Instant::now() + REREAD;
        match found {
            Outcome::Found { value, revision } if revision > self.revision => {
                self.take(Entry { key: PLANT.to_owned(), value, revision, stored_at: 0 });
            }
            Outcome::Found { .. } | Outcome::Missing => {}
            Outcome::Stored(_) | Outcome::WrongRevision | Outcome::Purged | Outcome::Unknown => {
                return Err(no_answer().into());
            }
        }
        Ok(())
    }

    /// Reads the entries that are there at first.
    async fn read(&mut self) -> Result<(), OrderError> {
        while !self.step().await? {}
        Ok(())
    }

    /// Takes the next entry. Returns `true` when all have come that were there at first. Cancel-safe.
    async fn step(&mut self) -> Result<bool, OrderError> {
        match self.watch.next().await.map_err(OrderError)? {
            Seen::Entry(entry) => self.take(entry),
            Seen::Complete => return Ok(true),
        }
        Ok(false)
    }

    fn take(&mut self, entry: Entry) {
        let Entry { key, value, revision, .. } = entry;
        let value = value.filter(|value| !value.is_empty());
        if key == PLANT {
            if revision < self.revision {
                // It was read before the watch delivered it.
                return;
            }
            self.revision = revision;
            self.current = value.map(|text| StoredPlant { version: Some(revision), text: text.into() });
        } else if let Some(member) = key.strip_prefix(REFUSAL) {
            let refusal = value.and_then(|value| serde_json::from_str(&value).ok());
            match refusal {
                Some(refusal) => drop(self.refusals.insert(member.to_owned(), refusal)),
                None => drop(self.refusals.remove(member)),
            }
        }
    }

    /// Stores a plant in place of the present version; an empty text removes it. Returns the new version.
    ///
    /// # Errors
    /// [`PlantStoreError`]. After `Other` it may have been stored.
    pub async fn put(&mut self, text: &str) -> Result<u64, PlantStoreError> {
        let (size, limit) = (text.len(), self.bucket.max_payload());
        if size > limit {
            return Err(PlantStoreError::TooLarge { size, limit });
        }
        let put = Operation::Put { key: PLANT.to_owned(), value: text.to_owned(), expected: self.revision };
        match tokio::time::timeout(PATIENCE, self.bucket.store().perform(put)).await.unwrap_or(Outcome::Unknown) {
            Outcome::Stored(revision) => {
                // Its entry of the watch says the same again.
                let entry = Entry { key: PLANT.to_owned(), value: Some(text.to_owned()), revision, stored_at: 0 };
                self.take(entry);
                Ok(revision)
            }
            Outcome::WrongRevision => Err(PlantStoreError::Changed),
            Outcome::Found { .. } | Outcome::Missing | Outcome::Purged | Outcome::Unknown => Err(no_answer().into()),
        }
    }

    /// Stores that a member has refused the present version.
    ///
    /// # Errors
    /// [`PlantStoreError`] if the server does not store it.
    pub async fn refuse(&mut self, member: &Name, why: &str) -> Result<(), PlantStoreError> {
        let why: String = why.chars().take(REASON).collect();
        let refusal = Refusal { version: self.revision, why };
        // A struct of a number and a text.
        let value = serde_json::to_string(&refusal).unwrap_or_default();
        let (store, key) = (self.bucket.store(), format!("{REFUSAL}{member}"));
        let stored = tokio::time::timeout(PATIENCE, store.set(&key, value)).await;
        stored.map_err(|_| no_answer())?.map_err(PlantStoreError::Other)
    }
}
