//! Fields of an explained frame.

/// Some bytes of a frame, and their meaning.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Field {
    pub(super) part: Part,
    pub(super) name: String,
    pub(super) bytes: Vec<u8>,
    pub(super) meaning: String,
}

/// Part of the frame that a field belongs to: the frame itself, or its data read as request or
/// reply.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Part {
    Frame,
    Request,
    Reply,
}

impl Part {
    pub(super) fn as_str(self) -> &'static str {
        match self {
            Self::Frame => "frame",
            Self::Request => "request",
            Self::Reply => "reply",
        }
    }
}

/// Data of a frame, read as a request or as a reply.
#[derive(Clone, Debug)]
pub(super) struct DataReading {
    /// Fields read before the end or the first fault.
    pub(super) fields: Vec<Field>,
    pub(super) fault: Option<String>,
}
