//! Structs whose fields are tags.

use super::sets::{check_one, one};
use super::{Assignment, FromTag, IntoAssignment as _, IntoTagValues, Tag, TagAccessError, TagValue};

/// A struct whose fields are tags; mostly derived (feature `derive`).
///
/// It is read and written as a whole by [`Station::read_struct`](crate::Station::read_struct) and
/// [`Station::write_struct`](crate::Station::write_struct), planned once by a
/// [`StructPlan`](crate::plan::StructPlan), and polled by
/// [`PolledStation::add_struct`](crate::poll::PolledStation::add_struct).
///
/// Each field has an attribute `#[tag("…")]`, whose text is checked when the program is compiled, as
/// is the type of the field, if it is a number, a `bool`, a `String`, or a `Vec` or an array of
/// these. Behind the text can stand:
///
/// - `one_scan`: all such fields come from one request, and thus from one scan of the PLC.
///   `one_scan = "name"` makes several such groups.
/// - `read_only`: the field is not written, such as an input or a bit of a register.
///
#[cfg_attr(feature = "derive", doc = "```")]
#[cfg_attr(not(feature = "derive"), doc = "```ignore")]
/// use fatek::Tags;
///
/// #[derive(Debug, PartialEq, Tags)]
/// struct Tank {
///     #[tag("R100:f32")]
///     level: f32,
///     #[tag("R5:i16*0.1-40")]
///     temperature: f64,
///     #[tag("DR2:i32", one_scan, read_only)]
///     batches: i32,
///     #[tag("X0-X3", one_scan, read_only)]
///     valves: [bool; 4],
///     #[tag("R7.3", read_only)]
///     pump_runs: bool,
/// }
/// # fatek::sim::doctest(|station| async move {
/// let mut tank: Tank = station.read_struct().await?;
/// tank.level = 2.5;
/// station.write_struct(&tank).await?;
/// assert_eq!(station.read_struct::<Tank>().await?, tank);
/// # Ok(()) });
/// ```
///
/// A write of the struct writes all fields that are not `read_only`, also those that were not changed. So
/// make each field `read_only` whose tag the program of the PLC or anything else writes.
///
/// A field can have an own type: one that is [`FromTag`], and unless it is `read_only` also [`IntoTagValues`] and
/// `Clone`.
///
/// Without the feature, [`FIELDS`](Self::FIELDS) and the three functions are written by hand, with
/// [`Field::check`], [`Field::value`] and [`Field::assignment`].
pub trait Tags: Sized {
    /// The fields, in their order.
    const FIELDS: &'static [Field];

    /// Checks that the values of the tags fit the types of the fields.
    ///
    /// # Errors
    /// [`TagAccessError::NotInto`] for the first field that does not fit.
    fn check() -> Result<(), TagAccessError>;

    /// Makes the struct of the values of its fields, in their order.
    ///
    /// # Errors
    /// [`TagAccessError::NotInto`], [`TagAccessError::NoNumber`] and [`TagAccessError::Number`].
    fn from_values(values: &[Vec<TagValue>]) -> Result<Self, TagAccessError>;

    /// The values of its fields to be written, in their order, without those that are read only.
    ///
    /// # Errors
    /// [`TagAccessError::Misfit`] for the first value that does not fit its tag.
    fn assignments(&self) -> Result<Vec<Assignment>, TagAccessError>;
}

/// A field of a struct of [`Tags`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use]
pub struct Field {
    name: &'static str,
    tag: Tag,
    one_scan: Option<&'static str>,
    read_only: bool,
}

impl Field {
    /// A field that is read and written.
    pub const fn new(name: &'static str, tag: Tag) -> Self {
        Self { name, tag, one_scan: None, read_only: false }
    }

    /// Sets the name of its one-scan group: one request reads all fields of a group.
    pub const fn with_one_scan(self, group: &'static str) -> Self {
        Self { one_scan: Some(group), ..self }
    }

    /// Sets that it is not written.
    pub const fn with_read_only(self, read_only: bool) -> Self {
        Self { read_only, ..self }
    }

    /// Its name.
    #[must_use]
    pub const fn name(&self) -> &'static str {
        self.name
    }

    /// Its tag.
    #[must_use]
    pub const fn tag(&self) -> Tag {
        self.tag
    }

    /// The name of its one-scan group.
    #[must_use]
    pub const fn one_scan(&self) -> Option<&'static str> {
        self.one_scan
    }

    /// Returns whether it is not written.
    #[must_use]
    pub const fn is_read_only(&self) -> bool {
        self.read_only
    }

    /// Checks that the values of its tag fit a type.
    ///
    /// # Errors
    /// [`TagAccessError::NotInto`].
    pub fn check<T: FromTag>(&self) -> Result<(), TagAccessError> {
        check_one::<T>(Some(&self.tag))
    }

    /// Its value, made of the values of its tag; `None` are those of a missing field.
    ///
    /// # Errors
    /// [`TagAccessError::NotInto`], [`TagAccessError::NoNumber`] and [`TagAccessError::Number`].
    pub fn value<T: FromTag>(&self, values: Option<&Vec<TagValue>>) -> Result<T, TagAccessError> {
        one(Some(&self.tag), values)
    }

    /// The assignment of a value to its tag.
    ///
    /// # Errors
    /// [`TagAccessError::Misfit`].
    pub fn assignment<T: IntoTagValues>(&self, value: T) -> Result<Assignment, TagAccessError> {
        (self.tag, value).into_assignment()
    }

    /// The tags of fields, grouped: first those that have no one-scan group, then each group. The
    /// numbers are those of the fields.
    pub(crate) fn by_group(fields: &[Self]) -> Vec<(Option<&'static str>, Vec<usize>)> {
        let mut groups: Vec<(Option<&'static str>, Vec<usize>)> = vec![(None, Vec::new())];
        for (number, field) in fields.iter().enumerate() {
            match groups.iter_mut().find(|(group, _)| *group == field.one_scan) {
                Some((_, numbers)) => numbers.push(number),
                None => groups.push((field.one_scan, vec![number])),
            }
        }
        groups
    }
}

/// Checks that a value of a type, as for [`fits_type`], can be written: a float is not written to a tag of
/// integers.
#[doc(hidden)]
#[must_use]
pub const fn takes_type(tag: &Tag, name: &str) -> bool {
    !matches!(name.as_bytes(), b"f32" | b"f64") || tag.kind().takes_floats()
}

/// Checks the type of a field when the program is compiled: for the code that `#[derive(Tags)]`
/// makes. `name`: a type that [`FromTag`] is implemented for here; `count`: the number of items of an
/// array, or `None` for a `Vec`.
#[doc(hidden)]
#[must_use]
pub const fn fits_type(tag: &Tag, name: &str, count: Option<usize>) -> bool {
    let has_count = match count {
        Some(count) => tag.value_count() == count,
        None => true,
    };
    has_count && tag.kind().is_held_by(name)
}
