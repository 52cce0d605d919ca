use super::*;

#[test]
fn endpoints_round_trip() {
    for (text, canonical) in [
        ("tcp://10.0.0.7", "tcp://10.0.0.7:500"),
        ("TCP://plc-1.example:501", "tcp://plc-1.example:501"),
        ("tcp://10.0.0.7:500?framing=ascii", "tcp://10.0.0.7:500"),
        ("tcp://10.0.0.7:4000/?framing=BINARY", "tcp://10.0.0.7:4000?framing=binary"),
        ("tcp://[::1]", "tcp://[::1]:500"),
        ("tcp://[fe80::1]:7?framing=binary", "tcp://[fe80::1]:7?framing=binary"),
        ("udp://10.0.0.7", "udp://10.0.0.7:500"),
        ("Udp://plc-1.example:501/", "udp://plc-1.example:501"),
        ("udp://[::1]:4000?framing=binary", "udp://[::1]:4000?framing=binary"),
        ("serial:/dev/ttyUSB0", "serial:/dev/ttyUSB0"),
        ("serial:///dev/ttyUSB0", "serial:/dev/ttyUSB0"),
        ("SERIAL:COM3", "serial:COM3"),
        (r"serial:\\.\COM12", r"serial:\\.\COM12"),
        ("serial:/dev/ttyUSB0?baud=9600&frame=7E1&framing=ascii", "serial:/dev/ttyUSB0"),
        ("serial:/dev/ttyUSB0?frame=8n1&baud=19200", "serial:/dev/ttyUSB0?baud=19200&frame=8N1"),
        ("serial:/dev/ttyUSB0?framing=binary", "serial:/dev/ttyUSB0?framing=binary"),
        ("serial:/dev/ttyUSB0?framing=binary&frame=8N1", "serial:/dev/ttyUSB0?framing=binary"),
        (
            "serial:/dev/ttyS1?framing=binary&frame=8O2&baud=115200",
            "serial:/dev/ttyS1?baud=115200&frame=8O2&framing=binary",
        ),
    ] {
        let endpoint: Endpoint = text.parse().unwrap();
        assert_eq!(endpoint.to_string(), canonical);
        assert_eq!(canonical.parse(), Ok(endpoint));
    }
}

#[test]
fn a_bad_endpoint_is_named_with_the_rule_it_breaks() {
    for (text, rule) in [
        ("", "it must begin with `tcp://`, `udp://` or `serial:`"),
        ("10.0.0.7:500", "it must begin with `tcp://`"),
        ("/dev/ttyUSB0", "it must begin with `tcp://`"),
        ("tcp:10.0.0.7", "it must begin with `tcp://`"),
        ("http://10.0.0.7", "the transport `http` is not known"),
        ("tcp://", "the host is missing"),
        ("tcp://:500", "the host is missing"),
        ("tcp://plc:0", "the port `0` must be a number from 1 to 65535"),
        ("tcp://plc:65536", "the port `65536` must be a number from 1 to 65535"),
        ("tcp://plc:+5", "the port `+5` must be a number from 1 to 65535"),
        ("tcp://plc:", "the port `` must be a number from 1 to 65535"),
        ("tcp://plc?framing=rtu", "`rtu` is not a framing"),
        ("tcp://plc?framing", "`` is not a framing"),
        ("tcp://plc?framing=ascii&framing=binary", "the option `framing` is given twice"),
        ("tcp://plc?speed=9600", "the option `speed=9600` is not known"),
        ("tcp://plc?", "the option `` is not known"),
        ("tcp://plc?baud=9600", "the option `baud` is for serial ports, not for tcp"),
        ("udp://plc?frame=7E1", "the option `frame` is for serial ports, not for udp"),
        ("tcp://plc?framing=binary", "no usual port: state it, as in `tcp://host:port?framing=binary`"),
        ("udp://plc?framing=binary", "no usual port: state it, as in `udp://host:port?framing=binary`"),
        ("tcp://[::1", "the bracket of the IPv6 address is not closed"),
        ("tcp://[plc]", "`plc` is not an IPv6 address"),
        ("tcp://[::1]500", "`500` follows the IPv6 address"),
        ("tcp://pl c", "the character ' '"),
        ("tcp://user@plc", "the character '@'"),
        ("serial:", "the path of the port is missing"),
        ("serial:?baud=9600", "the path of the port is missing"),
        ("serial://COM3", "the path follows `serial:` without `//`"),
        ("serial:/dev/tty\0", "the character '\\0'"),
        ("serial:COM3?baud=299", "the baud rate `299` must be a number from 300 to 921600"),
        ("serial:COM3?baud=921601", "the baud rate `921601` must be a number from 300 to 921600"),
        ("serial:COM3?baud=99999999999", "the baud rate `99999999999` must be a number"),
        ("serial:COM3?baud=+9600", "the baud rate `+9600` must be a number"),
        ("serial:COM3?baud", "the baud rate `` must be a number"),
        ("serial:COM3?frame=6E1", "the frame `6E1` must be data bits (7, 8), parity (N, E, O) and stop bits (1, 2)"),
        ("serial:COM3?frame=7X1", "the frame `7X1` must be"),
        ("serial:COM3?frame=7E3", "the frame `7E3` must be"),
        ("serial:COM3?frame=7E", "the frame `7E` must be"),
        ("serial:COM3?frame=7E15", "the frame `7E15` must be"),
        ("serial:COM3?parity=E", "the option `parity=E` is not known"),
        ("serial:COM3?framing=binary&frame=7E1", "the binary framing needs 8 data bits, and 9600 baud 7E1 has 7"),
    ] {
        let message = text.parse::<Endpoint>().unwrap_err().to_string();
        assert!(message.starts_with(&format!("`{text}` is not an endpoint: ")), "{message}");
        assert!(message.contains(rule), "{message} should say: {rule}");
    }
}

#[test]
fn what_is_built_is_what_is_parsed() {
    let fast = SerialSettings::new(Framing::Ascii).with_baud(19_200).unwrap();
    for (built, text) in [
        (Endpoint::tcp("plc", 500), "tcp://plc"),
        (Endpoint::udp("::1", 7).with_framing(Framing::Binary), "udp://[::1]:7?framing=binary"),
        (Endpoint::serial("COM3"), "serial:COM3?frame=7E1"),
        (Endpoint::serial("COM3").with_framing(Framing::Binary), "serial:COM3?frame=8N1&framing=binary"),
        (Endpoint::serial("COM3").with_serial(fast).unwrap(), "serial:COM3?baud=19200"),
        (
            Endpoint::serial("COM3").with_serial(fast).unwrap().with_framing(Framing::Binary),
            "serial:COM3?baud=19200&framing=binary",
        ),
    ] {
        assert_eq!(text.parse(), Ok(built));
    }
}

#[test]
fn binary_frames_need_eight_data_bits() {
    let ascii = SerialSettings::new(Framing::Ascii);
    let error = Endpoint::serial("COM3").with_framing(Framing::Binary).with_serial(ascii).unwrap_err();
    assert_eq!(error, InvalidSettings::DataBits { settings: ascii });

    let even = ascii.with_data_bits(DataBits::Eight).with_stop_bits(StopBits::Two);
    let endpoint = Endpoint::serial("COM3").with_serial(even).unwrap().with_framing(Framing::Binary);
    assert_eq!(endpoint.to_string(), "serial:COM3?frame=8E2&framing=binary", "settings that will do are kept");
}

#[test]
fn only_a_serial_port_has_its_settings() {
    let error = Endpoint::tcp("plc", 500).with_serial(SerialSettings::new(Framing::Ascii)).unwrap_err();
    assert_eq!(error.to_string(), "tcp://plc:500 is no serial port");
    let error = SerialSettings::new(Framing::Ascii).with_baud(0).unwrap_err();
    assert_eq!(error.to_string(), "the baud rate 0 is not within 300 to 921600");
}

proptest::proptest! {
    #[test]
    fn no_text_panics_and_every_accepted_text_round_trips(
        text in "(tcp://|udp://|serial:)?[\\PC]{0,24}([?&](framing|baud|frame)=[a-z0-9NEO]{0,6}){0,3}"
    ) {
        if let Ok(endpoint) = text.parse::<Endpoint>() {
            proptest::prop_assert_eq!(endpoint.to_string().parse::<Endpoint>(), Ok(endpoint));
        }
    }
}
