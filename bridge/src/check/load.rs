//! Plans of the PLCs, and the load of their links.

use std::collections::HashMap;
use std::time::Duration;

use fatek::plant::{PlantClass, PlantPlc, PlantTag};
use fatek::poll::ScanClass;
use fatek::{CostModel, Plan};

use super::{Finding, Severity, finding};
use crate::config::Config;
use crate::fleet::{PlantLinks, hosts};
use crate::registry::default_class;

/// The load above which a link has too little time left for retries and commands.
const HIGH_LOAD: f64 = 0.7;

/// The plan of a scan class of a PLC.
#[derive(Clone, Debug, PartialEq)]
pub struct ClassPlan {
    /// The name of the PLC.
    pub plc: String,
    /// Its station.
    pub station: u8,
    /// Its link.
    pub link: String,
    /// The name of the class; `None`: that of tags without one.
    pub class: Option<String>,
    /// Its period.
    pub every: Duration,
    /// The number of its tags.
    pub tags: usize,
    /// The requests of a cycle.
    pub requests: usize,
    /// The bytes of these requests and their replies.
    pub bytes: usize,
    /// The time of a cycle.
    pub time: Duration,
}

/// The load of a link.
#[derive(Clone, Debug, PartialEq)]
pub struct LinkLoad {
    /// The link.
    pub link: String,
    /// Its id in a fleet: the name of its bus, or of its PLC.
    pub id: Option<String>,
    /// The members of a fleet that can reach it; none: all can.
    pub hosts: Vec<String>,
    /// The number of its PLCs.
    pub plcs: usize,
    /// The requests in a second.
    pub requests_per_second: f64,
    /// The bytes in a second, in both directions.
    pub bytes_per_second: f64,
    /// The share of its time, from 0; above 1 it is overloaded.
    pub load: f64,
}

/// The tags of a PLC that are read together.
struct Group<'p> {
    scan: ScanClass,
    class: Option<&'p str>,
    tags: Vec<&'p PlantTag>,
}

/// Plans all PLCs. A PLC that cannot be planned is a fault.
pub(super) fn plans(config: &Config, round_trip: Duration, findings: &mut Vec<Finding>) -> Vec<ClassPlan> {
    let mut plans = Vec::new();
    for plc in config.plant.plcs() {
        for group in groups(config, plc) {
            let Group { scan, class, tags } = group;
            let builder = Plan::builder(cost(plc, round_trip)).tags(tags.iter().map(|tag| tag.tag()));
            match builder.build() {
                Ok(plan) => plans.push(ClassPlan {
                    plc: plc.name().to_owned(),
                    station: plc.station(),
                    link: plc.endpoint().to_string(),
                    class: class.map(str::to_owned),
                    every: scan.period(),
                    tags: tags.len(),
                    requests: plan.requests().len(),
                    bytes: plan.bytes(),
                    time: plan.time(),
                }),
                Err(error) => {
                    let fault = finding(Severity::Fault, format!("plc.{}", plc.name()), error.to_string());
                    findings.push(Finding { line: Some(plc.line()), ..fault });
                }
            }
        }
    }
    plans
}

/// The tags of a PLC by scan class: classes with equal settings are one.
fn groups<'p>(config: &'p Config, plc: &'p PlantPlc) -> Vec<Group<'p>> {
    let mut groups: Vec<Group<'p>> = Vec::new();
    for tag in plc.tags() {
        let class = tag.class().and_then(|name| config.plant.class(name));
        let scan = class.map_or_else(default_class, PlantClass::scan_class);
        match groups.iter_mut().find(|group| group.scan == scan) {
            Some(group) => group.tags.push(tag),
            None => groups.push(Group { scan, class: tag.class(), tags: vec![tag] }),
        }
    }
    groups
}

/// The costs of a PLC: by the settings of a serial line, else by the round trip.
fn cost(plc: &PlantPlc, round_trip: Duration) -> CostModel {
    let endpoint = plc.endpoint();
    let cost = match endpoint.transport().serial_settings() {
        Some(settings) => CostModel::serial(settings, endpoint.framing()).with_response_time(round_trip),
        None => CostModel::network(endpoint.framing(), round_trip),
    };
    cost.with_in_step(endpoint.in_step())
}

/// Sums up the plans of each link.
pub(super) fn links(config: &Config, plans: &[ClassPlan], findings: &mut Vec<Finding>) -> Vec<LinkLoad> {
    // In a fleet, a port of the same name on another host is another link.
    let of_fleet = config.fleet.as_ref().map(|_| PlantLinks::of(&config.plant));
    let mut links: Vec<LinkLoad> = Vec::new();
    let mut numbers: HashMap<(String, Option<String>), usize> = HashMap::new();
    let mut of_plc: HashMap<&str, usize> = HashMap::new();
    for plc in config.plant.plcs() {
        let link = plc.endpoint().to_string();
        let id_of = |links: &PlantLinks| Some(links.name_of(links.link_of(plc.name())?).to_owned());
        let id = of_fleet.as_ref().and_then(id_of);
        let number = *numbers.entry((link.clone(), id.clone())).or_insert(links.len());
        of_plc.insert(plc.name(), number);
        match links.get_mut(number) {
            Some(known) => known.plcs += 1,
            None => links.push(LinkLoad {
                link,
                id,
                hosts: hosts(plc).into_iter().map(str::to_owned).collect(),
                plcs: 1,
                requests_per_second: 0.0,
                bytes_per_second: 0.0,
                load: 0.0,
            }),
        }
    }
    for plan in plans {
        let Some(link) = of_plc.get(&*plan.plc).and_then(|&number| links.get_mut(number)) else { continue };
        let per_second = 1.0 / plan.every.as_secs_f64();
        link.requests_per_second += plan.requests as f64 * per_second;
        link.bytes_per_second += plan.bytes as f64 * per_second;
        link.load += plan.time.as_secs_f64() * per_second;
    }
    for link in links.iter().filter(|link| link.load > HIGH_LOAD) {
        let percent = link.load * 100.0;
        let text = if link.load > 1.0 {
            format!(
                "the load is {percent:.0} %, and values come late: longer periods, fewer tags or a faster line help"
            )
        } else {
            format!("the load is {percent:.0} %: above 70 % a slow or silent PLC delays the others")
        };
        findings.push(finding(Severity::Warning, link.link.clone(), text));
    }
    links
}
