//! The macro behind the command table in `mod.rs`.

/// Makes [`Code`](super::Code), [`Request`](super::Request) and `with_command!` from the rows of
/// the command table.
///
/// A row with `or` has a command for two widths of elements: a [`Request`](super::Request) variant
/// for each.
macro_rules! commands {
    ($(
        $code:literal $file:ident $name:ident $(<$narrow:ident> or $wide:ident<$element:ident>)?
            $text:literal $class:ident $framings:ident $error:ident;
    )*) => {
        $(pub use self::$file::$name;)*

        /// The code of a command.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
        #[repr(u8)]
        #[non_exhaustive]
        pub enum Code {
            $(
                #[doc = concat!("`", stringify!($code), "`: ", $text, ".")]
                $name = $code,
            )*
        }

        impl Code {
            /// All commands, in the order of their codes.
            pub const ALL: &'static [Self] = &[$(Self::$name),*];

            /// The command with this code.
            #[must_use]
            pub fn from_u8(code: u8) -> Option<Self> {
                match code {
                    $($code => Some(Self::$name),)*
                    _ => None,
                }
            }

            fn row(self) -> code::Row {
                match self {
                    $(Self::$name => code::Row {
                        name: $text,
                        class: Class::$class,
                        framings: code::Framings::$framings,
                        error: ErrorField::$error,
                    },)*
                }
            }
        }

        impl From<Code> for u8 {
            fn from(code: Code) -> Self {
                match code {
                    $(Code::$name => $code,)*
                }
            }
        }

        /// A request of any command, as a PLC or a [gateway](crate::Station::forward) receives it.
        #[derive(Clone, Debug, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum Request {
            $(
                #[doc = concat!("`", stringify!($code), "`: ", $text, $(", for a [`", stringify!($narrow), "`]",)? ".")]
                $name($name $(<$narrow>)?),
                $(
                    #[doc = concat!("`", stringify!($code), "`: ", $text, ", for a [`", stringify!($element), "`].")]
                    $wide($name<$element>),
                )?
            )*
        }

        impl Request {
            /// Reads the fields of a request with this code, up to the end of the data.
            ///
            /// [`decode`](Self::decode) does this for a frame.
            ///
            /// # Errors
            /// [`RequestError`]: the first rule that the fields break.
            pub fn read<R: FieldReader + Clone>(code: Code, fields: &mut R) -> Result<Self, RequestError> {
                match code {
                    $(Code::$name => commands!(@read fields $name $($wide)?),)*
                }
            }
        }

        /// Evaluates an expression with the command in a [`Request`], whose type differs from
        /// variant to variant.
        macro_rules! with_command {
            ($request:expr, $command:ident => $do:expr) => {
                match $request {
                    $(
                        $crate::command::Request::$name($command) => $do,
                        $($crate::command::Request::$wide($command) => $do,)?
                    )*
                }
            };
        }
        pub(crate) use with_command;
    };
    (@read $fields:ident $name:ident) => {
        request::read_whole($fields).map(Self::$name)
    };
    (@read $fields:ident $name:ident $wide:ident) => {
        request::read_either($fields, Self::$name, Self::$wide)
    };
}
