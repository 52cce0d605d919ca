//! A struct of tags that is polled.

use std::fmt;
use std::marker::PhantomData;
use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::{PollError, PollTag, PolledStation, Quality, ScanClass, Stamp, TagId};
use crate::tag::{Field, TagAccessError, TagValue, Tags};

/// The tags of a struct that are polled; see [`PolledStation::add_struct`].
pub struct PolledStruct<T> {
    station: PolledStation,
    /// For each field, the id of its tag.
    ids: Vec<TagId>,
    of: PhantomData<fn() -> T>,
}

/// The reason why there is no current value of a polled struct.
#[derive(Clone, Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NotCurrent {
    /// A field is not good.
    #[error("{name} is {quality}")]
    #[non_exhaustive]
    Field {
        /// The name of its tag: that of the struct, a dot, and that of the field.
        name: Arc<str>,
        /// Its quality.
        quality: Quality,
    },
    /// A value does not fit its field: decimal digits (BCD) beyond 9.
    #[error(transparent)]
    Value(#[from] TagAccessError),
    /// The tag of a field is not polled any more.
    #[error("polling of these tags has ended")]
    Removed,
}

impl PolledStation {
    /// Adds the tags of the fields of a struct to a class.
    ///
    /// Their names are that of the struct, a dot, and that of the field: `tank.level`. Samples of them
    /// come from the [`Poller`](super::Poller) as of any tag, after each reading. Fields of a one-scan
    /// group come from one request.
    ///
    /// # Errors
    /// No tag is added on error. [`PollError::Tag`] for a field whose type does not fit its tag; those
    /// of [`add`](Self::add) and [`add_one_scan`](Self::add_one_scan).
    pub fn add_struct<T: Tags>(&self, class: ScanClass, name: &str) -> Result<PolledStruct<T>, PollError> {
        T::check().map_err(|error| PollError::Tag(error.into()))?;
        let first = self.shared.next_id.fetch_add(T::FIELDS.len() as u64, Ordering::Relaxed);
        let ids: Vec<TagId> = (first..).take(T::FIELDS.len()).map(TagId).collect();
        let member = |&number: &usize| {
            let (field, id) = (T::FIELDS.get(number)?, ids.get(number)?);
            Some((*id, PollTag::new(format!("{name}.{}", field.name()), field.tag())))
        };
        // Under one lock, so that no tag is read before all are added.
        let added = self.station.with(|poller| {
            let now = Stamp::now();
            let mut groups = Field::by_group(T::FIELDS).into_iter();
            let result = groups.try_for_each(|(group, fields)| {
                let tags = fields.iter().filter_map(member).collect();
                poller.add(class, tags, group.is_some(), now)
            });
            if result.is_err() {
                for &id in &ids {
                    poller.remove(id, now.instant);
                }
            }
            result
        });
        added.unwrap_or(Err(PollError::Closed))?;
        self.station.changed.notify_one();
        let station = Self { shared: self.shared.clone(), station: self.station.clone() };
        Ok(PolledStruct { station, ids, of: PhantomData })
    }
}

impl<T: Tags> PolledStruct<T> {
    /// Returns the struct of the last reading, if all of its fields are good.
    ///
    /// The fields of a one-scan group are of one scan, others may be of different ones.
    ///
    /// # Errors
    /// [`NotCurrent::Field`] for the first field that is stale or bad.
    pub fn latest(&self) -> Result<T, NotCurrent> {
        let samples = self.station.station.with(|poller| {
            let now = Stamp::now();
            self.station.shared.queue_samples(|samples| {
                self.ids.iter().map(|&id| poller.sample(id, now, samples)).collect::<Option<Vec<_>>>()
            })
        });
        let samples = samples.flatten().ok_or(NotCurrent::Removed)?;
        let values = samples.into_iter().map(|sample| {
            if sample.is_good() {
                Ok(sample.values().to_vec())
            } else {
                Err(NotCurrent::Field { name: sample.name, quality: sample.quality })
            }
        });
        let values: Vec<Vec<TagValue>> = values.collect::<Result<_, _>>()?;
        Ok(T::from_values(&values)?)
    }

    /// The ids of the tags, in the order of the fields.
    #[must_use]
    pub fn ids(&self) -> &[TagId] {
        &self.ids
    }

    /// Removes the tags, so that they are not polled any more.
    pub fn remove(self) {
        for &id in &self.ids {
            self.station.remove(id);
        }
    }
}

impl<T> fmt::Debug for PolledStruct<T> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("PolledStruct").field("ids", &self.ids).finish_non_exhaustive()
    }
}
