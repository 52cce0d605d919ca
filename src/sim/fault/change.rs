use std::fmt;

use crate::command::{ProgramPage, Value};
use crate::element::{Discrete, Element};

/// One change of a PLC by a request that it has executed; see [`Log::changes`](super::Log::changes).
///
/// It does not depend on the command: 47 and 49 with the same values give the same changes.
///
/// `Debug` is the same text as `Display`, such as `R0 = 7`, so that a failed `assert_eq!` shows
/// lists of changes in a readable form.
#[derive(Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum Change {
    /// An element was written: 45, 47, 49, and set and reset of 42. Also if the value was the same.
    Value(Element, Value),
    /// A discrete was disabled: 42.
    Disabled(Discrete),
    /// A discrete was enabled: 42.
    Enabled(Discrete),
    /// The PLC was started: 41.
    Run,
    /// The PLC was stopped: 41.
    Stop,
    /// A page of the program was written: 50.
    Page(u16, ProgramPage),
    /// This number of executed writes and control requests, of all stations, is not in the log.
    ///
    /// They exceeded [`Faults::log_capacity`](super::Faults::log_capacity), or arrived before the
    /// log was [cleared](super::Log::clear).
    NotInLog(u64),
}

impl Change {
    /// A [`Value`](Self::Value) of an element.
    ///
    /// ```
    /// use fatek::register;
    /// use fatek::sim::fault::Change;
    ///
    /// assert_eq!(Change::value(register!("R0"), 7_u16).to_string(), "R0 = 7");
    /// ```
    #[must_use]
    pub fn value(element: impl Into<Element>, value: impl Into<Value>) -> Self {
        Self::Value(element.into(), value.into())
    }

    /// Values of consecutive elements.
    pub(in crate::sim) fn values<V: Copy + Into<Value>>(first: impl Into<Element>, values: &[V]) -> Vec<Self> {
        let first = first.into();
        // An executed request has elements that exist.
        let change = |(n, &value): (usize, &V)| Some(Self::value(first.nth(n).ok()?, value));
        values.iter().enumerate().filter_map(change).collect()
    }
}

impl fmt::Display for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Value(element, value) => write!(f, "{element} = {value}"),
            Self::Disabled(discrete) => write!(f, "disable {discrete}"),
            Self::Enabled(discrete) => write!(f, "enable {discrete}"),
            Self::Run => f.write_str("run"),
            Self::Stop => f.write_str("stop"),
            Self::Page(page, content) => write!(f, "page {page} = {content}"),
            Self::NotInLog(writes) => write!(f, "{writes} writes that are not in the log"),
        }
    }
}

impl fmt::Debug for Change {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{self}")
    }
}
