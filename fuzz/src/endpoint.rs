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
    let transport = endpoint.transport();
    if let Transport::Tcp { host, port, .. } | Transport::Udp { host, port, .. } = transport {
        assert!(!host.is_empty() && *port > 0);
    }
    if let Transport::Serial { path, .. } = transport {
        assert!(!path.is_empty());
    }
    if let Some(settings) = transport.serial_settings() {
        assert!(settings.data_bits() == DataBits::Eight || endpoint.framing() == Framing::Ascii);
    }
}
