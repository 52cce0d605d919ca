//! Elements that the compiler checks.

/// A [`Discrete`](crate::Discrete) known when the program is compiled: `discrete!("M100")`. A wrong one does not compile.
///
/// ```
/// let lamp = fatek::discrete!("Y3");
/// assert_eq!(lamp.to_string(), "Y3");
/// ```
///
/// ```compile_fail
/// let _ = fatek::discrete!("Y10000"); // past the last address
/// ```
#[macro_export]
macro_rules! discrete {
    ($text:literal) => {
        $crate::known_element!(Discrete, $text, "is not a discrete (X, Y, M, S, T or C and 0..=9999)")
    };
}

/// A [`Register`](crate::Register) known when the program is compiled: `register!("R12")`. A wrong one does not compile.
///
/// ```
/// let speed = fatek::register!("R12");
/// assert_eq!(speed, fatek::Register::r(12));
/// ```
///
/// ```compile_fail
/// let _ = fatek::register!("WM4"); // not a multiple of 8
/// ```
#[macro_export]
macro_rules! register {
    ($text:literal) => {
        $crate::known_element!(Register, $text, "is not a 16-bit register the protocol has")
    };
}

/// A [`Register32`](crate::Register32) known when the program is compiled: `register32!("DR100")`. A wrong one does not compile.
///
/// ```
/// assert_eq!(fatek::register32!("DR100").low(), fatek::Register::r(100));
/// ```
#[macro_export]
macro_rules! register32 {
    ($text:literal) => {
        $crate::known_element!(Register32, $text, "is not a 32-bit register the protocol has")
    };
}

/// An [`Element`](crate::Element) known when the program is compiled: `element!("DWM0")`. A wrong one does not compile.
///
/// ```
/// assert_eq!(fatek::element!("DWM0").to_string(), "DWM0");
/// ```
#[macro_export]
macro_rules! element {
    ($text:literal) => {
        $crate::known_element!(Element, $text, "is not an element the protocol has")
    };
}

#[doc(hidden)]
#[macro_export]
macro_rules! known_element {
    ($type:ident, $text:literal, $rule:literal) => {
        const {
            match $crate::$type::parse($text) {
                ::core::result::Result::Ok(element) => element,
                ::core::result::Result::Err(_) => ::core::panic!(::core::concat!($text, " ", $rule)),
            }
        }
    };
}
