//! Parses the sections `class`, `template`, `plc` and `bus`.

use std::collections::HashMap;
use std::collections::hash_map::Entry;
use std::sync::Arc;
use std::time::Duration;

use toml::de::DeTable;

use super::section::{Faults, Field, Section};
use super::{Plant, PlantClass, PlantErrors, PlantFault, PlantPlc, PlantTag, WriteRule};
use crate::element::{Element, Width};
use crate::endpoint::Endpoint;
use crate::tag::{Tag, TagType};
use crate::tag_table::{TagEntry, TagTable};
use crate::transport::Transport;

const TAG_KEYS: &str = "at class unit comment group deadband heartbeat on_change write";
const PLC_KEYS: &str = "link station use tag tags host only";
const BUS_KEYS: &str = "link stations use host only";
const CLASS_KEYS: &str = "every stale_after";
const WRITE_KEYS: &str = "min max pulse";

/// Loads the table of tags of this name.
type LoadTable<'l> = &'l mut dyn FnMut(&str) -> Result<TagTable, PlantFault>;

struct Template {
    name: Arc<str>,
    tags: Vec<PlantTag>,
}

/// The values that sections of PLCs and of buses have.
struct LinkKeys {
    endpoint: Option<Endpoint>,
    hosts: Vec<String>,
    tags: Vec<PlantTag>,
}

pub(super) fn parse(text: &str, load: LoadTable<'_>) -> Result<Plant, PlantErrors> {
    let mut faults = Faults::of(text);
    let table = match DeTable::parse(text) {
        Ok(table) => table.into_inner(),
        Err(error) => {
            let line = error.span().map_or(1, |span| faults.line(&span));
            faults.push(line, "", PlantFault::Syntax { message: error.message().to_owned() });
            return Err(PlantErrors::new(faults.into_list()));
        }
    };
    let mut file = Section::new("", 1, &table);
    let mut plant = Plant::default();
    for (name, field) in sections("class", &mut file, &mut faults) {
        plant.classes.extend(class(name, &field, &mut faults));
    }
    let mut templates = Vec::new();
    for (name, field) in sections("template", &mut file, &mut faults) {
        if let Some(section) = field.table(&mut faults) {
            templates.push(Template { name: name.into(), tags: tags(&section, &plant, &mut faults) });
        }
    }
    let mut taken = Taken::default();
    for (name, field) in sections("plc", &mut file, &mut faults) {
        if let Some(plc) = plc(name, &field, (&plant, &templates), load, &mut faults) {
            add(&mut plant, &mut taken, plc, "plc", &mut faults);
        }
    }
    for (name, field) in sections("bus", &mut file, &mut faults) {
        for plc in bus(name, &field, (&plant, &templates), &mut faults) {
            add(&mut plant, &mut taken, plc, "bus", &mut faults);
        }
    }
    let faults = faults.into_list();
    if faults.is_empty() { Ok(plant) } else { Err(PlantErrors::new(faults)) }
}

/// The named tables of a section.
fn sections<'t>(key: &'static str, file: &mut Section<'t>, faults: &mut Faults) -> Vec<(&'t str, Field<'t>)> {
    let Some(section) = file.take(key, faults).and_then(|field| field.table(faults)) else { return Vec::new() };
    named(&section, faults)
}

/// The entries whose keys are names.
fn named<'t>(section: &Section<'t>, faults: &mut Faults) -> Vec<(&'t str, Field<'t>)> {
    let mut entries = section.entries(faults);
    entries.retain(|(name, field)| field.is_named(name, faults));
    entries
}

/// The numbers of the PLCs of a plant by what no two of them may share. A plant can have thousands.
#[derive(Default)]
struct Taken {
    names: HashMap<Arc<str>, usize>,
    /// Serial ports of several hosts can have one name.
    stations: HashMap<(Transport, u8), Vec<usize>>,
    lines: HashMap<Transport, Vec<usize>>,
}

/// Adds a PLC unless its name, or its link and station, is taken.
fn add(plant: &mut Plant, taken: &mut Taken, plc: PlantPlc, section: &str, faults: &mut Faults) {
    let transport = plc.endpoint.transport();
    let line = transport.is_one_line().then(|| transport.identity());
    let of = |numbers: Option<&Vec<usize>>, is_fault: &dyn Fn(&PlantPlc) -> bool| {
        let others = numbers.into_iter().flatten().filter_map(|&number| plant.plcs.get(number));
        let mut others = others.filter(|other| !are_ports_of_two_hosts(other, &plc));
        others.find(|other| is_fault(other)).map(|other| other.name.to_string())
    };
    let same = taken.names.get(&plc.name).and_then(|&number| plant.plcs.get(number));
    let same_station = of(taken.stations.get(&(transport.clone(), plc.station)), &|_| true);
    let same_line = line.as_ref().and_then(|line| taken.lines.get(line));
    let other_settings = of(same_line, &|other| other.endpoint != plc.endpoint);
    let fault = match (same, same_station, other_settings) {
        (Some(first), _, _) => PlantFault::DoubleName { name: plc.name.to_string(), first_line: first.line },
        (None, Some(other), _) => PlantFault::DoubleStation { other },
        (None, None, Some(other)) => PlantFault::OtherSettings { other },
        (None, None, None) => {
            let number = plant.plcs.len();
            taken.names.insert(plc.name.clone(), number);
            taken.stations.entry((transport.clone(), plc.station)).or_default().push(number);
            line.into_iter().for_each(|line| taken.lines.entry(line).or_default().push(number));
            return plant.plcs.push(plc);
        }
    };
    faults.push(plc.line, &format!("{section}.{}", plc.bus.as_ref().unwrap_or(&plc.name)), fault);
}

/// Returns whether both links are serial ports, and no host has both: then one name is that of two ports.
fn are_ports_of_two_hosts(one: &PlantPlc, other: &PlantPlc) -> bool {
    let are_lines = [one, other].iter().all(|plc| plc.endpoint.transport().is_one_line() && !plc.hosts.is_empty());
    are_lines && !one.hosts.iter().any(|host| other.hosts.contains(host))
}

fn class(name: &str, field: &Field<'_>, faults: &mut Faults) -> Option<PlantClass> {
    let mut section = field.table(faults)?;
    let every = section.require("every", faults).and_then(|field| {
        let every = field.time(faults)?;
        if every < Duration::from_millis(1) {
            field.fault(PlantFault::Period, faults);
        }
        Some(every)
    });
    let stale_after = section.take("stale_after", faults).and_then(|age| age.time(faults));
    section.finish(CLASS_KEYS, faults);
    Some(PlantClass { name: name.into(), every: every?, stale_after })
}

fn plc(
    name: &str,
    field: &Field<'_>,
    known: (&Plant, &[Template]),
    load: LoadTable<'_>,
    faults: &mut Faults,
) -> Option<PlantPlc> {
    let mut section = field.table(faults)?;
    let LinkKeys { endpoint, hosts, mut tags } = link_keys(&mut section, known, faults);
    let station = section.require("station", faults).and_then(|station| station.station(faults));
    if let Some(own) = section.take("tag", faults).and_then(|own| own.table(faults)) {
        add_tags(&mut tags, self::tags(&own, known.0, faults), own.path(), faults);
    }
    if let Some(table) = section.take("tags", faults) {
        let of_table = table_tags(&table, load, known.0, faults);
        add_tags(&mut tags, of_table, &format!("{}.tags", section.path()), faults);
    }
    let line = section.line();
    section.finish(PLC_KEYS, faults);
    Some(PlantPlc { name: name.into(), endpoint: endpoint?, station: station?, bus: None, hosts, tags, line })
}

fn bus(name: &str, field: &Field<'_>, known: (&Plant, &[Template]), faults: &mut Faults) -> Vec<PlantPlc> {
    let Some(mut section) = field.table(faults) else { return Vec::new() };
    let LinkKeys { endpoint, hosts, tags } = link_keys(&mut section, known, faults);
    let stations = section.require("stations", faults).and_then(|stations| stations.table(faults));
    section.finish(BUS_KEYS, faults);
    let mut plcs = Vec::new();
    for (plc, field) in stations.map(|stations| named(&stations, faults)).unwrap_or_default() {
        let (Some(station), Some(endpoint)) = (field.station(faults), endpoint.clone()) else { continue };
        let (bus, hosts, tags) = (Some(name.into()), hosts.clone(), tags.clone());
        plcs.push(PlantPlc { name: plc.into(), endpoint, station, bus, hosts, tags, line: field.line() });
    }
    plcs
}

fn link_keys(section: &mut Section<'_>, (_, templates): (&Plant, &[Template]), faults: &mut Faults) -> LinkKeys {
    let link = section.require("link", faults);
    let endpoint = link.and_then(|link| match link.text(faults)?.parse() {
        Ok(endpoint) => Some(endpoint),
        Err(error) => {
            link.fault(PlantFault::Endpoint(error), faults);
            None
        }
    });
    let mut hosts: Vec<String> = Vec::new();
    if let Some(host) = section.take("host", faults).and_then(|host| host.text(faults)) {
        hosts.push(host.to_owned());
    }
    if let Some(only) = section.take("only", faults).and_then(|only| only.texts(faults)) {
        hosts.extend(only.into_iter().map(str::to_owned));
    }
    let mut tags = Vec::new();
    if let Some(uses) = section.take("use", faults) {
        for name in uses.texts(faults).unwrap_or_default() {
            match templates.iter().find(|template| &*template.name == name) {
                Some(template) => {
                    add_tags(&mut tags, template.tags.clone(), &format!("{}.use", section.path()), faults)
                }
                None => uses.fault(PlantFault::NoSuch { kind: "template", name: name.to_owned() }, faults),
            }
        }
    }
    LinkKeys { endpoint, hosts, tags }
}

/// Adds tags unless their names are taken.
fn add_tags(tags: &mut Vec<PlantTag>, others: Vec<PlantTag>, path: &str, faults: &mut Faults) {
    let mut lines: HashMap<Arc<str>, usize> = tags.iter().map(|tag| (tag.name.clone(), tag.line)).collect();
    for tag in others {
        match lines.entry(tag.name.clone()) {
            Entry::Occupied(first) => {
                let fault = PlantFault::DoubleName { name: tag.name.to_string(), first_line: *first.get() };
                faults.push(tag.line, &format!("{path}.{}", tag.name), fault);
            }
            Entry::Vacant(place) => {
                place.insert(tag.line);
                tags.push(tag);
            }
        }
    }
}

/// The tags of a table of tags in a file of its own.
fn table_tags(field: &Field<'_>, load: LoadTable<'_>, plant: &Plant, faults: &mut Faults) -> Vec<PlantTag> {
    let Some(path) = field.text(faults) else { return Vec::new() };
    let table = match load(path) {
        Ok(table) => table,
        Err(fault) => {
            field.fault(fault, faults);
            return Vec::new();
        }
    };
    let mut of_entry = |entry: &TagEntry| PlantTag {
        name: entry.name().into(),
        tag: entry.tag(),
        class: entry.class().and_then(|class| known_class(class, field, plant, faults)),
        unit: entry.unit().map(Into::into),
        comment: entry.comment().map(Into::into),
        group: entry.group().map(Into::into),
        deadband: None,
        heartbeat: None,
        on_change: false,
        write: None,
        line: field.line(),
    };
    table.iter().map(&mut of_entry).collect()
}

fn known_class(name: &str, field: &Field<'_>, plant: &Plant, faults: &mut Faults) -> Option<Arc<str>> {
    let class = plant.class(name);
    if class.is_none() {
        field.fault(PlantFault::NoSuch { kind: "class", name: name.to_owned() }, faults);
    }
    class.map(|class| class.name.clone())
}

fn tags(section: &Section<'_>, plant: &Plant, faults: &mut Faults) -> Vec<PlantTag> {
    let mut tags = Vec::new();
    for (name, field) in named(section, faults) {
        if name.parse::<Tag>().is_ok() {
            field.fault(PlantFault::NameIsTag { name: name.to_owned() }, faults);
        } else {
            tags.extend(tag(name, &field, plant, faults));
        }
    }
    tags
}

fn tag(name: &str, field: &Field<'_>, plant: &Plant, faults: &mut Faults) -> Option<PlantTag> {
    let before = faults.len();
    let blank = |tag: Tag| PlantTag {
        name: name.into(),
        tag,
        class: None,
        unit: None,
        comment: None,
        group: None,
        deadband: None,
        heartbeat: None,
        on_change: false,
        write: None,
        line: field.line(),
    };
    if field.is_text() {
        return parsed(field, faults).map(blank);
    }
    let mut section = field.table_or("a text or a table", faults)?;
    let at = section.require("at", faults).and_then(|at| parsed(&at, faults));
    let class = section.take("class", faults).and_then(|class| known_class(class.text(faults)?, &class, plant, faults));
    let mut free = |key| section.take(key, faults).and_then(|text| text.text(faults)).map(Into::into);
    let (unit, comment) = (free("unit"), free("comment"));
    let group = section.take("group", faults).and_then(|group| {
        let name = group.text(faults)?;
        group.is_named(name, faults).then(|| name.into())
    });
    let deadband = section.take("deadband", faults).and_then(|field| {
        let deadband = field.number(0.0, faults)?;
        if let Some(tag) = at.filter(|tag| deadband > 0.0 && !tag.tag_type().is_number()) {
            field.fault(PlantFault::Deadband { tag }, faults);
        }
        Some(deadband)
    });
    let heartbeat = section.take("heartbeat", faults).and_then(|heartbeat| heartbeat.time(faults));
    let on_change = section.take("on_change", faults).and_then(|on| on.flag(faults)).unwrap_or(false);
    let rule = section.take("write", faults).and_then(|rule| write_rule(&rule, at, faults));
    section.finish(TAG_KEYS, faults);
    let tag = blank(at?);
    let is_good = faults.len() == before;
    is_good.then_some(PlantTag { class, unit, comment, group, deadband, heartbeat, on_change, write: rule, ..tag })
}

fn parsed(field: &Field<'_>, faults: &mut Faults) -> Option<Tag> {
    match field.text(faults)?.parse() {
        Ok(tag) => Some(tag),
        Err(error) => {
            field.fault(PlantFault::Tag(error), faults);
            None
        }
    }
}

fn write_rule(field: &Field<'_>, tag: Option<Tag>, faults: &mut Faults) -> Option<WriteRule> {
    let mut section = field.table(faults)?;
    let limit = |section: &mut Section<'_>, key, faults: &mut Faults| {
        section.take(key, faults).and_then(|limit| limit.number(f64::MIN, faults))
    };
    let (min, max) = (limit(&mut section, "min", faults), limit(&mut section, "max", faults));
    let pulse = section.take("pulse", faults).and_then(|pulse| pulse.time(faults));
    section.finish(WRITE_KEYS, faults);
    if min.zip(max).is_some_and(|(min, max)| min > max) {
        field.fault(PlantFault::MinAboveMax, faults);
    }
    let is_one_discrete = |tag: Tag| matches!(tag.first(), Element::Discrete(_)) && tag.value_count() == 1;
    let is_number =
        |tag: Tag| tag.first().width() != Width::Bit && tag.tag_type() != TagType::Bool && !tag.tag_type().is_text();
    let has_limits = min.is_some() || max.is_some();
    if tag.is_some_and(|tag| has_limits && !is_number(tag) || pulse.is_some() && !is_one_discrete(tag)) {
        field.fault(PlantFault::WrongRule, faults);
    }
    Some(WriteRule { min, max, pulse })
}
