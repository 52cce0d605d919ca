//! Elements in source code, checked by the compiler.

/// A [`Discrete`](crate::Discrete) that the compiler checks: `discrete!("M100")`.
///
/// ```
/// let lamp = fatek::discrete!("Y3");
/// assert_eq!(lamp.to_string(), "Y3");
/// ```
///
/// ```compile_fail
/// let _ = fatek::discrete!("Y65536"); // past the last address
/// ```
#[macro_export]
macro_rules! discrete {
    ($text:literal) => {
        $crate::checked_element!(Discrete, $text, "is not a discrete (X, Y, M, S, T or C and 0..=65535)")
    };
}

/// A [`Register`](crate::Register) that the compiler checks: `register!("R12")`.
///
/// ```
/// let speed = fatek::register!("R12");
/// assert_eq!(speed, fatek::Register::r(12));
/// ```
///
/// ```compile_fail
/// let _ = fatek::register!("WM4"); // not a multiple of 8
/// ```
///
/// ```compile_fail
/// let _ = fatek::register!("RC200"); // a counter of 32 bits, DRC200
/// ```
///
/// ```compile_fail
/// fn generic<T>() -> fatek::Register {
///     fatek::register!("R65536") // past the last address
/// }
/// ```
#[macro_export]
macro_rules! register {
    ($text:literal) => {
        $crate::checked_element!(Register, $text, "is not a 16-bit register of the protocol")
    };
}

/// A [`Register32`](crate::Register32) that the compiler checks: `register32!("DR100")`.
///
/// ```
/// assert_eq!(fatek::register32!("DR100").low(), Ok(fatek::Register::r(100)));
/// ```
///
/// ```compile_fail
/// let _ = fatek::register32!("DRC199"); // RC199 and a counter of 32 bits, DRC200
/// ```
#[macro_export]
macro_rules! register32 {
    ($text:literal) => {
        $crate::checked_element!(Register32, $text, "is not a 32-bit register of the protocol")
    };
}

/// An [`Element`](crate::Element) that the compiler checks: `element!("DWM0")`.
///
/// ```
/// assert_eq!(fatek::element!("DWM0").to_string(), "DWM0");
/// ```
#[macro_export]
macro_rules! element {
    ($text:literal) => {
        $crate::checked_element!(Element, $text, "is not an element of the protocol")
    };
}

#[doc(hidden)]
#[macro_export]
macro_rules! checked_element {
    ($type:ident, $text:literal, $rule:literal) => {{
        // An item, unlike a block of the surrounding function, is evaluated even if that function
        // is generic.
        const ELEMENT: $crate::$type = match $crate::$type::parse($text) {
            ::core::result::Result::Ok(element) => element,
            ::core::result::Result::Err(_) => ::core::panic!(::core::concat!($text, " ", $rule)),
        };
        ELEMENT
    }};
}
