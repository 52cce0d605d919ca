//! Tags and values as arguments and results: one tag or several, as texts, tuples and lists.

use super::{Assignment, FromTag, IntoTagValues, Tag, TagAccessError, TagValue};
use crate::element::{Discrete, Element, Register, Register32};

/// A tag, or the text of one.
pub trait IntoTag {
    /// The tag.
    ///
    /// # Errors
    /// [`TagAccessError::Parse`] for a text that is not a tag.
    fn into_tag(self) -> Result<Tag, TagAccessError>;
}

/// One tag, or several: a tuple, an array, a slice or a `Vec`.
pub trait TagSet {
    /// [`One`] or [`Several`].
    type Shape;

    /// The tags, in their order.
    ///
    /// # Errors
    /// [`TagAccessError::Parse`] for a text that is not a tag.
    fn into_tags(self) -> Result<Vec<Tag>, TagAccessError>;
}

/// Marks a single tag.
#[derive(Debug)]
#[non_exhaustive]
pub struct One;

/// Marks a tuple or list of tags.
#[derive(Debug)]
#[non_exhaustive]
pub struct Several;

macro_rules! tags {
    ($($name:ty: $tag:ident => $do:expr;)*) => {
        $(
            impl IntoTag for $name {
                fn into_tag(self) -> Result<Tag, TagAccessError> {
                    let $tag = self;
                    $do
                }
            }

            impl TagSet for $name {
                type Shape = One;

                fn into_tags(self) -> Result<Vec<Tag>, TagAccessError> {
                    Ok(vec![self.into_tag()?])
                }
            }
        )*
    };
}

tags! {
    &str: text => Ok(text.parse()?);
    &String: text => Ok(text.parse()?);
    String: text => Ok(text.parse()?);
    Tag: tag => Ok(tag);
    &Tag: tag => Ok(*tag);
    Element: element => Ok(element.into());
    Discrete: element => Ok(Element::from(element).into());
    Register: element => Ok(Element::from(element).into());
    Register32: element => Ok(Element::from(element).into());
}

impl<T: IntoTag, const N: usize> TagSet for [T; N] {
    type Shape = Several;

    fn into_tags(self) -> Result<Vec<Tag>, TagAccessError> {
        self.into_iter().map(IntoTag::into_tag).collect()
    }
}

impl<T: IntoTag> TagSet for Vec<T> {
    type Shape = Several;

    fn into_tags(self) -> Result<Vec<Tag>, TagAccessError> {
        self.into_iter().map(IntoTag::into_tag).collect()
    }
}

impl<T: IntoTag + Clone> TagSet for &[T] {
    type Shape = Several;

    fn into_tags(self) -> Result<Vec<Tag>, TagAccessError> {
        self.iter().cloned().map(IntoTag::into_tag).collect()
    }
}

/// A Rust type that holds the values of a [`TagSet`]: a [`FromTag`] for one tag, a tuple, an array or
/// a `Vec` of them for several.
pub trait FromTags<Shape>: Sized {
    /// Checks that the values of these tags fit, before they are read.
    ///
    /// # Errors
    /// [`TagAccessError::NotInto`] names the tag and the type.
    fn check(tags: &[Tag]) -> Result<(), TagAccessError>;

    /// Makes it of the values of each tag.
    ///
    /// # Errors
    /// [`TagAccessError::NotInto`] names the tag and the type.
    fn from_all_values(tags: &[Tag], values: &[Vec<TagValue>]) -> Result<Self, TagAccessError>;
}

pub(super) fn check_one<T: FromTag>(tag: Option<&Tag>) -> Result<(), TagAccessError> {
    match tag {
        Some(tag) if T::fits(tag) => Ok(()),
        Some(tag) => Err(TagAccessError::NotInto { tag: *tag, rust_type: T::type_name() }),
        None => Err(TagAccessError::Number { tags: 0, items: 1 }),
    }
}

pub(super) fn one<T: FromTag>(tag: Option<&Tag>, values: Option<&Vec<TagValue>>) -> Result<T, TagAccessError> {
    let (tag, values) = tag.zip(values).ok_or(TagAccessError::Number { tags: 0, items: 1 })?;
    T::from_values(values).ok_or_else(|| {
        let rust_type = T::type_name();
        match values.iter().find(|value| value.is_no_number()) {
            Some(value) => TagAccessError::NoNumber { tag: *tag, value: value.to_string() },
            None => TagAccessError::NotInto { tag: *tag, rust_type },
        }
    })
}

impl<T: FromTag> FromTags<One> for T {
    fn check(tags: &[Tag]) -> Result<(), TagAccessError> {
        check_one::<T>(tags.first())
    }

    fn from_all_values(tags: &[Tag], values: &[Vec<TagValue>]) -> Result<Self, TagAccessError> {
        one(tags.first(), values.first())
    }
}

impl<T: FromTag> FromTags<Several> for Vec<T> {
    fn check(tags: &[Tag]) -> Result<(), TagAccessError> {
        tags.iter().try_for_each(|tag| check_one::<T>(Some(tag)))
    }

    fn from_all_values(tags: &[Tag], values: &[Vec<TagValue>]) -> Result<Self, TagAccessError> {
        tags.iter().zip(values).map(|(tag, values)| one(Some(tag), Some(values))).collect()
    }
}

impl<T: FromTag, const N: usize> FromTags<Several> for [T; N] {
    fn check(tags: &[Tag]) -> Result<(), TagAccessError> {
        let tags_are = TagAccessError::Number { tags: tags.len(), items: N };
        if tags.len() == N { <Vec<T> as FromTags<Several>>::check(tags) } else { Err(tags_are) }
    }

    fn from_all_values(tags: &[Tag], values: &[Vec<TagValue>]) -> Result<Self, TagAccessError> {
        let items = <Vec<T> as FromTags<Several>>::from_all_values(tags, values)?;
        items.try_into().map_err(|items: Vec<T>| TagAccessError::Number { tags: items.len(), items: N })
    }
}

macro_rules! tuples {
    ($($($name:ident $at:tt)+;)*) => {
        $(
            impl<$($name: IntoTag),+> TagSet for ($($name,)+) {
                type Shape = Several;

                fn into_tags(self) -> Result<Vec<Tag>, TagAccessError> {
                    Ok(vec![$(self.$at.into_tag()?),+])
                }
            }

            impl<$($name: FromTag),+> FromTags<Several> for ($($name,)+) {
                fn check(tags: &[Tag]) -> Result<(), TagAccessError> {
                    let items = [$($at),+].len();
                    if tags.len() != items {
                        return Err(TagAccessError::Number { tags: tags.len(), items });
                    }
                    $(check_one::<$name>(tags.get($at))?;)+
                    Ok(())
                }

                fn from_all_values(tags: &[Tag], values: &[Vec<TagValue>]) -> Result<Self, TagAccessError> {
                    Ok(($(one::<$name>(tags.get($at), values.get($at))?,)+))
                }
            }

            impl<$($name: IntoAssignment),+> IntoAssignments for ($($name,)+) {
                fn into_assignments(self) -> Result<Vec<Assignment>, TagAccessError> {
                    Ok(vec![$(self.$at.into_assignment()?),+])
                }
            }
        )*
    };
}

tuples! {
    A 0;
    A 0 B 1;
    A 0 B 1 C 2;
    A 0 B 1 C 2 D 3;
    A 0 B 1 C 2 D 3 E 4;
    A 0 B 1 C 2 D 3 E 4 F 5;
    A 0 B 1 C 2 D 3 E 4 F 5 G 6;
    A 0 B 1 C 2 D 3 E 4 F 5 G 6 H 7;
    A 0 B 1 C 2 D 3 E 4 F 5 G 6 H 7 I 8;
    A 0 B 1 C 2 D 3 E 4 F 5 G 6 H 7 I 8 J 9;
    A 0 B 1 C 2 D 3 E 4 F 5 G 6 H 7 I 8 J 9 K 10;
    A 0 B 1 C 2 D 3 E 4 F 5 G 6 H 7 I 8 J 9 K 10 L 11;
}

/// A tag with its values: an [`Assignment`], or a pair of [`IntoTag`] and [`IntoTagValues`].
pub trait IntoAssignment {
    /// The assignment.
    ///
    /// # Errors
    /// [`TagAccessError::Parse`] and [`TagAccessError::Misfit`].
    fn into_assignment(self) -> Result<Assignment, TagAccessError>;
}

impl IntoAssignment for Assignment {
    fn into_assignment(self) -> Result<Assignment, TagAccessError> {
        Ok(self)
    }
}

impl<T: IntoTag, V: IntoTagValues> IntoAssignment for (T, V) {
    fn into_assignment(self) -> Result<Assignment, TagAccessError> {
        let (tag, values) = (self.0.into_tag()?, self.1);
        let values = values.into_values(&tag)?;
        let misfit = |_| TagAccessError::misfit_of(&tag, values.len());
        Assignment::new(tag, values.clone()).map_err(misfit)
    }
}

/// Assignments to be written: an array, a `Vec` or a tuple of [`IntoAssignment`].
pub trait IntoAssignments {
    /// The assignments, in their order.
    ///
    /// # Errors
    /// Those of [`IntoAssignment::into_assignment`].
    fn into_assignments(self) -> Result<Vec<Assignment>, TagAccessError>;
}

impl<T: IntoAssignment, const N: usize> IntoAssignments for [T; N] {
    fn into_assignments(self) -> Result<Vec<Assignment>, TagAccessError> {
        self.into_iter().map(IntoAssignment::into_assignment).collect()
    }
}

impl<T: IntoAssignment + Clone> IntoAssignments for &[T] {
    fn into_assignments(self) -> Result<Vec<Assignment>, TagAccessError> {
        self.iter().cloned().map(IntoAssignment::into_assignment).collect()
    }
}

impl<T: IntoAssignment> IntoAssignments for Vec<T> {
    fn into_assignments(self) -> Result<Vec<Assignment>, TagAccessError> {
        self.into_iter().map(IntoAssignment::into_assignment).collect()
    }
}
