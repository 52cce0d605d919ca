//! Names of topics: levels are separated by slashes in MQTT, and by dots in NATS.
//!
//! | levels | what |
//! |---|---|
//! | `PREFIX BRIDGE state` | whether the bridge runs; without a fleet |
//! | `PREFIX FLEET members MEMBER state` | whether a member of a fleet runs |
//! | `PREFIX BRIDGE PLC state` | whether the PLC answers |
//! | `PREFIX BRIDGE PLC data` | batches |
//! | `PREFIX BRIDGE PLC cmd` | commands |
//! | `PREFIX BRIDGE PLC cmd reply` | results of commands that name no other topic |
//!
//! In a fleet, the name of the fleet is in the place of that of the bridge: a PLC has the same topics, whichever
//! member polls it.

use crate::config::Name;

/// The topics of a bridge at one output.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topics {
    base: String,
    separator: char,
    /// The id of the member of a fleet.
    member: Option<Name>,
}

impl Topics {
    /// Topics of MQTT.
    #[must_use]
    pub fn mqtt(prefix: &Name, bridge: &Name) -> Self {
        Self { base: format!("{prefix}/{bridge}"), separator: '/', member: None }
    }

    /// Subjects of NATS.
    #[must_use]
    pub fn nats(prefix: &Name, bridge: &Name) -> Self {
        Self { base: format!("{prefix}.{bridge}"), separator: '.', member: None }
    }

    /// The same topics for a member of a fleet, whose state has a topic of its own.
    #[must_use]
    pub fn with_member(self, member: Option<Name>) -> Self {
        Self { member, ..self }
    }

    /// Returns whether these are the topics of a fleet.
    #[must_use]
    pub fn is_fleet(&self) -> bool {
        self.member.is_some()
    }

    /// The levels that all topics of the bridge begin with.
    #[must_use]
    pub fn base(&self) -> &str {
        &self.base
    }

    /// The state of the bridge, or of this member of a fleet.
    #[must_use]
    pub fn bridge_state(&self) -> String {
        let Self { base, separator, member } = self;
        match member {
            None => format!("{base}{separator}state"),
            Some(member) => self.member_state(member.as_str()),
        }
    }

    /// The state of a member of the fleet.
    #[must_use]
    pub fn member_state(&self, member: &str) -> String {
        let Self { base, separator, member: _ } = self;
        format!("{base}{separator}members{separator}{member}{separator}state")
    }

    /// The state of a PLC.
    #[must_use]
    pub fn plc_state(&self, plc: &str) -> String {
        self.of_plc(plc, "state")
    }

    /// The batches of a PLC.
    #[must_use]
    pub fn data(&self, plc: &str) -> String {
        self.of_plc(plc, "data")
    }

    /// The commands for a PLC.
    #[must_use]
    pub fn commands(&self, plc: &str) -> String {
        self.of_plc(plc, "cmd")
    }

    /// The results of its commands that name no other topic.
    #[must_use]
    pub fn replies(&self, plc: &str) -> String {
        format!("{}{}reply", self.commands(plc), self.separator)
    }

    /// The filter of the commands for all PLCs: `+` in MQTT, `*` in NATS.
    #[must_use]
    pub fn all_commands(&self) -> String {
        self.of_plc(self.wildcard(), "cmd")
    }

    /// The filter of the batches of all PLCs.
    #[must_use]
    pub fn all_data(&self) -> String {
        self.of_plc(self.wildcard(), "data")
    }

    /// The filter of the states of all PLCs.
    #[must_use]
    pub fn all_states(&self) -> String {
        self.of_plc(self.wildcard(), "state")
    }

    /// The PLC of a topic of commands; `None`: it is not such a topic.
    #[must_use]
    pub fn plc_of_commands<'t>(&self, topic: &'t str) -> Option<&'t str> {
        self.plc_in(topic, "cmd")
    }

    /// The PLC of a topic of states; `None`: it is not such a topic.
    #[must_use]
    pub fn plc_of_state<'t>(&self, topic: &'t str) -> Option<&'t str> {
        self.plc_in(topic, "state")
    }

    fn plc_in<'t>(&self, topic: &'t str, last: &str) -> Option<&'t str> {
        let rest = topic.strip_prefix(self.base.as_str())?.strip_prefix(self.separator)?;
        let plc = rest.strip_suffix(last)?.strip_suffix(self.separator)?;
        (!plc.is_empty() && !plc.contains(self.separator)).then_some(plc)
    }

    fn wildcard(&self) -> &'static str {
        if self.separator == '/' { "+" } else { "*" }
    }

    fn of_plc(&self, plc: &str, last: &str) -> String {
        let Self { base, separator, member: _ } = self;
        format!("{base}{separator}{plc}{separator}{last}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topics_of_mqtt_and_nats_differ_in_the_separator_alone() {
        let (prefix, bridge) = (Name::constant("fatek"), Name::constant("hall-2"));
        let (mqtt, nats) = (Topics::mqtt(&prefix, &bridge), Topics::nats(&prefix, &bridge));
        assert_eq!(mqtt.bridge_state(), "fatek/hall-2/state");
        assert_eq!(
            (mqtt.data("mixer"), nats.data("mixer")),
            ("fatek/hall-2/mixer/data".into(), "fatek.hall-2.mixer.data".into())
        );
        assert_eq!(
            (mqtt.all_commands(), nats.all_commands()),
            ("fatek/hall-2/+/cmd".into(), "fatek.hall-2.*.cmd".into())
        );
        assert_eq!(nats.replies("mixer"), "fatek.hall-2.mixer.cmd.reply");
        assert_eq!(mqtt.plc_of_commands("fatek/hall-2/mixer/cmd"), Some("mixer"));
        assert_eq!(nats.plc_of_state("fatek.hall-2.mixer.state"), Some("mixer"));
        let member = mqtt.clone().with_member(Some(Name::constant("pc-1")));
        assert_eq!(member.bridge_state(), "fatek/hall-2/members/pc-1/state");
        assert_eq!((member.is_fleet(), member.data("mixer")), (true, mqtt.data("mixer")));
        // A PLC of the name `members` has other topics than any member.
        assert_eq!(
            (mqtt.plc_of_state(&member.bridge_state()), mqtt.plc_state("members").as_str()),
            (None, "fatek/hall-2/members/state")
        );
        assert_eq!((mqtt.plc_of_state("fatek/hall-2/state"), mqtt.plc_of_state("fatek/hall-2/a/cmd")), (None, None));
        for other in [
            "fatek/hall-2/mixer/data",
            "fatek/hall-2//cmd",
            "fatek/hall-2/a/b/cmd",
            "fatek/hall-20/mixer/cmd",
            "cmd",
            "",
        ] {
            assert_eq!(mqtt.plc_of_commands(other), None, "{other}");
        }
    }
}
