//! Subscriptions of the output, and the messages that they bring. No I/O.

use super::Shared;
use super::connection::Filter;

impl Shared {
    /// All subscriptions: for messages of an earlier run, the birth of Home Assistant, and commands.
    pub(super) fn subscriptions(&self) -> Vec<Filter> {
        let mut filters = self.earlier_run();
        filters.extend(
            self.discovery.as_ref().map(|discovery| Filter { path: discovery.status_topic(), as_published: false }),
        );
        // A command that is to be kept is refused, so its flag must be seen also when it is live.
        let commands = self.commands.as_ref().map(|_| Filter { path: self.topics.all_commands(), as_published: true });
        filters.extend(commands);
        filters
    }

    /// The retained messages of the bridge that name PLCs and tags.
    pub(super) fn earlier_run(&self) -> Vec<Filter> {
        let states = Filter { path: self.topics.all_states(), as_published: false };
        let discovery =
            self.discovery.as_ref().map(|discovery| Filter { path: discovery.filter(), as_published: false });
        std::iter::once(states).chain(discovery).collect()
    }

    pub(super) fn is_own_retained(&self, topic: &str) -> bool {
        self.topics.plc_of_state(topic).is_some()
            || self.discovery.as_ref().is_some_and(|discovery| discovery.is_own(topic))
    }

    /// Returns whether Home Assistant has just started. A retained birth may be old, and everything was just sent.
    pub(super) fn is_birth_of_home_assistant(&self, topic: &str, payload: &[u8], retain: bool) -> bool {
        let is_status =
            |topic: &str| self.discovery.as_ref().is_some_and(|discovery| discovery.status_topic() == topic);
        !retain && payload == b"online" && is_status(topic)
    }
}
