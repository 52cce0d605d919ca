//! Endpoint URLs.

use fatek::Endpoint;
use fatek::endpoint::{DataBits, Transport};
use fatek::wire::Framing;

use crate::text::round_trip;

pub fn run(input: &[u8]) {
    let text = String::from_utf8_lossy(input);
    let Some(endpoint) = round_trip::<Endpoint>(&text) else { return };
    for framing in [Framing::Ascii, Framing::Binary] {
        let other = endpoint.clone().with_framing(framing);
        assert_eq!(round_trip::<Endpoint>(&other.to_string()), Some(other));
    }
    match endpoint.transport() {
        Transport::Tcp { host, port, .. } | Transport::Udp { host, port, .. } => assert!(!host.is_empty() && *port > 0),
        Transport::Serial { path, settings, .. } => {
            assert!(!path.is_empty());
            assert!(settings.data_bits() == DataBits::Eight || endpoint.framing() == Framing::Ascii);
        }
        other => panic!("transport not covered by this target: {other:?}"),
    }
}
