use std::sync::Arc;
use std::time::Duration;

use super::options::EchoMode;
use super::stations::Rules;
use crate::endpoint::InStepSettings;
use crate::wire::Framing;

/// How the link behaves towards all its stations.
#[derive(Clone, Debug)]
pub(crate) struct Config {
    pub(crate) framing: Framing,
    /// What the errors call the other end.
    pub(crate) name: Arc<str>,
    pub(crate) queue_capacity: usize,
    pub(crate) ageing: Duration,
    pub(crate) rules: Rules,
    /// The response timeout of a probe.
    pub(crate) probe_timeout: Duration,
    pub(crate) connect_backoff: (Duration, Duration),
    /// Whether calls fail as soon as an attempt to connect does, instead of waiting for the next one.
    pub(crate) fail_fast: bool,
    /// How the line treats replies.
    pub(crate) in_step: InStepSettings,
    /// The time of a byte on the line.
    pub(crate) byte_time: Duration,
    /// How long to go on listening while a frame is coming in, or after a corrupt one in which the reply may have been.
    pub(crate) settle: Duration,
    /// How long the longest frame takes on the line; nothing on a network.
    pub(crate) frame_time: Duration,
    /// How long the line is left alone between a reply and the next request.
    pub(crate) gap: Duration,
    /// How long the line is left alone after a broadcast.
    pub(crate) broadcast_gap: Duration,
    pub(crate) echo: EchoMode,
    /// After how long without a call the connection is closed.
    pub(crate) idle_timeout: Option<Duration>,
}
