//! The fleet as one member sees it: in the status, and in full as `/api/fleet`.

use axum::Json;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use serde::Serialize;
use serde_json::json;

use super::Shared;
use super::view::Milliseconds;
use crate::fleet::{FleetStatus, LinkStatus, MemberState, MemberStatus};
use crate::run::Bridge;

/// The fleet and its members.
#[derive(Clone, Debug, Serialize)]
pub(super) struct FleetForm {
    fleet: String,
    /// The id of this member.
    member: String,
    state: &'static str,
    /// Why it has stopped for good.
    failure: Option<String>,
    lease_ms: Milliseconds,
    /// The time until this member may not send to its PLCs any more, unless it is renewed before; `null`: it may not.
    open_for_ms: Option<Milliseconds>,
    links: LinkCounts,
    members: Vec<MemberForm>,
    warnings: Vec<String>,
}

/// Links of the configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
pub(super) struct LinkCounts {
    pub(super) all: usize,
    /// This member owns them.
    pub(super) own: usize,
    /// No member owns them.
    pub(super) without_owner: usize,
}

#[derive(Clone, Debug, Serialize)]
struct MemberForm {
    member: String,
    version: String,
    config: String,
    weight: u32,
    draining: bool,
    links: usize,
    /// Since its last renewal was seen.
    silent_for_ms: Milliseconds,
}

#[derive(Clone, Debug, Serialize)]
struct LinkForm {
    /// The name: of the bus or of the PLC.
    link: String,
    /// The id in the store.
    id: String,
    /// `null`: it has no owner.
    owner: Option<String>,
    /// The fencing token, which is `rev` in the batches of its PLCs.
    rev: u64,
    /// Since this member saw the owner take it.
    owned_for_ms: Milliseconds,
    /// The member that is to own it.
    target: Option<String>,
}

impl FleetForm {
    /// The fleet of a bridge, if it is a member of one.
    pub(super) fn of(bridge: &Bridge) -> Option<Self> {
        let (config, status) = (bridge.config(), bridge.fleet.as_ref()?.status());
        let (state, failure) = state(&status.state);
        Some(Self {
            fleet: config.fleet.as_ref()?.id.to_string(),
            member: status.id.to_string(),
            state,
            failure,
            lease_ms: Milliseconds(config.fleet.as_ref()?.lease.0),
            open_for_ms: status.open_for.map(Milliseconds),
            links: LinkCounts::of(&status),
            members: status.members.iter().map(MemberForm::of).collect(),
            warnings: status.warnings.clone(),
        })
    }
}

impl LinkCounts {
    pub(super) fn of(status: &FleetStatus) -> Self {
        let count = |is_one: &dyn Fn(&LinkStatus) -> bool| status.links.iter().filter(|link| is_one(link)).count();
        Self {
            all: status.links.len(),
            own: count(&|link| link.owner.as_ref() == Some(&status.id)),
            without_owner: count(&|link| link.owner.is_none()),
        }
    }
}

impl MemberForm {
    fn of(status: &MemberStatus) -> Self {
        Self {
            member: status.id.to_string(),
            version: status.version.clone(),
            config: status.config.clone(),
            weight: status.weight,
            draining: status.is_draining,
            links: status.links,
            silent_for_ms: Milliseconds(status.silent_for),
        }
    }
}

fn state(state: &MemberState) -> (&'static str, Option<String>) {
    match state {
        MemberState::Connecting => ("connecting", None),
        MemberState::Joining => ("joining", None),
        MemberState::Active => ("active", None),
        MemberState::Draining => ("draining", None),
        MemberState::Left => ("left", None),
        MemberState::Failed(why) => ("failed", Some(why.clone())),
    }
}

/// The fleet with all of its links.
pub(super) async fn fleet(shared: State<Shared>) -> Response {
    let bridge = &shared.bridge;
    let Some((form, membership)) = FleetForm::of(bridge).zip(bridge.fleet.as_ref()) else {
        let error = json!({ "error": "the bridge is not a member of a fleet" });
        return (StatusCode::NOT_FOUND, Json(error)).into_response();
    };
    let links = membership.links();
    let link = |link: &LinkStatus| LinkForm {
        link: links.name_of(&link.link).to_owned(),
        id: link.link.to_string(),
        owner: link.owner.as_deref().map(str::to_owned),
        rev: link.token.revision,
        owned_for_ms: Milliseconds(link.owned_for),
        target: link.target.as_deref().map(str::to_owned),
    };
    let mut answer = serde_json::to_value(form).unwrap_or_default();
    answer["counts"] = answer["links"].take();
    answer["links"] = json!(membership.status().links.iter().map(link).collect::<Vec<_>>());
    Json(answer).into_response()
}
