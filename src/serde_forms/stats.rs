//! Statistics: structs with the names of their fields, durations in seconds.

use std::time::Duration;

use serde::ser::SerializeStruct as _;
use serde::{Serialize, Serializer};

use super::duration::Seconds;
use crate::link::{CheckStats, LinkStats, RoundTripStats, SpellingStats, StationStats};
use crate::poll::{ClassStats, Counters, PollerStats};
use crate::pool::{PoolEndpoint, PoolStats};

macro_rules! stats {
    ($($type:ident { $($field:ident $(: $convert:ident)?,)* })*) => {
        $(
            impl Serialize for $type {
                fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
                    let Self { $($field,)* } = self;
                    let mut form = serializer.serialize_struct(stringify!($type), [$(stringify!($field)),*].len())?;
                    $(form.serialize_field(stringify!($field), stats!(@form $field $($convert)?))?;)*
                    form.end()
                }
            }
        )*
    };
    (@form $field:ident) => { $field };
    (@form $field:ident $convert:ident) => { &$convert($field) };
}

// One row per struct, with all of its fields: a new field does not compile without its place here.
// `:seconds` marks a duration.
stats! {
    LinkStats {
        stations, bus_time: seconds, broadcasts, checksum_errors, garbage_bytes, stale_bytes, late_datagrams, echoes,
        connects, disconnects, idle_closes, mute_connections, long_gaps, connect_failures, withheld, one_request,
    }
    StationStats {
        requests, replies, refusals, timeouts, bad_replies, retries, checks, checks_for, refused_checks, silences,
        spellings, refused_spellings, unproven_replies, duplicates, late_replies, broadcast_answers, repeated_jobs,
        stray_frames, round_trip,
    }
    CheckStats { connected, timed_out, stray, unproven, owed, confirm, }
    SpellingStats { plain, one_more, fewer, mixed, }
    RoundTripStats { last: seconds, shortest: seconds, longest: seconds, smoothed: seconds, }
    PoolStats { endpoints, links, idle, waiting, connecting, up, down, closed, evicted, traffic, }
    PoolEndpoint { endpoint, links, traffic, }
    PollerStats { stations, tags, refused_tags, samples, missed, counters, }
    ClassStats { class, tags, refused_tags, requests_per_cycle, counters, }
    Counters { cycles, completed, overruns, abandoned, requests, refusals, failures, last_cycle: seconds, }
}

fn seconds(duration: &Duration) -> Seconds {
    Seconds(*duration)
}
