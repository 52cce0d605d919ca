//! Rules of a plant that a fleet shares: each PLC has one link, and each link one owner.

use std::collections::{BTreeMap, BTreeSet};

use fatek::endpoint::Transport;
use fatek::plant::{Plant, PlantPlc};

use super::error::ConfigFault;
use super::source::Source;
use super::values::{NAME_RULE, Name};
use crate::fleet::{PlantLinks, hosts, is_serial};

/// Adds the faults of a plant in a fleet.
pub(super) fn check(plant: &Plant, source: &Source<'_>, faults: &mut Vec<ConfigFault>) {
    let first_of_each = first_of_each(plant);
    for plc in &first_of_each {
        if hosts(plc).into_iter().any(|host| Name::parse(host).is_none()) {
            faults.push(fault(plc, NAME_RULE, source));
        }
        if is_serial(plc) && hosts(plc).len() != 1 {
            faults.push(fault(plc, "a serial port has one host: in a fleet, `host` names the member", source));
        }
    }
    addresses(&first_of_each, source, faults);
    names(plant, source, faults);
}

/// Adds the faults of a plant without a fleet: this bridge has all serial ports, so a name is that of one port.
pub(super) fn check_without(plant: &Plant, source: &Source<'_>, faults: &mut Vec<ConfigFault>) {
    let mut first: BTreeMap<&str, &PlantPlc> = BTreeMap::new();
    for plc in first_of_each(plant) {
        let Transport::Serial { path, .. } = plc.endpoint().transport() else { continue };
        let other = *first.entry(path).or_insert(plc);
        if hosts(other) != hosts(plc) {
            let rule = format!("{} has this port on another host: that needs the section fleet", section(other).1);
            faults.push(fault(plc, &rule, source));
        }
    }
}

/// The first PLC of each section: a bus has one `host` or `only` for all its PLCs.
fn first_of_each(plant: &Plant) -> Vec<&PlantPlc> {
    let mut seen: BTreeSet<(&str, &str)> = BTreeSet::new();
    plant.plcs().filter(|plc| seen.insert(section(plc))).collect()
}

/// The section of a PLC, and its name.
fn section(plc: &PlantPlc) -> (&'static str, &str) {
    plc.bus().map_or_else(|| ("plc", plc.name()), |bus| ("bus", bus))
}

/// A fault of the hosts of a PLC, or of its bus.
fn fault(plc: &PlantPlc, rule: &str, source: &Source<'_>) -> ConfigFault {
    let (section, name) = section(plc);
    let key = match source.has_key(&[section, name, "only"]) {
        true => "only",
        false => "host",
    };
    source.fault(&[section, name, key], rule)
}

/// PLCs of one address have one owner: they have one link, with the same hosts. Serial ports of different hosts are
/// different ports.
fn addresses(plcs: &[&PlantPlc], source: &Source<'_>, faults: &mut Vec<ConfigFault>) {
    let mut first: BTreeMap<String, &PlantPlc> = BTreeMap::new();
    for plc in plcs {
        let link = plc.endpoint().to_string();
        let address = link.split('?').next().unwrap_or_default();
        let key = if is_serial(plc) { format!("{} {address}", hosts(plc).join(" ")) } else { address.to_owned() };
        let Some(other) = first.get(&key) else {
            first.insert(key, plc);
            continue;
        };
        let other_name = section(other).1;
        if other.endpoint() != plc.endpoint() {
            let (section, name) = section(plc);
            let rule = format!("{other_name} has this address with other options: in a fleet, they have one link");
            faults.push(source.fault(&[section, name, "link"], rule));
        } else if hosts(other) != hosts(plc) {
            let rule = format!("{other_name} has this link with other hosts: a link has one owner");
            faults.push(fault(plc, &rule, source));
        }
    }
}

/// A bus can have the name of a PLC: then an operator would move the wrong link.
fn names(plant: &Plant, source: &Source<'_>, faults: &mut Vec<ConfigFault>) {
    let links = PlantLinks::of(plant);
    let mut names: BTreeSet<&str> = BTreeSet::new();
    for name in links.specs().iter().map(|link| links.name_of(&link.id)).filter(|name| !names.insert(name)) {
        let rule = "a PLC of another link has this name: in a fleet, a link has the name of its bus or its PLC";
        faults.push(source.fault(&["bus", name], rule));
    }
}
