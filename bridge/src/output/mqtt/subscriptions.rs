//! Subscriptions of the output, and the messages that they bring. No I/O.

use super::Shared;
use super::connection::Filter;
use super::discovery::Discovery;
use crate::topic::Topics;

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

    /// The retained messages of the bridge that name PLCs and tags, also those under the names before a reload.
    pub(super) fn earlier_run(&self) -> Vec<Filter> {
        let mut filters: Vec<Filter> = Vec::new();
        for (topics, discovery) in self.all_names() {
            for path in std::iter::once(topics.all_states()).chain(discovery.map(Discovery::filter)) {
                if filters.iter().all(|filter| filter.path != path) {
                    filters.push(Filter { path, as_published: false });
                }
            }
        }
        filters
    }

    pub(super) fn is_own_retained(&self, topic: &str) -> bool {
        self.all_names().any(|(topics, discovery)| {
            topics.plc_of_state(topic).is_some() || discovery.is_some_and(|discovery| discovery.is_own(topic))
        })
    }

    fn all_names(&self) -> impl Iterator<Item = (&Topics, Option<&Discovery>)> {
        let former = self.former.as_ref().map(|(topics, discovery)| (topics, discovery.as_ref()));
        std::iter::once((&self.topics, self.discovery.as_ref())).chain(former)
    }

    /// Returns whether Home Assistant has just started. A retained birth may be old, and everything was just sent.
    pub(super) fn is_birth_of_home_assistant(&self, topic: &str, payload: &[u8], retain: bool) -> bool {
        let is_status =
            |topic: &str| self.discovery.as_ref().is_some_and(|discovery| discovery.status_topic() == topic);
        !retain && payload == b"online" && is_status(topic)
    }
}
