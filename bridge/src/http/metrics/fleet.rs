//! Metrics of the fleet, as this member sees it.

use std::fmt;

use prometheus_client::registry::Unit;

use super::Writer;
use crate::fleet::MemberState;
use crate::http::Shared;
use crate::http::fleet::LinkCounts;

pub(super) fn write(to: &mut Writer<'_>, shared: &Shared) -> fmt::Result {
    let (bridge, config) = (&shared.bridge, shared.bridge.config());
    let Some((membership, fleet)) = bridge.fleet.as_ref().zip(config.fleet.as_ref()) else { return Ok(()) };
    let (status, counts) = (membership.status(), membership.counts());
    to.info("fleet", "The fleet and this member", [vec![("fleet", fleet.id.as_str()), ("member", &*status.id)]])?;
    let is_active = matches!(status.state, MemberState::Active | MemberState::Draining);
    let help = "1 while this member has a session in the store";
    to.gauge("fleet_active", None, help, [(vec![], u64::from(is_active))])?;
    let open_for = status.open_for.unwrap_or_default().as_secs_f64();
    let help = "Time until this member may not send to its PLCs any more, unless its lease is renewed before";
    to.gauge("fleet_open_for", Some(Unit::Seconds), help, [(vec![], open_for)])?;
    let links = LinkCounts::of(&status);
    let gauges = [
        ("fleet_links", "Links of the configuration", links.all),
        ("fleet_own_links", "Links that this member owns", links.own),
        ("fleet_links_without_owner", "Links that no member owns", links.without_owner),
        ("fleet_members", "Members, this one included", status.members.len()),
        ("fleet_warnings", "Faults that an operator should know: see /api/fleet", status.warnings.len()),
    ];
    for (name, help, count) in gauges {
        to.gauge(name, None, help, [(vec![], super::as_u64(count))])?;
    }
    let silent = status.members.iter().map(|member| (vec![("member", &*member.id)], member.silent_for.as_secs_f64()));
    to.gauge("fleet_member_silent", Some(Unit::Seconds), "Time since the last renewal of a member was seen", silent)?;
    let help = "Links that this member has got";
    to.counter("fleet_taken_links", None, help, [(vec![], counts.taken)])?;
    let help = "Links that this member has lost, because the store did not answer in time";
    to.counter("fleet_lost_links", None, help, [(vec![], counts.lost)])
}
