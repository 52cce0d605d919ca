//! Counters of a link and its stations, and station states that can be watched.

mod shared;

use std::cmp::Ordering;
use std::time::Duration;

use tokio::time::Instant;

pub(crate) use self::shared::SharedStats;
use super::in_step::Why;
use super::nanoseconds;
use crate::command::Spelling;

/// Counters of a station since the link was made. A snapshot.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct StationStats {
    /// Requests of calls sent, retries included. Requests of the link itself are in `checks`.
    pub requests: u64,
    /// Replies given to calls, refusals included.
    pub replies: u64,
    /// Replies with an error code.
    pub refusals: u64,
    /// Requests and checks that were not answered in time.
    pub timeouts: u64,
    /// Requests and checks that were answered by a corrupt frame or one of another shape.
    pub bad_replies: u64,
    /// Retries.
    pub retries: u64,
    /// Requests of the link itself: checks between two requests, and probes of an offline station.
    pub checks: u64,
    /// The checks by reason.
    pub checks_for: CheckStats,
    /// Checks that were refused: the device does not know the loop-back (4E), or not always.
    pub refused_checks: u64,
    /// Silences that replaced a check.
    pub silences: u64,
    /// The requests by spelling.
    pub spellings: SpellingStats,
    /// Requests that were refused in another spelling, and sent again as the caller made them.
    pub refused_spellings: u64,
    /// Replies without proof that they answer the request, which was sent again.
    pub unproven_replies: u64,
    /// Duplicates of the reply taken last.
    pub duplicates: u64,
    /// Replies to requests that had timed out.
    pub late_replies: u64,
    /// Answers to broadcasts.
    pub broadcast_answers: u64,
    /// Reads and writes of several requests that were repeated in part after an unexpected frame.
    pub repeated_jobs: u64,
    /// Other good frames that did not answer the request on the wire.
    pub stray_frames: u64,
    /// Round trips, from the end of the request to the end of the reply; `None` before the first.
    pub round_trip: Option<RoundTripStats>,
}

/// Checks by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct CheckStats {
    /// The connection was new.
    pub connected: u64,
    /// A request was not answered in time.
    pub timed_out: u64,
    /// A frame came that no request takes.
    pub stray: u64,
    /// A reply came without proof.
    pub unproven: u64,
    /// A duplicate of an earlier reply could have answered the next request in each of its
    /// spellings.
    pub owed: u64,
    /// A read or write of several requests was confirmed, or an offline station was probed.
    pub confirm: u64,
}

/// Requests by spelling.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub struct SpellingStats {
    /// As the caller made them.
    pub plain: u64,
    /// With one element more, or the first one twice.
    pub one_more: u64,
    /// With fewer elements, as part of a longer read or write.
    pub fewer: u64,
    /// As a mixed read or write (48, 49).
    pub mixed: u64,
}

/// Round trips of a station.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct RoundTripStats {
    /// The last one.
    pub last: Duration,
    /// The shortest one.
    pub shortest: Duration,
    /// The longest one.
    pub longest: Duration,
    /// A moving average, in which each round trip has a weight of one eighth.
    pub smoothed: Duration,
}

/// Declares the counters of a link: as users see them, with the sum of its stations, and as the link
/// keeps them. Most links never need the rare ones.
macro_rules! link_counters {
    (usual { $($(#[$doc:meta])* $name:ident,)* } rare { $($(#[$rare_doc:meta])* $rare:ident,)* }) => {
        /// Counters of a link since it was made. A snapshot.
        #[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
        #[non_exhaustive]
        pub struct LinkStats {
            /// The sum of all stations.
            pub stations: StationStats,
            /// The time in which the line was in use. Its growth over a time, divided by that time, is the
            /// load of the link: 1 if each request waits only for the one before it.
            ///
            /// Of each request, those of the link itself included, it is the time from the beginning of its
            /// transmission to the end of its reply, of the response timeout, or of the connection, and the
            /// [frame gap](crate::LinkBuilder::frame_gap) behind a reply. Of a broadcast it is the
            /// transmission and the [broadcast gap](crate::LinkBuilder::broadcast_gap). It is added when the
            /// exchange ends, with the gap behind it, so over a short time the load can be more than 1. The
            /// time of opening connections and the silences that replace a check do not count.
            pub bus_time: Duration,
            $($(#[$doc])* pub $name: u64,)*
            $($(#[$rare_doc])* pub $rare: u64,)*
            /// `true` if the device closes its connection after each reply, as
            /// [set](crate::endpoint::InStepSettings::one_request) or learned.
            pub one_request: bool,
        }

        /// Counters of a link without those of its stations.
        #[derive(Clone, Debug, Default)]
        pub(crate) struct LinkCounters {
            $(pub(crate) $name: u64,)*
            rare: Option<Box<RareCounters>>,
            pub(crate) one_request: bool,
        }

        /// Counters that stay zero on most links.
        #[derive(Clone, Copy, Debug, Default)]
        pub(crate) struct RareCounters {
            $(pub(crate) $rare: u64,)*
        }

        impl LinkCounters {
            pub(crate) fn rare(&mut self) -> &mut RareCounters {
                self.rare.get_or_insert_default()
            }

            pub(crate) fn with(&self, stations: StationStats, bus_time: Duration) -> LinkStats {
                let rare = self.rare.as_deref().copied().unwrap_or_default();
                LinkStats {
                    stations,
                    bus_time,
                    $($name: self.$name,)*
                    $($rare: rare.$rare,)*
                    one_request: self.one_request,
                }
            }
        }

        impl LinkStats {
            pub(crate) fn plus(self, other: &Self) -> Self {
                Self {
                    stations: self.stations.plus(&other.stations),
                    bus_time: self.bus_time.saturating_add(other.bus_time),
                    $($name: self.$name.saturating_add(other.$name),)*
                    $($rare: self.$rare.saturating_add(other.$rare),)*
                    one_request: self.one_request || other.one_request,
                }
            }
        }
    };
}

link_counters! {
    usual {
        /// Broadcasts sent.
        broadcasts,
        /// Frames with a bad checksum.
        checksum_errors,
        /// Bytes that were part of no good frame, those of bad frames included.
        garbage_bytes,
        /// Bytes that came before a request was sent, and were dropped then.
        stale_bytes,
        /// Connections opened.
        connects,
        /// Connections lost.
        disconnects,
        /// Connections closed because the link was idle.
        idle_closes,
        /// Attempts to connect that failed.
        connect_failures,
    }
    rare {
        /// Datagrams that came to the local port of an earlier request: late replies and duplicates
        /// over UDP.
        late_datagrams,
        /// Echoes of requests from an RS-485 adapter.
        echoes,
        /// Connections that were replaced because nothing was answered over them.
        mute_connections,
        /// Times that the frame gap became long, since slow RS-485 drivers were seen; see
        /// [`LinkBuilder::frame_gap`](crate::LinkBuilder::frame_gap).
        long_gaps,
        /// Calls that failed because the [send gate](crate::SendGate) was closed.
        withheld,
    }
}

/// State of a station: answering or not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[non_exhaustive]
pub enum StationState {
    /// It has not answered yet, or it was offline when its link fell idle.
    #[default]
    Unknown,
    /// It has answered.
    Online,
    /// It has not answered several times in a row. Calls fail at once until it answers a probe.
    #[non_exhaustive]
    Offline {
        /// When the next probe is due.
        probe_at: Instant,
    },
}

impl StationStats {
    pub(crate) fn replied(&mut self, within: Duration, refused: bool) {
        add(&mut self.replies, 1);
        add(&mut self.refusals, u64::from(refused));
        self.round_trip = Some(match self.round_trip {
            None => RoundTripStats { last: within, shortest: within, longest: within, smoothed: within },
            Some(before) => RoundTripStats {
                last: within,
                shortest: before.shortest.min(within),
                longest: before.longest.max(within),
                smoothed: mean(before.smoothed, 7, within, 1),
            },
        });
    }

    /// Counts a request that is sent in this spelling.
    pub(crate) fn sent(&mut self, plain: Spelling, spelling: Spelling) {
        add(&mut self.requests, 1);
        let spellings = &mut self.spellings;
        let counter = match spelling.count.cmp(&plain.count) {
            _ if spelling.code != plain.code => &mut spellings.mixed,
            Ordering::Equal => &mut spellings.plain,
            Ordering::Greater => &mut spellings.one_more,
            Ordering::Less => &mut spellings.fewer,
        };
        add(counter, 1);
    }

    /// Counts a check.
    pub(crate) fn checked(&mut self, why: Why) {
        add(&mut self.checks, 1);
        let checks = &mut self.checks_for;
        let counter = match why {
            Why::Connected => &mut checks.connected,
            Why::TimedOut => &mut checks.timed_out,
            Why::Stray => &mut checks.stray,
            Why::Unproven => &mut checks.unproven,
            Why::Owed => &mut checks.owed,
            Why::Confirm => &mut checks.confirm,
        };
        add(counter, 1);
    }

    fn plus(self, other: &Self) -> Self {
        Self {
            requests: self.requests.saturating_add(other.requests),
            replies: self.replies.saturating_add(other.replies),
            refusals: self.refusals.saturating_add(other.refusals),
            timeouts: self.timeouts.saturating_add(other.timeouts),
            bad_replies: self.bad_replies.saturating_add(other.bad_replies),
            retries: self.retries.saturating_add(other.retries),
            checks: self.checks.saturating_add(other.checks),
            checks_for: self.checks_for.plus(&other.checks_for),
            refused_checks: self.refused_checks.saturating_add(other.refused_checks),
            silences: self.silences.saturating_add(other.silences),
            spellings: self.spellings.plus(&other.spellings),
            refused_spellings: self.refused_spellings.saturating_add(other.refused_spellings),
            unproven_replies: self.unproven_replies.saturating_add(other.unproven_replies),
            duplicates: self.duplicates.saturating_add(other.duplicates),
            late_replies: self.late_replies.saturating_add(other.late_replies),
            broadcast_answers: self.broadcast_answers.saturating_add(other.broadcast_answers),
            repeated_jobs: self.repeated_jobs.saturating_add(other.repeated_jobs),
            stray_frames: self.stray_frames.saturating_add(other.stray_frames),
            round_trip: match (self.round_trip, other.round_trip) {
                (Some(a), Some(b)) => Some(RoundTripStats {
                    last: a.last.max(b.last),
                    shortest: a.shortest.min(b.shortest),
                    longest: a.longest.max(b.longest),
                    smoothed: mean(a.smoothed, 1, b.smoothed, 1),
                }),
                (a, b) => a.or(b),
            },
        }
    }
}

impl CheckStats {
    fn plus(self, other: &Self) -> Self {
        Self {
            connected: self.connected.saturating_add(other.connected),
            timed_out: self.timed_out.saturating_add(other.timed_out),
            stray: self.stray.saturating_add(other.stray),
            unproven: self.unproven.saturating_add(other.unproven),
            owed: self.owed.saturating_add(other.owed),
            confirm: self.confirm.saturating_add(other.confirm),
        }
    }
}

impl SpellingStats {
    fn plus(self, other: &Self) -> Self {
        Self {
            plain: self.plain.saturating_add(other.plain),
            one_more: self.one_more.saturating_add(other.one_more),
            fewer: self.fewer.saturating_add(other.fewer),
            mixed: self.mixed.saturating_add(other.mixed),
        }
    }
}

/// Adds to a counter.
pub(crate) fn add(counter: &mut u64, count: u64) {
    *counter = counter.saturating_add(count);
}

fn mean(a: Duration, weight_a: u32, b: Duration, weight_b: u32) -> Duration {
    let weighted = |time, weight: u32| nanoseconds(time).saturating_mul(weight.into());
    let sum = weighted(a, weight_a).saturating_add(weighted(b, weight_b));
    Duration::from_nanos(sum.checked_div(weight_a.saturating_add(weight_b).into()).unwrap_or_default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::command::Code;

    const MS: Duration = Duration::from_millis(1);

    #[test]
    fn round_trips_are_counted_as_last_shortest_longest_and_mean() {
        let mut stats = StationStats::default();
        stats.replied(80 * MS, false);
        stats.replied(160 * MS, true);
        stats.replied(10 * MS, false);
        let smoothed = ((80 * MS * 7 + 160 * MS) / 8 * 7 + 10 * MS) / 8;
        let expected = RoundTripStats { last: 10 * MS, shortest: 10 * MS, longest: 160 * MS, smoothed };
        assert_eq!((stats.replies, stats.refusals, stats.round_trip), (3, 1, Some(expected)));
    }

    #[test]
    fn sums_of_link_stats_add_every_counter() {
        let one = LinkStats {
            stations: StationStats { requests: 1, ..StationStats::default() },
            bus_time: 15 * MS,
            broadcasts: 2,
            checksum_errors: 3,
            garbage_bytes: 4,
            stale_bytes: 5,
            late_datagrams: 11,
            echoes: 6,
            connects: 7,
            disconnects: 8,
            idle_closes: 9,
            mute_connections: 12,
            long_gaps: 13,
            connect_failures: 10,
            withheld: 14,
            one_request: true,
        };
        let two = one.plus(&one);
        assert_eq!(
            [two.stations.requests, two.broadcasts, two.checksum_errors, two.garbage_bytes, two.stale_bytes],
            [2, 4, 6, 8, 10]
        );
        assert_eq!((two.late_datagrams, two.one_request, two.mute_connections, two.long_gaps), (22, true, 24, 26));
        assert_eq!((two.withheld, two.bus_time), (28, 30 * MS));
        assert_eq!(
            [two.echoes, two.connects, two.disconnects, two.idle_closes, two.connect_failures],
            [12, 14, 16, 18, 20]
        );
    }

    #[test]
    fn requests_are_counted_by_spelling_and_checks_by_reason() {
        let plain = Spelling::new(Code::ReadRegisters, 3);
        let mut stats = StationStats::default();
        for (spelling, times) in [
            (plain, 1),
            (Spelling::new(Code::ReadRegisters, 4), 2),
            (Spelling::new(Code::ReadRegisters, 2), 3),
            (Spelling::new(Code::ReadMixed, 3), 4),
        ] {
            (0..times).for_each(|_| stats.sent(plain, spelling));
        }
        let reasons = [Why::Connected, Why::TimedOut, Why::Stray, Why::Unproven, Why::Owed, Why::Confirm];
        for (times, why) in (1..).zip(reasons) {
            (0..times).for_each(|_| stats.checked(why));
        }
        let spellings = SpellingStats { plain: 1, one_more: 2, fewer: 3, mixed: 4 };
        let checks = CheckStats { connected: 1, timed_out: 2, stray: 3, unproven: 4, owed: 5, confirm: 6 };
        assert_eq!((stats.requests, stats.spellings), (10, spellings));
        assert_eq!((stats.checks, stats.checks_for), (21, checks));
        let two = stats.plus(&stats);
        assert_eq!((two.spellings.mixed, two.spellings.fewer, two.spellings.one_more), (8, 6, 4));
        assert_eq!(two.checks_for, checks.plus(&checks));
        assert_eq!((two.checks_for.connected, two.checks_for.confirm), (2, 12));
    }

    #[test]
    fn one_link_of_one_request_shows_in_the_sum() {
        let (usual, one_request) = (LinkStats::default(), LinkStats { one_request: true, ..LinkStats::default() });
        assert!(usual.plus(&one_request).one_request && one_request.plus(&usual).one_request);
        assert!(!usual.plus(&usual).one_request);
    }
}
