//! The state of a fleet as tables of at most 80 columns, and as JSON.

use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;

use fatek_bridge::fleet::{LinkStatus, MemberStatus, Observation, PlantLinks, config_hash};
use serde_json::{Value, json};

use super::Plant;
use crate::columns::{Columns, cut};

/// The digits of a hash of a configuration in a table.
const HASH_DIGITS: usize = 8;

/// The state of a fleet, with its configuration.
pub(super) struct Report<'r> {
    pub(super) plant: &'r Plant,
    pub(super) seen: &'r Observation,
}

fn state(member: &MemberStatus) -> &'static str {
    match (member.is_silent(), member.is_draining) {
        (true, _) => "silent",
        (false, true) => "draining",
        (false, false) => "active",
    }
}

impl Report<'_> {
    /// The faults that an operator should know.
    fn warnings(&self) -> Vec<String> {
        let own = config_hash(&self.plant.config);
        let mut warnings = Vec::new();
        let mut processes: BTreeMap<&str, usize> = BTreeMap::new();
        let alive = || self.seen.members.iter().filter(|member| !member.is_silent());
        for member in alive() {
            *processes.entry(&member.id).or_default() += 1;
            if member.config != own {
                let (other, own) = (short(&member.config), short(&own));
                let what = if self.plant.config.stored.is_some() { "the plant in the store" } else { "this file" };
                warnings.push(format!("{} has the configuration {other}, and {what} is {own}", member.id));
            }
        }
        for (member, count) in processes.into_iter().filter(|(_, count)| *count > 1) {
            warnings.push(format!("{count} processes run, or have just run, under the id {member}"));
        }
        for (member, why) in &self.plant.refusals {
            let why = why.lines().next().unwrap_or_default();
            warnings.push(format!("{member} refuses the plant in the store: {why}"));
        }
        if self.plant.config.has_stored_plant() && self.plant.config.stored.is_none() {
            warnings.push("the store has no plant yet: fatek-bridge fleet push puts it there".to_owned());
        }
        if alive().next().is_none() {
            warnings.push("no member runs".to_owned());
        } else if let count @ 1.. = self.seen.links.iter().filter(|link| link.owner.is_none()).count() {
            let links = if count == 1 { "1 link has".to_owned() } else { format!("{count} links have") };
            warnings.push(format!("{links} no owner"));
        }
        warnings
    }

    pub(super) fn to_json(&self) -> Value {
        let milliseconds = |time: Duration| u64::try_from(time.as_millis()).unwrap_or(u64::MAX);
        let member = |member: &MemberStatus| {
            json!({
                "member": &*member.id, "state": state(member), "version": member.version, "config": member.config,
                "weight": member.weight, "links": member.links, "lease_ms": milliseconds(member.lease),
                "silent_for_ms": milliseconds(member.silent_for),
            })
        };
        let moved = &self.seen.moved;
        let names = PlantLinks::of(&self.plant.config.plant);
        let link = |link: &LinkStatus| {
            json!({
                "link": names.name_of(&link.link), "id": &*link.link, "owner": link.owner.as_deref(),
                "rev": link.token.revision, "owned_for_ms": milliseconds(link.owned_for), "target": link.target.as_deref(),
                "moved": moved.get(&*link.link),
            })
        };
        let Plant { config, fleet, .. } = self.plant;
        let version = config.stored.as_ref().and_then(|stored| stored.version);
        let Observation { replicas, members, links, drained, .. } = self.seen;
        let without_owner = links.iter().filter(|link| link.owner.is_none()).count();
        json!({
            "fleet": fleet.id.as_str(), "bucket": fleet.bucket.as_str(), "replicas": replicas,
            "config": config_hash(config), "version": version,
            "members": members.iter().map(member).collect::<Vec<_>>(),
            "links": links.iter().map(link).collect::<Vec<_>>(),
            "drained": drained,
            "counts": { "all": links.len(), "without_owner": without_owner },
            "warnings": self.warnings(),
        })
    }
}

impl fmt::Display for Report<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Observation { members, links, moved, drained, .. } = self.seen;
        writeln!(f, "{}", member_table(members))?;
        let names = PlantLinks::of(&self.plant.config.plant);
        writeln!(f, "{}", link_table(links, moved, &names))?;
        if let Some(stored) = &self.plant.config.stored {
            let (name, hash) = (stored.name(), config_hash(&self.plant.config));
            writeln!(f, "{}: configuration {}", name.display(), short(&hash))?;
        }
        for member in drained.iter().filter(|id| !members.iter().any(|member| *member.id == ***id)) {
            writeln!(f, "{member} gets no links when it is started: fleet drain --undo ends that")?;
        }
        self.warnings().iter().try_for_each(|warning| writeln!(f, "warning: {warning}"))
    }
}

fn member_table(members: &[MemberStatus]) -> Columns<7> {
    let titles = ["MEMBER", "STATE", "LINKS", "WEIGHT", "VERSION", "CONFIG", "SEEN"];
    let mut columns = Columns::new(titles).right([2, 3, 6]);
    for member in members {
        columns.row([
            cut(&member.id, 20),
            state(member).to_owned(),
            member.links.to_string(),
            member.weight.to_string(),
            cut(&member.version, 10),
            short(&member.config).to_owned(),
            age(member.silent_for),
        ]);
    }
    columns
}

fn link_table(links: &[LinkStatus], moved: &BTreeMap<String, String>, names: &PlantLinks) -> Columns<5> {
    let mut columns = Columns::new(["LINK", "OWNER", "SINCE", "TOKEN", "TO"]).right([2, 3]);
    let mut links: Vec<(&str, &LinkStatus)> = links.iter().map(|link| (names.name_of(&link.link), link)).collect();
    links.sort_by_key(|(name, _)| *name);
    for (name, link) in links {
        let is_leased = link.token.revision > 0;
        let order = moved.get(&*link.link).map(|member| format!("{} by hand", cut(member, 10)));
        let target = link.target.as_ref().filter(|target| link.owner.as_ref() != Some(target));
        columns.row([
            cut(name, 18),
            link.owner.as_ref().map_or("-".to_owned(), |owner| cut(owner, 14)),
            if is_leased { age(link.owned_for) } else { "-".to_owned() },
            if is_leased { link.token.to_string() } else { "-".to_owned() },
            order.or_else(|| Some(cut(target?, 18))).unwrap_or_default(),
        ]);
    }
    columns
}

fn short(hash: &str) -> &str {
    hash.get(..HASH_DIGITS).unwrap_or(hash)
}

/// An age with its two largest units, or in tenths of a second.
fn age(age: Duration) -> String {
    let seconds = age.as_secs();
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (1.., _, _) => format!("{days}d {hours}h"),
        (0, 1.., _) => format!("{hours}h {minutes}m"),
        (0, 0, 1..) => format!("{minutes}m {}s", seconds % 60),
        (0, 0, 0) if seconds >= 10 => format!("{seconds}s"),
        (0, 0, 0) => format!("{:.1}s", age.as_secs_f64()),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use fatek_bridge::config::{Config, Environment};
    use fatek_bridge::fleet::LinkToken;

    use super::*;

    #[test]
    fn ages_have_two_units() {
        for (milliseconds, text) in [
            (0, "0.0s"),
            (450, "0.5s"),
            (9_900, "9.9s"),
            (10_000, "10s"),
            (61_000, "1m 1s"),
            (7_260_000, "2h 1m"),
            (90_000_000, "1d 1h"),
        ] {
            assert_eq!(age(Duration::from_millis(milliseconds)), text);
        }
    }

    #[test]
    fn tables_have_at_most_80_columns() {
        let text = "[fleet]\nid = 'a'\n[nats]\nurl = 'nats://h'\n[plc.mixer]\nlink = 'tcp://h'\nstation = 1\n";
        let config = Config::from_text(Path::new("plant.toml"), text, &Environment::default()).unwrap();
        let (fleet, nats) = (config.fleet.clone().unwrap(), config.nats.clone().unwrap());
        let plant = Plant { config, fleet, nats, refusals: BTreeMap::new() };
        let long = "x".repeat(64);
        let member = |id: &str, config: &str, silent_for| MemberStatus {
            id: id.into(),
            session: "s".into(),
            version: "100.100.100-alpha".to_owned(),
            config: config.to_owned(),
            weight: 1000,
            is_draining: true,
            lease: Duration::from_secs(3),
            silent_for,
            links: 100_000,
        };
        let link = |id: &str, owner: Option<&str>, revision| LinkStatus {
            link: id.into(),
            owner: owner.map(Into::into),
            token: LinkToken { store: 1, revision },
            owned_for: Duration::from_secs(399 * 86_400 + 23 * 3600),
            target: Some("hall-1".into()),
        };
        let own = config_hash(&plant.config);
        let seen = Observation {
            replicas: 3,
            members: vec![
                member(&long, "other", Duration::from_secs(2)),
                member("hall-1", &own, Duration::from_secs(4)),
            ],
            links: vec![link(&long, Some(&long), 999_999_999_999), link("line1", None, 0)],
            moved: BTreeMap::from([(long.clone(), long.clone())]),
            drained: ["hall-9".to_owned()].into(),
        };
        let report = Report { plant: &plant, seen: &seen };
        let shown = report.to_string();
        for line in shown.split("\n\n").take(2).flat_map(str::lines) {
            assert!(line.chars().count() <= 80, "{} columns: {line}", line.chars().count());
        }
        for part in ["draining", "silent", " by hand", "1 link has no owner", "hall-9 gets no links", "399d 23h"] {
            assert!(shown.contains(part), "{part}:\n{shown}");
        }
        let document = report.to_json();
        assert_eq!(document["members"][1]["state"], "silent");
        assert_eq!(document["links"][0]["moved"], long);
        assert_eq!(document["counts"], json!({ "all": 2, "without_owner": 1 }));
        assert_eq!(document["warnings"].as_array().unwrap().len(), 2, "{document:#}");
    }
}
