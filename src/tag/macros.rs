//! Tags in source code, checked by the compiler.

/// A [`Tag`](crate::Tag) that the compiler checks: `tag!("R100:f32")`.
///
/// `cargo check` reports a text that is not a tag, in generic code, too. The macro can be used in
/// constants. The numbers of a scale have at most 15 digits, and exponents from -22 to 22.
///
/// ```
/// use fatek::{Tag, tag};
///
/// const LEVEL: Tag = tag!("R5:i16*0.1-40");
/// assert_eq!("r5:short*0.1-40".parse(), Ok(LEVEL));
/// ```
///
/// ```compile_fail
/// let _ = fatek::tag!("R100:f33"); // no such type
/// ```
///
/// ```compile_fail
/// let _ = fatek::tag!("R0-R8:f32"); // nine registers, and a value takes two
/// ```
///
/// ```compile_fail
/// fn generic<T>() -> fatek::Tag {
///     fatek::tag!("R5.16") // no such bit
/// }
/// ```
#[macro_export]
macro_rules! tag {
    ($text:expr) => {{
        // An item, unlike a block of the surrounding function, is evaluated even if that function is
        // generic.
        // Its name must not hide a constant in the text.
        const __FATEK_TAG: $crate::tag::Tag = match $crate::tag::Tag::parse($text) {
            ::core::result::Result::Ok(tag) => tag,
            ::core::result::Result::Err(error) => ::core::panic!("{}", error.rule()),
        };
        __FATEK_TAG
    }};
}
