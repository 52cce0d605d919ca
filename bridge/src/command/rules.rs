//! The rules of writes: what the configuration allows. No I/O, no clock.
//!
//! They are checked when a command arrives, and again just before it is sent, since the configuration can
//! change and time passes while it waits.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use fatek::plant::{LimitError, Plant, PlantPlc, PlantTag, WriteRule};
use fatek::tag::{Tag, TagValue};
use serde::de::DeserializeSeed as _;

use super::reply::Refusal;
use super::request::Request;
use crate::registry::Plcs;

/// The largest age of a command.
pub(super) const MAX_AGE: Duration = Duration::from_secs(10);
/// The largest time that its `ts` is ahead of the clock of the bridge.
pub(super) const MAX_AHEAD: Duration = Duration::from_secs(5);
/// The same in a fleet.
const MAX_AHEAD_IN_FLEET: Duration = Duration::from_secs(1);
/// The time after the begin of an ownership in which the `ts` of a command may be one that the owner before has
/// executed: it can be ahead of the clock of that member, and that ahead of this one's.
const DOUBTFUL: Duration = Duration::from_secs(2);

/// The PLCs of the configuration that applies now.
pub(super) trait Catalog {
    /// The PLC of this name.
    fn plc(&self, name: &str) -> Option<&PlantPlc>;

    /// In a fleet: when this member has got the PLC, in milliseconds since 1970; `None`: no other member can have it.
    fn owned_since(&self, plc: &str) -> Option<u64>;
}

impl Catalog for Plcs {
    fn plc(&self, name: &str) -> Option<&PlantPlc> {
        self.get(name).map(|polled| &polled.plc)
    }

    fn owned_since(&self, plc: &str) -> Option<u64> {
        self.get(plc).filter(|polled| polled.revision != 0).map(|polled| polled.since)
    }
}

impl Catalog for Plant {
    fn plc(&self, name: &str) -> Option<&PlantPlc> {
        Self::plc(self, name)
    }

    fn owned_since(&self, _: &str) -> Option<u64> {
        None
    }
}

/// Lets the commands of an output through, or refuses them: by the `write` of its section, which a reload changes.
/// Cheap to clone.
#[derive(Clone, Debug)]
pub(super) struct Gate(Arc<AtomicBool>);

impl Gate {
    pub(super) fn new(is_open: bool) -> Self {
        Self(Arc::new(AtomicBool::new(is_open)))
    }

    pub(super) fn set_open(&self, is_open: bool) {
        self.0.store(is_open, Ordering::Release);
    }

    pub(super) fn check(&self) -> Result<(), Refusal> {
        if self.0.load(Ordering::Acquire) { Ok(()) } else { Err(Refusal::OutputNotWritable) }
    }
}

/// A write that the configuration allows.
#[derive(Clone, Debug)]
pub(super) struct Plan {
    pub(super) plc: Arc<str>,
    /// The name of the tag.
    pub(super) name: Arc<str>,
    pub(super) tag: Tag,
    /// The values, which the tag takes.
    pub(super) values: Vec<TagValue>,
    /// The time of a pulse.
    pub(super) pulse: Option<Duration>,
    /// The output that it came from.
    gate: Gate,
    /// The `ts` of the command.
    ts: u64,
}

/// Checks a command against all rules that do not depend on other commands. `now`: milliseconds since 1970.
pub(super) fn check(
    request: &Request,
    plc: &str,
    gate: &Gate,
    catalog: &dyn Catalog,
    now: u64,
) -> Result<Plan, Refusal> {
    gate.check()?;
    let (plc, tag, rule) = writable(plc, &request.tag, catalog)?;
    let owned_since = catalog.owned_since(plc.name());
    if rule.pulse.is_some() && owned_since.is_some() {
        return Err(Refusal::PulseInFleet);
    }
    let at = tag.tag();
    let values = at.values_seed().deserialize(&request.value).map_err(|error| Refusal::Value(error.to_string()))?;
    let (plc, name) = (plc.name().into(), tag.name().into());
    let plan = Plan { plc, name, tag: at, values, pulse: rule.pulse, gate: gate.clone(), ts: request.ts };
    plan.check_values(&rule)?;
    plan.check_time(now, owned_since)?;
    Ok(plan)
}

/// The PLC and the tag of these names, if the tag may be written.
fn writable<'c>(
    plc: &str,
    tag: &str,
    catalog: &'c dyn Catalog,
) -> Result<(&'c PlantPlc, &'c PlantTag, WriteRule), Refusal> {
    let plc = catalog.plc(plc).ok_or(Refusal::NoPlc)?;
    let unknown = || Refusal::NoTag(tag.chars().take(64).collect());
    let tag = plc.tag(tag).ok_or_else(unknown)?;
    let rule = tag.write().ok_or(Refusal::NotWritable)?;
    Ok((plc, tag, rule))
}

impl Plan {
    /// Checks again what may have changed since [`check`].
    pub(super) fn check_again(&self, catalog: &dyn Catalog, now: u64) -> Result<(), Refusal> {
        self.gate.check()?;
        let (_, tag, rule) = writable(&self.plc, &self.name, catalog)?;
        if tag.tag() != self.tag || rule.pulse != self.pulse {
            return Err(Refusal::Changed);
        }
        self.check_values(&rule)?;
        self.check_time(now, catalog.owned_since(&self.plc))
    }

    /// The time until it is too old.
    pub(super) fn valid_for(&self, now: u64) -> Duration {
        MAX_AGE.saturating_sub(Duration::from_millis(now.saturating_sub(self.ts)))
    }

    fn check_time(&self, now: u64, owned_since: Option<u64>) -> Result<(), Refusal> {
        let max_ahead = if owned_since.is_some() { MAX_AHEAD_IN_FLEET } else { MAX_AHEAD };
        let millis = |time: Duration| u64::try_from(time.as_millis()).unwrap_or(u64::MAX);
        let (age, ahead) = (now.saturating_sub(self.ts), self.ts.saturating_sub(now));
        if age > millis(MAX_AGE) {
            return Err(Refusal::Old { age: age.div_ceil(1000), max: MAX_AGE.as_secs() });
        }
        if ahead > millis(max_ahead) {
            return Err(Refusal::Future { ahead: ahead.div_ceil(1000), max: max_ahead.as_secs() });
        }
        match owned_since {
            Some(since) if self.ts <= since.saturating_add(millis(DOUBTFUL)) => Err(Refusal::FormerOwner),
            Some(_) | None => Ok(()),
        }
    }

    fn check_values(&self, rule: &WriteRule) -> Result<(), Refusal> {
        if rule.pulse.is_some() {
            return if self.values == [TagValue::Bool(true)] { Ok(()) } else { Err(Refusal::PulseValue) };
        }
        let is_number = self.tag.tag_type().is_number();
        let is_finite = |value: &&TagValue| value.as_f64().is_some_and(f64::is_finite);
        if let Some(value) = self.values.iter().find(|value| is_number && !is_finite(value)) {
            return Err(Refusal::Value(format!("{value} is not a finite number")));
        }
        rule.check(&self.tag, &self.values).map_err(|error| {
            let range = |value: TagValue, side, limit| Refusal::Range { value: value.to_string(), side, limit };
            match error {
                LimitError::Below { value, min, .. } => range(value, "below", min),
                LimitError::Above { value, max, .. } => range(value, "above", max),
                other @ (LimitError::Value(_) | _) => Refusal::Value(other.to_string()),
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PLANT: &str = r#"
[plc.mixer]
link = "tcp://10.0.0.3"
station = 1
tag.setpoint = { at = "R200:f32", write = { min = 0.0, max = 80.0 } }
tag.scaled = { at = "R5:i16*0.1", write = { min = -5, max = 79.98 } }
tag.big = { at = "R10:u64", write = { max = 9007199254740992 } }
tag.list = { at = "R20-R22", write = { max = 9 } }
tag.free = { at = "R30:f32", write = {} }
tag.double = { at = "R34:f64", write = {} }
tag.digits = { at = "R40:bcd16", write = {} }
tag.hex = { at = "R41:hex", write = { max = 255 } }
tag.name = { at = "R50-R52:text", write = {} }
tag.valve = { at = "M5", write = {} }
tag.bit = { at = "R60.3", write = {} }
tag.start = { at = "M100", write = { pulse = "500ms" } }
tag.level = "R70:i16"
"#;

    fn result(tag: &str, value: &str, age: i64) -> Result<Vec<TagValue>, String> {
        let plant = Plant::from_toml(PLANT).unwrap();
        let now = 1_000_000_u64;
        let ts = now.checked_add_signed(-age).unwrap();
        let value = serde_json::from_str(value).unwrap();
        let request = Request { id: "1".into(), tag: tag.to_owned(), value, ts };
        let plan = check(&request, "mixer", &Gate::new(true), &plant, now).map_err(|refusal| refusal.to_string())?;
        assert_eq!(plan.check_again(&plant, now), Ok(()));
        Ok(plan.values)
    }

    #[test]
    fn values_keep_to_the_type_of_the_tag_and_to_its_limits() {
        for (tag, value) in [
            ("setpoint", "42.0"),
            ("setpoint", "42"),
            ("setpoint", "80.0"),
            ("setpoint", "\"7.5\""),
            ("scaled", "-4.99"),
            ("scaled", "79.9"),
            ("big", "9007199254740992"),
            ("list", "[1,2,9]"),
            ("free", "1e30"),
            ("digits", "9999"),
            ("hex", "\"0x00FF\""),
            ("name", "\"pump\""),
            ("valve", "true"),
            ("bit", "false"),
            ("start", "true"),
        ] {
            assert!(result(tag, value, 0).is_ok(), "{tag} = {value}: {:?}", result(tag, value, 0));
        }
        for (tag, value, why) in [
            ("setpoint", "80.01", "range: 80.01 is above 80"),
            ("setpoint", "-0.5", "range: -0.5 is below 0"),
            ("setpoint", "\"NaN\"", "value: NaN is not a finite number"),
            ("setpoint", "\"inf\"", "value: inf is not a finite number"),
            ("setpoint", "\"0x7F800000\"", "value: inf is not a finite number"),
            ("setpoint", "1e300", "value: "),
            ("setpoint", "16777217", "value: "),
            ("setpoint", "true", "value: "),
            ("setpoint", "null", "value: "),
            ("setpoint", "{}", "value: "),
            ("setpoint", "[1.0,2.0]", "value: "),
            // The nearest value of the PLC would be 80.0.
            ("scaled", "79.98", "range: 80.0 is above 79.98"),
            ("scaled", "\"NaN\"", "value: "),
            ("scaled", "1e9", "value: "),
            ("big", "9007199254740993", "range: 9007199254740993 is above 9007199254740992"),
            ("big", "-1", "value: "),
            ("list", "[1,2,10]", "range: 10 is above 9"),
            ("list", "[1,2]", "value: "),
            ("list", "[1,2,3,4]", "value: "),
            ("double", "\"-inf\"", "value: -inf is not a finite number"),
            ("digits", "10000", "value: "),
            ("digits", "\"0x00FA\"", "value: "),
            ("hex", "\"0x0100\"", "range: 0x0100 is above 255"),
            ("name", "\"a longer text\"", "value: "),
            ("name", "7", "value: "),
            ("valve", "1", "value: "),
            ("bit", "1", "value: "),
            ("start", "false", "pulse: "),
            ("level", "1", "write: the tag is not writable"),
            ("nothing", "1", "tag: the PLC has no tag `nothing`"),
            // A tag is written by its name alone.
            ("R0", "1", "tag: "),
        ] {
            let refused = result(tag, value, 0).expect_err(&format!("{tag} = {value}"));
            assert!(refused.starts_with(why), "{tag} = {value}: {refused}");
        }
    }

    #[test]
    fn old_commands_and_those_of_the_future_are_refused() {
        assert!(result("valve", "true", 10_000).is_ok() && result("valve", "true", -5_000).is_ok());
        assert_eq!(
            result("valve", "true", 10_001).unwrap_err(),
            "old: its ts is 11 s before the clock of the bridge, and 10 s are allowed"
        );
        assert!(result("valve", "true", -5_001).unwrap_err().starts_with("future: its ts is 6 s ahead"));
    }

    /// A PLC that this member of a fleet has got at a time.
    struct Owned(Plant, u64);

    impl Catalog for Owned {
        fn plc(&self, name: &str) -> Option<&PlantPlc> {
            self.0.plc(name)
        }

        fn owned_since(&self, _: &str) -> Option<u64> {
            Some(self.1)
        }
    }

    #[test]
    fn a_member_of_a_fleet_executes_no_command_that_the_owner_before_may_have() {
        let owned = Owned(Plant::from_toml(PLANT).unwrap(), 500_000);
        let result = |tag: &str, ts: u64, now: u64| {
            let request = Request { id: "1".into(), tag: tag.to_owned(), value: true.into(), ts };
            check(&request, "mixer", &Gate::new(true), &owned, now)
        };
        // An owner before has ended by 500,000. It takes a `ts` that is 1 s ahead, and its clock may be so, too.
        let plan = result("valve", 502_001, 502_500).unwrap();
        assert_eq!(result("valve", 502_000, 502_500).err(), Some(Refusal::FormerOwner));
        assert_eq!(result("valve", 499_999, 500_100).err(), Some(Refusal::FormerOwner));
        let future = result("valve", 503_501, 502_500).unwrap_err();
        assert_eq!(future.to_string(), "future: its ts is 2 s ahead of the clock of the bridge, and 1 s are allowed");
        // While it waited, the PLC had another owner.
        let again = Owned(owned.0.clone(), 501_400);
        assert_eq!(plan.check_again(&again, 502_500), Err(Refusal::FormerOwner));
        assert_eq!(plan.check_again(&owned, 502_500), Ok(()));
        assert_eq!(result("start", 502_400, 502_500).err(), Some(Refusal::PulseInFleet));
    }

    #[test]
    fn a_change_of_the_configuration_applies_to_commands_that_wait() {
        let plant = Plant::from_toml(PLANT).unwrap();
        let request = Request { id: "1".into(), tag: "setpoint".to_owned(), value: 70.into(), ts: 0 };
        let gate = Gate::new(true);
        let plan = check(&request, "mixer", &gate, &plant, 0).unwrap();
        let changed = |from: &str, to: &str| {
            let plant = Plant::from_toml(&PLANT.replace(from, to)).unwrap();
            plan.check_again(&plant, 0).unwrap_err().to_string()
        };
        assert_eq!(changed("80.0", "60.0"), "range: 70.0 is above 60");
        assert!(changed("R200", "R202").starts_with("changed: "));
        assert!(changed("plc.mixer", "plc.boiler").starts_with("plc: "));
        assert!(changed("tag.setpoint", "tag.other").starts_with("tag: "));
        assert!(changed(", write = { min = 0.0, max = 80.0 }", "").starts_with("write: "));
        assert_eq!(plan.check_again(&plant, 0), Ok(()));
        gate.set_open(false);
        assert_eq!(plan.check_again(&plant, 0), Err(Refusal::OutputNotWritable));
        gate.set_open(true);
        assert_eq!(plan.check_again(&plant, 0), Ok(()));
    }
}
