//! The links, the member and the hash of a configuration.
//!
//! A link is one address: all PLCs behind it have the same owner. Its id is made of the address, so that members with
//! different configurations mean the same PLCs by it: with another name, a PLC would get a second master. For people,
//! it has the name of its bus, or of its PLC; of several, the first one, so that the order in a file decides nothing.
//! A serial port is another one on each host.

use std::collections::{BTreeMap, HashMap};
use std::sync::Arc;

use fatek::Endpoint;
use fatek::plant::{Plant, PlantClass, PlantPlc, PlantTag};
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

use super::{LinkSpec, Member, Reach};
use crate::config::Config;

/// The characters of an address in the id of a link.
const MAX_SHOWN: usize = 48;
/// The number of bytes of the hash in the id of a link.
const LINK_HASH_BYTES: usize = 6;
/// The number of bytes of a hash of a configuration. No one chooses them: 128 bits suffice.
const HASH_BYTES: usize = 16;

/// The links of a plant, and the one of each PLC.
#[derive(Clone, Debug, Default)]
pub struct PlantLinks {
    links: Vec<LinkSpec>,
    of_plc: HashMap<Arc<str>, Arc<str>>,
    names: HashMap<Arc<str>, Arc<str>>,
    plcs: HashMap<Arc<str>, Vec<Arc<str>>>,
}

impl PlantLinks {
    /// The links of a plant that obeys the rules of a fleet.
    #[must_use]
    pub fn of(plant: &Plant) -> Self {
        let mut groups: BTreeMap<String, Vec<&PlantPlc>> = BTreeMap::new();
        for plc in plant.plcs() {
            groups.entry(link_id(plc.endpoint(), hosts(plc).first().copied())).or_default().push(plc);
        }
        let mut found = Self::default();
        for (id, plcs) in groups {
            let Some((name, first)) = name_of(&plcs).zip(plcs.first()) else { continue };
            let id: Arc<str> = id.into();
            found.names.insert(id.clone(), name.into());
            found.links.push(LinkSpec { id: id.clone(), reach: reach(first) });
            let names: Vec<Arc<str>> = plcs.iter().map(|plc| plc.name().into()).collect();
            found.of_plc.extend(names.iter().map(|name| (name.clone(), id.clone())));
            found.plcs.insert(id, names);
        }
        found.links.sort_by(|left, right| left.id.cmp(&right.id));
        found
    }

    /// The links, in the order of their ids.
    #[must_use]
    pub fn specs(&self) -> &[LinkSpec] {
        &self.links
    }

    /// The name of a link for people: that of its bus, or of its first PLC. The id of one that the plant does not have.
    #[must_use]
    pub fn name_of<'a>(&'a self, id: &'a str) -> &'a str {
        self.names.get(id).map_or(id, |name| name)
    }

    /// The link of this name: that of a bus or of a PLC, or its id.
    #[must_use]
    pub fn find(&self, name: &str) -> Option<&LinkSpec> {
        let of_bus = self.names.iter().find(|(_, known)| ***known == *name).map(|(id, _)| id);
        let id = of_bus.or_else(|| self.link_of(name)).map_or(name, |id| id);
        self.links.iter().find(|link| *link.id == *id)
    }

    /// The PLCs of a link; none of one that the plant does not have.
    #[must_use]
    pub fn plcs_of(&self, link: &str) -> &[Arc<str>] {
        self.plcs.get(link).map_or(&[], Vec::as_slice)
    }

    /// The id of the link of a PLC; `None` without such a PLC.
    #[must_use]
    pub fn link_of(&self, plc: &str) -> Option<&Arc<str>> {
        self.of_plc.get(plc)
    }
}

/// The links of a plant, in the order of their ids.
#[must_use]
pub fn links(plant: &Plant) -> Vec<LinkSpec> {
    PlantLinks::of(plant).links
}

/// The id of the link of a PLC; `None` without such a PLC. For many PLCs, [`PlantLinks`] is faster.
#[must_use]
pub fn link_of(plant: &Plant, plc: &str) -> Option<Arc<str>> {
    PlantLinks::of(plant).link_of(plc).cloned()
}

/// The member that a configuration makes of this process.
#[must_use]
pub fn member(config: &Config) -> Member {
    Member {
        id: config.bridge.id.as_str().into(),
        version: env!("CARGO_PKG_VERSION").to_owned(),
        config: config_hash(config),
        weight: config.fleet.as_ref().map_or(1, |fleet| fleet.weight),
    }
}

/// The hash of the part of a configuration that members have in common: the plant and the id of the fleet, in
/// hexadecimal digits. It is the same on all machines, and for another order of the sections and keys.
///
/// Sections of one member are not in it: `bridge`, servers, weight and lease.
#[must_use]
pub fn config_hash(config: &Config) -> String {
    let fleet = config.fleet.as_ref().map(|fleet| fleet.id.as_str());
    let mut classes: Vec<&PlantClass> = config.plant.classes().collect();
    classes.sort_by_key(|class| class.name());
    let mut plcs: Vec<&PlantPlc> = config.plant.plcs().collect();
    plcs.sort_by_key(|plc| plc.name());
    let classes: Vec<Value> = classes.into_iter().map(class_content).collect();
    let plcs: Vec<Value> = plcs.into_iter().map(plc_content).collect();
    // Arrays in a fixed order: no two contents have one text.
    let digest = Sha256::digest(json!([fleet, classes, plcs]).to_string());
    digest.iter().take(HASH_BYTES).map(|byte| format!("{byte:02x}")).collect()
}

fn class_content(class: &PlantClass) -> Value {
    let stale_after = class.stale_after().map(|age| age.as_nanos().to_string());
    json!([class.name(), class.every().as_nanos().to_string(), stale_after])
}

fn plc_content(plc: &PlantPlc) -> Value {
    let mut tags: Vec<&PlantTag> = plc.tags().collect();
    tags.sort_by_key(|tag| tag.name());
    let tags: Vec<Value> = tags.into_iter().map(tag_content).collect();
    json!([plc.name(), plc.endpoint().to_string(), plc.station(), plc.bus(), hosts(plc), tags])
}

fn tag_content(tag: &PlantTag) -> Value {
    let bits = |number: f64| format!("{:016x}", number.to_bits());
    let write = tag.write().map(|rule| {
        let pulse = rule.pulse.map(|pulse| pulse.as_nanos().to_string());
        json!([rule.min.map(bits), rule.max.map(bits), pulse])
    });
    let heartbeat = tag.heartbeat().map(|time| time.as_nanos().to_string());
    let texts = [tag.class(), tag.unit(), tag.comment(), tag.group()];
    json!([tag.name(), tag.tag().to_string(), texts, tag.deadband().map(bits), heartbeat, tag.is_on_change(), write])
}

/// The hosts of a PLC, each once, in the order of their names.
pub(crate) fn hosts(plc: &PlantPlc) -> Vec<&str> {
    let mut hosts: Vec<&str> = plc.hosts().collect();
    hosts.sort_unstable();
    hosts.dedup();
    hosts
}

/// Returns whether the link of a PLC is a serial port, which one host has.
pub(crate) fn is_serial(plc: &PlantPlc) -> bool {
    plc.endpoint().transport().serial_settings().is_some()
}

/// The id of the link of an endpoint: its address, and for a serial port the host that has it. Transport and options
/// such as the framing are not in it. It is a key of the store, of the characters `A-Z a-z 0-9 _ -`: addresses have
/// others, so a hash tells those apart that look alike.
#[must_use]
pub fn link_id(endpoint: &Endpoint, host: Option<&str>) -> String {
    let text = endpoint.to_string();
    let address = text.split('?').next().unwrap_or_default();
    let address = match endpoint.transport().serial_settings() {
        // Names of files tell capitals apart, names of hosts do not.
        Some(_) => format!("{address}@{}", host.unwrap_or_default()),
        // A PLC that is reached by TCP and UDP is one.
        None => address.split_once("://").map_or(address, |(_, rest)| rest).to_ascii_lowercase(),
    };
    let shown: String = address.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect();
    let hash: String =
        Sha256::digest(&address).iter().take(LINK_HASH_BYTES).map(|byte| format!("{byte:02x}")).collect();
    let shown: String = shown.replace("___", "_").chars().take(MAX_SHOWN).collect();
    format!("{shown}-{hash}")
}

/// The name of the link of these PLCs.
fn name_of<'p>(plcs: &[&'p PlantPlc]) -> Option<&'p str> {
    let bus = plcs.iter().filter_map(|plc| plc.bus()).min();
    bus.or_else(|| plcs.iter().map(|plc| plc.name()).min())
}

fn reach(plc: &PlantPlc) -> Reach {
    match hosts(plc).as_slice() {
        [] => Reach::All,
        [host] if is_serial(plc) => Reach::Pinned((*host).into()),
        hosts => Reach::Only(hosts.iter().map(|host| (*host).into()).collect()),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::config::Environment;

    const PLANT: &str = "\
        [fleet]\nid = 'plant-a'\n[nats]\nurl = 'nats://h'\n\
        [class]\nfast = { every = '500ms' }\nslow = { every = '10s', stale_after = '1m' }\n\
        [plc.mixer]\nlink = 'tcp://10.0.0.3'\nstation = 1\n\
        tag.level = { at = 'R5:i16*0.1-40', class = 'fast', deadband = 0.2, write = { min = 0, max = 80.5 } }\n\
        tag.start = { at = 'M1', write = { pulse = '500ms' } }\n\
        [plc.gate2]\nlink = 'tcp://10.0.0.9'\nstation = 2\nonly = ['hall-3', 'hall-2']\n\
        [plc.gate1]\nlink = 'tcp://10.0.0.9:500'\nstation = 1\nonly = ['hall-2', 'hall-3']\n\
        [bus.line1]\nlink = 'serial:/dev/ttyUSB0'\nstations = { pump1 = 1, pump2 = 2 }\nhost = 'hall-1'\n\
        [bus.line2]\nlink = 'serial:/dev/ttyUSB0'\nstations = { pump3 = 1 }\nhost = 'hall-2'\n\
        [bus.line3]\nlink = 'tcp://10.0.0.8'\nstations = { a = 1, b = 2 }\n";

    fn config(text: &str) -> Config {
        Config::from_text(Path::new("plant.toml"), text, &Environment::default()).unwrap()
    }

    #[test]
    fn each_endpoint_is_a_link_with_its_reach() {
        let plant = config(PLANT).plant;
        let found = PlantLinks::of(&plant);
        let spec = |name: &str, reach| (name.to_owned(), reach);
        let both = Reach::Only(vec!["hall-2".into(), "hall-3".into()]);
        let expected = [
            spec("gate1", both),
            spec("line1", Reach::Pinned("hall-1".into())),
            spec("line2", Reach::Pinned("hall-2".into())),
            spec("line3", Reach::All),
            spec("mixer", Reach::All),
        ];
        let mut named: Vec<(String, Reach)> =
            links(&plant).into_iter().map(|link| (found.name_of(&link.id).to_owned(), link.reach)).collect();
        named.sort_by(|left, right| left.0.cmp(&right.0));
        assert_eq!(named, expected);
        for (plc, link) in
            [("mixer", "mixer"), ("gate2", "gate1"), ("gate1", "gate1"), ("pump2", "line1"), ("pump3", "line2")]
        {
            let id = &found.find(link).unwrap().id;
            assert_eq!((found.link_of(plc), link_of(&plant, plc).as_ref()), (Some(id), Some(id)), "{plc}");
            assert!(found.plcs_of(id).iter().any(|name| **name == *plc), "{plc}");
            assert_eq!((&found.find(plc).unwrap().id, &found.find(id).unwrap().id), (id, id));
        }
        assert_eq!(found.link_of("line1"), None);
        assert_eq!((found.plcs_of(found.link_of("gate2").unwrap()).len(), found.plcs_of("gate2").len()), (2, 0));
    }

    /// While links had the names of their PLCs, a renamed PLC had two masters until the last reload.
    #[test]
    fn a_link_is_known_by_its_address_alone() {
        let id = |text: &str, host: Option<&str>| link_id(&text.parse().unwrap(), host);
        let first = id("tcp://10.0.0.5", None);
        assert_eq!(first, "10_0_0_5_500-40dd7b27f0d4");
        for same in ["tcp://10.0.0.5:500", "tcp://10.0.0.5:500?framing=binary", "udp://10.0.0.5:500"] {
            assert_eq!(id(same, Some("hall-1")), first, "{same}");
        }
        assert_eq!(id("tcp://PLC-7.local", None), id("tcp://plc-7.local", None));
        let port = id("serial:/dev/ttyUSB0?baud=9600", Some("hall-1"));
        assert_eq!(port, id("serial:/dev/ttyUSB0?baud=19200", Some("hall-1")));
        let all = [
            first,
            port,
            id("serial:/dev/ttyUSB0", Some("hall-2")),
            id("serial:/dev/ttyusb0", Some("hall-1")),
            id("tcp://10.0.0.5:501", None),
            id("tcp://10-0.0.5", None),
        ];
        let different: std::collections::BTreeSet<&String> = all.iter().collect();
        assert_eq!(different.len(), all.len(), "{all:?}");
        assert!(all.iter().all(|id| id.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-')), "{all:?}");
        let names = |name: &str| {
            let plant = config(&PLANT.replace("plc.mixer", name)).plant;
            PlantLinks::of(&plant).specs().iter().map(|link| link.id.clone()).collect::<Vec<_>>()
        };
        assert_eq!(names("plc.mixer"), names("plc.kettle"));
    }

    /// Members of different versions compare it, so its algorithm must not change without need.
    #[test]
    fn the_hash_is_the_same_on_all_machines() {
        assert_eq!(config_hash(&config(PLANT)), "e92405a7cf318d72ad5a653ddd23cc3f");
    }

    #[test]
    fn the_hash_is_of_the_plant_and_the_fleet_alone() {
        let hash = |text: &str| config_hash(&config(text));
        let first = hash(PLANT);
        let (fleet, plant) = PLANT.split_at(PLANT.find("[class]").unwrap());
        for same in [
            format!("# comment\n\n{PLANT}"),
            format!("{PLANT}[bridge]\nid = 'x'\nhttp = '0.0.0.0:80'\n[stdout]\n[mqtt]\nurl = 'mqtt://h'\n"),
            PLANT.replace("id = 'plant-a'", "id = 'plant-a'\nweight = 7\nlease = '5s'"),
            PLANT.replace("nats://h", "nats://other"),
            format!("{plant}{fleet}"),
            PLANT
                .replace("fast = { every = '500ms' }\n", "")
                .replace("'1m' }\n", "'1m' }\nfast = { every = '0.5s' }\n"),
            PLANT.replace("['hall-3', 'hall-2']", "['hall-2', 'hall-3']"),
        ] {
            assert_eq!(hash(&same), first, "{same}");
        }
        let mut others = std::collections::BTreeSet::from([first.clone()]);
        let changes = [
            ("plant-a", "plant-b"),
            ("'500ms' }\nslow", "'501ms' }\nslow"),
            ("'1m'", "'2m'"),
            (", stale_after = '1m'", ""),
            ("10.0.0.3", "10.0.0.4"),
            ("'tcp://10.0.0.3'\nstation = 1", "'tcp://10.0.0.3'\nstation = 2"),
            ("tag.level", "tag.height"),
            ("R5:i16*0.1-40", "R5:i16*0.1-41"),
            ("class = 'fast'", "class = 'slow'"),
            ("deadband = 0.2", "deadband = 0.3"),
            ("deadband = 0.2", "heartbeat = '3s'"),
            ("deadband = 0.2", "on_change = true"),
            ("deadband = 0.2", "unit = 'x'"),
            ("deadband = 0.2", "comment = 'x'"),
            ("deadband = 0.2", "group = 'x'"),
            ("max = 80.5", "max = 80.6"),
            ("min = 0, ", ""),
            ("pulse = '500ms'", "pulse = '600ms'"),
            ("write = { pulse = '500ms' }", "write = {}"),
            (", write = { pulse = '500ms' }", ""),
            ("host = 'hall-1'", "host = 'hall-4'"),
            ("bus.line1", "bus.line9"),
            ("pump2 = 2", "pump2 = 3"),
        ];
        for (from, to) in changes {
            let text = PLANT.replacen(from, to, 1);
            assert_ne!(text, PLANT, "{from}");
            assert!(others.insert(hash(&text)), "{from} -> {to} has the hash of another configuration");
        }
    }

    #[test]
    fn the_member_has_the_name_of_the_bridge_and_its_weight() {
        let text = format!("{}[bridge]\nid = 'hall-2'\n", PLANT.replace("[nats]", "weight = 3\n[nats]"));
        let config = config(&text);
        let expected = Member {
            id: "hall-2".into(),
            version: env!("CARGO_PKG_VERSION").to_owned(),
            config: config_hash(&config),
            weight: 3,
        };
        assert_eq!(member(&config), expected);
    }
}
