//! The API: tags, their last values, and the status, as JSON.

use std::time::{Instant, SystemTime};

use axum::Json;
use axum::extract::{Query, State};
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};

use super::Shared;
use super::view::{Grade, Milliseconds, TagState};
use crate::batch::milliseconds;
use crate::registry::PolledPlc;

/// The tags of one request for the history, at most.
const MAX_TAGS: usize = 256;

/// The query of `/api/tags`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct TagsQuery {
    plc: Option<String>,
}

/// A tag with its value.
#[derive(Debug, Serialize)]
struct TagForm<'t> {
    plc: &'t str,
    tag: &'t str,
    at: String,
    /// `null` of a bad tag.
    value: Value,
    unit: Option<&'t str>,
    quality: Grade,
    why: Option<String>,
    /// The time of the reply; of a bad tag, when it became bad.
    ts: u64,
    age_ms: Milliseconds,
}

/// Each tag with its current value, of all PLCs or of one.
pub(super) async fn tags(State(shared): State<Shared>, Query(query): Query<TagsQuery>) -> Response {
    let plcs = shared.bridge.registry.read();
    let now = Instant::now();
    let of_plc = |plc: &PolledPlc| tags_of(plc, now);
    let tags: Vec<Value> = match &query.plc {
        None => plcs.iter().flat_map(of_plc).collect(),
        Some(name) => match plcs.get(name) {
            Some(plc) => of_plc(plc),
            None => return not_found("no PLC has this name"),
        },
    };
    drop(plcs);
    Json(json!({ "ts": milliseconds(SystemTime::now()), "tags": tags })).into_response()
}

fn tags_of(plc: &PolledPlc, now: Instant) -> Vec<Value> {
    let mut samples: std::collections::HashMap<_, _> =
        plc.polled.snapshot().into_iter().map(|sample| (sample.id, sample)).collect();
    let mut tags = Vec::with_capacity(samples.len());
    for (tag, id) in plc.plc.tags().zip(&plc.ids) {
        // A tag that a reload has just removed.
        let Some(sample) = samples.remove(id) else { continue };
        let state = TagState::of(&sample);
        let form = TagForm {
            plc: plc.plc.name(),
            tag: tag.name(),
            at: tag.tag().to_string(),
            age_ms: state.age(now),
            value: state.value,
            unit: tag.unit(),
            quality: state.grade,
            why: state.why,
            ts: state.ts,
        };
        tags.push(serde_json::to_value(form).unwrap_or(Value::Null));
    }
    tags
}

/// The query of `/api/history`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct HistoryQuery {
    plc: String,
    /// Names with commas between them.
    tags: String,
}

/// The last values of tags, the newest last, one for each slot; `null` where a tag was not good.
pub(super) async fn history(State(shared): State<Shared>, Query(query): Query<HistoryQuery>) -> Response {
    if query.tags.split(',').count() > MAX_TAGS {
        return (StatusCode::BAD_REQUEST, Json(json!({ "error": format!("at most {MAX_TAGS} tags") }))).into_response();
    }
    let state = shared.hub.lock();
    let Some(plc) = state.view.plcs().iter().find(|plc| plc.polled.plc.name() == query.plc) else {
        return not_found("no PLC has this name");
    };
    let wanted: std::collections::HashSet<&str> = query.tags.split(',').collect();
    let mut tags = Map::new();
    for (tag, place) in plc.polled.plc.tags().zip(plc.places.clone()) {
        if wanted.contains(tag.name()) {
            tags.insert(tag.name().to_owned(), json!(state.history.values(place)));
        }
    }
    if tags.len() < wanted.len() {
        return not_found("the PLC has no tag of this name");
    }
    Json(json!({ "slot": state.history.newest(), "tags": tags })).into_response()
}

/// The figures of PLCs, links, buffer and outputs; at most two seconds old.
pub(super) async fn status(State(shared): State<Shared>) -> Response {
    let status = shared.hub.lock().status.clone();
    Json(&*status).into_response()
}

fn not_found(error: &str) -> Response {
    (StatusCode::NOT_FOUND, Json(json!({ "error": error }))).into_response()
}
