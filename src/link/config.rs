//! The settings of a link that hold for all its stations, shared by links with the same ones.

use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use super::frame_gap::GapLengths;
use super::line::Line;
use super::options::EchoMode;
use super::stations::OfflineRules;
use crate::endpoint::InStepSettings;
use crate::wire::Framing;

/// Settings of a link that hold for all its stations.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Config {
    pub(crate) framing: Framing,
    pub(crate) queue_capacity: usize,
    pub(crate) ageing: Duration,
    pub(crate) offline_rules: OfflineRules,
    /// The serial line, if it is one.
    pub(crate) line: Option<Line>,
    /// The response timeout of probes, and of calls whose options have none.
    pub(crate) response_timeout: Duration,
    /// The timeout of one attempt to connect.
    pub(crate) connect_timeout: Duration,
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

impl Config {
    /// The silence between a reply and the next request, and the settings by which proofs are sent.
    pub(crate) fn request_times(&self) -> (Duration, InStepSettings) {
        (self.frame_gap.short, self.in_step)
    }
}

/// The settings in use in a pool. Its links have few different ones, and thousands of copies would take
/// as much memory as the rest of their state.
#[derive(Debug, Default)]
pub(crate) struct SharedConfigs {
    configs: Mutex<Vec<Weak<Config>>>,
}

/// Maximum number of different settings that are shared.
const MAX_SHARED: usize = 16;

impl SharedConfigs {
    pub(super) fn share(&self, config: Config) -> Arc<Config> {
        let mut configs = self.configs.lock().unwrap_or_else(PoisonError::into_inner);
        configs.retain(|shared| shared.strong_count() > 0);
        if let Some(shared) = configs.iter().filter_map(Weak::upgrade).find(|shared| **shared == config) {
            return shared;
        }
        let config = Arc::new(config);
        if configs.len() < MAX_SHARED {
            configs.push(Arc::downgrade(&config));
        }
        config
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::link::{Connector, LinkBuilder};

    #[test]
    fn equal_settings_are_shared_while_in_use_and_others_are_not() {
        let config = |queue_capacity| {
            let config = LinkBuilder::with_connector(Connector::Once(None), Framing::Ascii, "here").config;
            Config { queue_capacity, ..config }
        };
        let shared = SharedConfigs::default();
        let (first, second, other) = (shared.share(config(1)), shared.share(config(1)), shared.share(config(2)));
        assert!(Arc::ptr_eq(&first, &second) && !Arc::ptr_eq(&first, &other));
        assert_eq!(other.queue_capacity, 2);
        drop((first, second));
        let many: Vec<_> = (0..100).map(|capacity| shared.share(config(capacity))).collect();
        assert!(many.iter().enumerate().all(|(capacity, config)| config.queue_capacity == capacity));
        assert!(shared.configs.lock().unwrap().len() <= MAX_SHARED);
    }
}
