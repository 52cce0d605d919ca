use std::sync::Arc;
use std::time::Duration;

use super::frame_gap::GapLengths;
use super::options::EchoMode;
use super::stations::OfflineRules;
use crate::endpoint::InStepSettings;
use crate::wire::Framing;

/// Settings of a link that hold for all its stations.
#[derive(Clone, Debug)]
pub(crate) struct Config {
    pub(crate) framing: Framing,
    /// The name of the endpoint in errors.
    pub(crate) name: Arc<str>,
    pub(crate) queue_capacity: usize,
    pub(crate) ageing: Duration,
    pub(crate) offline_rules: OfflineRules,
    /// The response timeout of a probe.
    pub(crate) probe_timeout: Duration,
    pub(crate) connect_backoff: (Duration, Duration),
    /// `true` if waiting calls fail with the first failed attempt to connect.
    pub(crate) fail_fast: bool,
    /// Assumptions about the line's replies.
    pub(crate) in_step: InStepSettings,
    /// Transmission time of a byte.
    pub(crate) byte_time: Duration,
    /// How long to listen on while a frame is coming in, or after a corrupt frame that may have
    /// been the reply.
    pub(crate) settle: Duration,
    /// Transmission time of the longest frame; zero on a network.
    pub(crate) frame_time: Duration,
    /// How long to wait for the next byte of a frame that comes after the response timeout.
    pub(crate) byte_timeout: Duration,
    /// How long after the response timeout a frame may end whose bytes keep coming.
    pub(crate) slow_frame_time: Duration,
    /// Silence of all stations after which the connection is replaced; `None`: never.
    pub(crate) mute_timeout: Option<Duration>,
    /// Silence between a reply and the next request.
    pub(crate) frame_gap: GapLengths,
    /// Silence after a broadcast.
    pub(crate) broadcast_gap: Duration,
    pub(crate) echo: EchoMode,
    /// The connection is closed after this time without a call.
    pub(crate) idle_timeout: Option<Duration>,
}
