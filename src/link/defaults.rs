//! Default settings of links and calls.

use std::time::Duration;

/// Response timeout on networks and streams.
pub const RESPONSE_TIMEOUT: Duration = Duration::from_secs(1);

/// Response timeout on serial lines, from the end of the request.
pub const SERIAL_RESPONSE_TIMEOUT: Duration = Duration::from_millis(300);

/// Timeout of a whole call: queueing, connecting and retries included.
pub const CALL_TIMEOUT: Duration = Duration::from_secs(10);

/// Retries of a read.
pub const RETRIES: u32 = 2;

/// Timeout of one attempt to connect.
pub const CONNECT_TIMEOUT: Duration = Duration::from_secs(3);

/// Shortest and longest pause between attempts to connect; jitter takes off up to a half.
pub const CONNECT_BACKOFF: (Duration, Duration) = (Duration::from_millis(100), Duration::from_secs(30));

/// Silence after a broadcast on serial lines. Networks and streams have none.
pub const SERIAL_BROADCAST_GAP: Duration = Duration::from_millis(100);

/// Timeouts in a row after which a station is offline.
pub const OFFLINE_AFTER: u32 = 3;

/// Shortest and longest interval between probes of an offline station.
pub const PROBE_INTERVAL: (Duration, Duration) = (Duration::from_secs(1), Duration::from_secs(60));

/// Silence of all stations of a connection after which it is replaced.
pub const MUTE_TIMEOUT: Duration = Duration::from_secs(5);

/// Time to wait for the next byte of a reply that comes slowly.
pub const BYTE_TIMEOUT: Duration = Duration::from_millis(100);

/// Time after the response timeout in which a reply must end whose bytes keep coming.
pub const SLOW_FRAME_TIME: Duration = Duration::from_secs(8);

/// Calls that can wait for one station.
pub const QUEUE_CAPACITY: usize = 1024;
