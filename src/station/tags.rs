//! Reads and writes of tags as Rust values.
//!
//! Invariants:
//! - Nothing is sent unless all tags exist, their values fit the Rust types and requests to the station, and
//!   their addresses are within the framing.
//! - A value of several registers is read by one request and written by one request.

use super::any_length::{check_value, partly};
use crate::capabilities::Refused;
use crate::command::{Code, Command as _, WriteMixed};
use crate::element::{Element, Value, Width};
use crate::error::Error;
use crate::plan::{CostModel, Plan, PlanError, StructPlan};
use crate::station::Station;
use crate::tag::{
    Assignment, FromTags, IntoAssignment as _, IntoAssignments, IntoTag, IntoTagValues, Tag, TagAccessError, TagSet,
    TagValue, Tags,
};

/// Tags as Rust values.
impl Station {
    /// Reads a tag, or several, into a Rust type.
    ///
    /// One tag is read into a number, a `bool`, a `String`, an array or a `Vec`; a tuple, an array or
    /// a `Vec` of tags into a tuple, an array or a `Vec` of these. All tags of a call are read by the
    /// cheapest [`Plan`] within the [capabilities](Self::capabilities) of the station. Values of several
    /// requests can be of different scans.
    ///
    /// A service that reads the same tags again and again keeps a [`Plan`], or uses a
    /// [`Poller`](crate::Poller).
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// use fatek::Tag;
    ///
    /// station.write("R100:f32", 21.5).await?;
    ///
    /// let level: f32 = station.read("R100:f32").await?;
    /// let speeds: Vec<i16> = station.read("R0-R9:i16").await?;
    /// let (open, count, name): (bool, u32, String) = station.read(("M5", "DR20", "R30-R39:text")).await?;
    /// let alarms: [bool; 3] = station.read(["M1", "M7", "X3"]).await?;
    /// let tag: Tag = "R5:u16*0.1".parse().expect("a tag");
    /// let scaled: f64 = station.read(tag).await?;
    /// # assert_eq!((level, speeds.len(), open, count), (21.5, 10, false, 0));
    /// # assert_eq!((name.as_str(), alarms, scaled), ("", [false; 3], 0.0));
    ///
    /// let error = station.read::<i16, _>("R100:f32").await.unwrap_err();
    /// assert_eq!(error.to_string(), "R100:f32 (f32 of 32 bits) cannot be read into `i16`");
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`Error::Tag`] for a text that is not a tag, or a tag that does not fit; those of
    /// [every method](Self#errors), for the first tag that fails: [`Error::RefusedTags`] names the tags of a
    /// request that the PLC refused. A read fails as a whole; a [`Plan`] has a result for each tag.
    ///
    /// Cancel-safe: it only reads.
    pub async fn read<T, S>(&self, tags: S) -> Result<T, Error>
    where
        S: TagSet,
        T: FromTags<S::Shape>,
    {
        let tags = tags.into_tags()?;
        T::check(&tags)?;
        let values = self.read_tags(&tags).await?;
        Ok(T::from_all_values(&tags, &values)?)
    }

    /// Writes a value to a tag, or several values to a tag with as many.
    ///
    /// A number is checked against the type of the tag; see [`IntoTagValues`]. A tag of more than one
    /// request is written by several, of which none splits a value.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write("R100:f32", 21.5).await?;
    /// station.write("R0-R2", [1, 2, 3]).await?;
    /// station.write("R5:i16*0.1", -4.5).await?;
    /// station.write("R30-R39:text", "boiler 2").await?;
    /// station.write("M5", true).await?;
    ///
    /// let error = station.write("R7", 70_000).await.unwrap_err();
    /// let text = "70000 cannot be written to R7 (u16 of 16 bits): out of range: u16 takes 0 to 65535";
    /// assert_eq!(error.to_string(), text);
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// [`Error::Tag`] for a text that is not a tag, or a value that does not fit;
    /// [`InvalidRequest::ValueTooLong`](crate::InvalidRequest::ValueTooLong) for a value of more registers
    /// than the [capabilities](Self::capabilities) of the station allow in one request. Those of
    /// [every method](Self#errors), with [`Error::PartlyWritten`] for a tag of several requests.
    ///
    /// Cancel safety: as of [every method](Self#cancel-safety).
    pub async fn write(&self, tag: impl IntoTag, values: impl IntoTagValues) -> Result<(), Error> {
        self.write_assignment(&(tag, values).into_assignment()?).await
    }

    /// Writes values to several tags, in their order, by as few requests as cost less time.
    ///
    /// Tags next to each other in the list, of 32 units in all at most, are written by one mixed write
    /// (49), in one scan, if that is cheaper and none of them is written twice. If the PLC does not
    /// know that command, they are written one by one.
    ///
    /// ```
    /// # fatek::sim::doctest(|station| async move {
    /// station.write_all((("R100:f32", 21.5), ("M5", true), ("R0-R2", [1, 2, 3]))).await?;
    /// station.write_all([("R10", 7), ("R20", 8)]).await?;
    ///
    /// assert_eq!(station.read::<(f32, bool), _>(("R100:f32", "M5")).await?, (21.5, true));
    /// # Ok(()) });
    /// ```
    ///
    /// # Errors
    /// As of [`write`](Self::write) for tags and values that do not fit: nothing is sent.
    /// Those of [every method](Self#errors); [`Error::RefusedTags`] names the tags of a request that the
    /// PLC refused. After the first request [`Error::PartlyWritten`], which counts the values of all tags.
    ///
    /// Cancel safety: as of [every method](Self#cancel-safety); what was written stays written.
    pub async fn write_all(&self, assignments: impl IntoAssignments) -> Result<(), Error> {
        let assignments = assignments.into_assignments()?;
        let cost = CostModel::of_station(self);
        let framing = self.link.framing();
        for tag in assignments.iter().map(Assignment::tag) {
            tag.check_in(framing).map_err(crate::InvalidRequest::from)?;
            let code = if tag.first().width() == Width::Bit { Code::WriteDiscretes } else { Code::WriteRegisters };
            check_value(self, code, (tag.first(), tag.elements_per_value()))?;
        }
        let count = value_count(&assignments);
        let mut rest = assignments.as_slice();
        while !rest.is_empty() {
            let (group, others) = rest.split_at(together(rest, &cost));
            let written = count - value_count(rest);
            let result = self.write_group(group, assignments.len() > 1).await;
            result.map_err(|(in_group, error)| partly(written + in_group, count, error))?;
            rest = others;
        }
        Ok(())
    }

    /// Reads a struct of tags by the cheapest requests; see [`Tags`].
    ///
    /// A service that reads the same struct again and again keeps a
    /// [`StructPlan`](crate::plan::StructPlan), or uses a [`Poller`](crate::Poller).
    ///
    /// # Errors
    /// Those of [`StructPlan::for_station`](crate::plan::StructPlan::for_station) and
    /// [`StructPlan::read`](crate::plan::StructPlan::read).
    ///
    /// Cancel-safe: it only reads.
    pub async fn read_struct<T: Tags>(&self) -> Result<T, Error> {
        StructPlan::for_station(self)?.read(self).await
    }

    /// Writes the fields of a struct of tags in their order, but for those that are read only; see
    /// [`Tags`] and [`write_all`](Self::write_all).
    ///
    /// It writes all of these fields, also those that were not changed. A value that the PLC has
    /// changed since the struct was read is overwritten: make fields that the PLC writes `read_only`.
    ///
    /// # Errors
    /// Those of [`write_all`](Self::write_all).
    ///
    /// Cancel safety: as of [every method](Self#cancel-safety); what was written stays written.
    pub async fn write_struct<T: Tags>(&self, fields: &T) -> Result<(), Error> {
        self.write_all(fields.assignments()?).await
    }

    /// The values of each tag, by the cheapest plan.
    async fn read_tags(&self, tags: &[Tag]) -> Result<Vec<Vec<TagValue>>, Error> {
        let plan = Plan::builder_for(self).tags(tags.iter().copied()).build();
        let plan = plan.map_err(PlanError::into_call_error)?;
        let readings = plan.read(self).await;
        readings.all_values(0..tags.len())
    }

    /// Writes assignments by one request, or one by one. The error has the number of values written
    /// before, and the tags if these are among others.
    async fn write_group(&self, group: &[Assignment], is_among_others: bool) -> Result<(), (usize, Error)> {
        if group.len() > 1 && !self.link.known_capabilities(self.number).lacks(Code::WriteMixed) {
            match self.write_mixed(&items(group)).await {
                // The PLC does not know the command, so it has written nothing.
                Err(Error::Plc { repeated: false, error, .. }) if error.is_about_the_command() => {
                    self.link.learn_capability(self.number, Refused::MixedWrites);
                }
                result => return result.map_err(|error| (0, error.of_tags(&tags_of(group)))),
            }
        }
        for (n, assignment) in group.iter().enumerate() {
            let written = value_count(group.get(..n).unwrap_or_default());
            let result = self.write_assignment(assignment).await;
            let named = |error: Error| if is_among_others { error.of_tags(&[assignment.tag()]) } else { error };
            result.map_err(|error| (written, named(error)))?;
        }
        Ok(())
    }

    /// Writes the elements of one tag.
    pub(crate) async fn write_assignment(&self, assignment: &Assignment) -> Result<(), Error> {
        let (tag, raw) = (assignment.tag(), assignment.encode());
        let written = match tag.first() {
            Element::Discrete(first) => self.write_discretes(first, &of_width(&raw)).await,
            Element::Register(first) => self.write_values((first, tag.elements_per_value()), &of_width(&raw)).await,
            Element::Register32(first) => self.write_values32((first, tag.elements_per_value()), &of_width(&raw)).await,
        };
        // Requests end where a value does.
        let per_value = tag.elements_per_value().max(1);
        if let Err(Error::PartlyWritten { written, count, source }) = written {
            debug_assert!(written.is_multiple_of(per_value), "no value is split");
            return Err(Error::PartlyWritten { written: written / per_value, count: count / per_value, source });
        }
        written
    }
}

impl From<TagAccessError> for Error {
    fn from(error: TagAccessError) -> Self {
        Self::Tag(Box::new(error))
    }
}

/// The raw values of an assignment, which are all as wide as its elements.
fn of_width<T: TryFrom<Value>>(raw: &[Value]) -> Vec<T> {
    let values: Vec<T> = raw.iter().filter_map(|&value| value.try_into().ok()).collect();
    debug_assert_eq!(values.len(), raw.len(), "the values of an assignment are as wide as its elements");
    values
}

fn tags_of(assignments: &[Assignment]) -> Vec<Tag> {
    assignments.iter().map(Assignment::tag).collect()
}

fn value_count(assignments: &[Assignment]) -> usize {
    assignments.iter().map(|assignment| assignment.values().len()).sum()
}

fn items(group: &[Assignment]) -> Vec<(Element, Value)> {
    group.iter().flat_map(|assignment| assignment.tag().elements().zip(assignment.encode())).collect()
}

/// The number of assignments, from the first on, that are written by one request.
fn together(assignments: &[Assignment], cost: &CostModel) -> usize {
    let framing = cost.framing();
    let is_mixed = |group: &[Assignment]| WriteMixed::new(items(group)).is_ok_and(|write| write.check(framing).is_ok());
    // A request by itself has its frames and its turnaround, a part of a mixed write one name more
    // for each element but the first.
    let single = cost.request_time() + cost.byte_time() * u32::try_from(2 * framing.frame_overhead()).unwrap_or(0);
    let names = |assignment: &Assignment| {
        let tag = assignment.tag();
        let bytes = tag.element_count().saturating_sub(1) * framing.element_len(tag.first().symbol());
        cost.byte_time().saturating_mul(u32::try_from(bytes).unwrap_or(u32::MAX))
    };
    // A pulse is two writes: the PLC must see both values.
    let is_new = |count: usize, next: &Assignment| {
        let (area, begin, end) = next.tag().memory();
        let overlaps = |other: &Assignment| {
            let (other_area, other_begin, other_end) = other.tag().memory();
            area == other_area && begin <= other_end && other_begin <= end
        };
        !assignments.iter().take(count).any(overlaps)
    };
    let Some(first) = assignments.first() else { return 0 };
    if names(first) >= single {
        return 1;
    }
    let joins = |&count: &usize| match assignments.get(..=count) {
        Some(group @ [.., next]) => names(next) < single && is_new(count, next) && is_mixed(group),
        Some([]) | None => false,
    };
    let joined = (1..assignments.len()).take_while(joins).count();
    1 + joined
}

#[cfg(test)]
mod tests;
