use super::*;
use std::time::Duration;

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
        ("serial:COM10?rts=on&dtr=off", "serial:COM10?dtr=off&rts=on"),
        ("serial:COM10?dtr=on&rts=off&baud=19200", "serial:COM10?baud=19200&dtr=on&rts=off"),
        ("serial:/dev/ttyS1?rs485=rts", "serial:/dev/ttyS1?rs485=rts"),
        (
            "serial:/dev/ttyS1?rs485=rts-inverted&dtr=on&copies=0",
            "serial:/dev/ttyS1?dtr=on&rs485=rts-inverted&copies=0",
        ),
        ("serial:/dev/ttyUSB0?framing=binary", "serial:/dev/ttyUSB0?framing=binary"),
        ("serial:/dev/ttyUSB0?framing=binary&frame=8N1", "serial:/dev/ttyUSB0?framing=binary"),
        (
            "serial:/dev/ttyS1?framing=binary&frame=8O2&baud=115200",
            "serial:/dev/ttyS1?baud=115200&frame=8O2&framing=binary",
        ),
        ("tcp://plc?copies=1&window=100ms&quiet=1s&one_request=false", "tcp://plc:500"),
        ("udp://plc?window=0.1s&quiet=1000ms&copies=01", "udp://plc:500"),
        (
            "udp://plc?settle=0.70s&one_request=true&quiet=1.50s&window=0.250s&copies=0",
            "udp://plc:500?copies=0&window=250ms&quiet=1.5s&one_request=true&settle=700ms",
        ),
        (
            "serial:COM3?copies=8&frame=8N1&framing=binary&baud=300&window=99.5ms",
            "serial:COM3?baud=300&framing=binary&copies=8&window=99.5ms",
        ),
        ("tcp://plc/?framing=ascii&copies=2", "tcp://plc:500?copies=2"),
    ] {
        let endpoint: Endpoint = text.parse().unwrap();
        assert_eq!(endpoint.to_string(), canonical);
        assert_eq!(canonical.parse(), Ok(endpoint));
    }
}

#[test]
fn errors_name_the_input_and_the_rule() {
    for (text, rule) in [
        ("", "it must begin with `tcp://`, `udp://`"),
        ("10.0.0.7:500", "it must begin with `tcp://`"),
        ("/dev/ttyUSB0", "it must begin with `tcp://`"),
        ("tcp:10.0.0.7", "it must begin with `tcp://`"),
        ("http://10.0.0.7", "unknown transport `http`"),
        ("tcp://", "the host is missing"),
        ("tcp://:500", "the host is missing"),
        ("tcp://plc:0", "the port `0` must be a number from 1 to 65535"),
        ("tcp://plc:65536", "the port `65536` must be a number from 1 to 65535"),
        ("tcp://plc:+5", "the port `+5` must be a number from 1 to 65535"),
        ("tcp://plc:", "the port `` must be a number from 1 to 65535"),
        ("tcp://plc?framing=rtu", "`rtu` is not a framing"),
        ("tcp://plc?framing", "`` is not a framing"),
        ("tcp://plc?framing=ascii&framing=binary", "the option `framing` is given twice"),
        ("tcp://plc?speed=9600", "unknown option `speed=9600`"),
        ("tcp://plc?", "unknown option ``"),
        ("tcp://plc?baud=9600", "the option `baud` is for serial ports, not for tcp"),
        ("udp://plc?frame=7E1", "the option `frame` is for serial ports, not for udp"),
        ("tcp://plc?framing=binary", "no default port: state it, as in `tcp://host:port?framing=binary`"),
        ("udp://plc?framing=binary", "no default port: state it, as in `udp://host:port?framing=binary`"),
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
        ("serial:COM3?parity=E", "unknown option `parity=E`"),
        (
            "tcp://plc?speed=9600",
            "it must be `framing`, `copies`, `window`, `quiet`, `one_request` or `settle`, or, for a serial",
        ),
        ("tcp://plc?copies=9", "the option `copies=9` must be a number from 0 to 8"),
        ("tcp://plc?copies=256", "the option `copies=256` must be a number from 0 to 8"),
        ("tcp://plc?copies=+1", "the option `copies=+1` must be a number from 0 to 8"),
        ("udp://plc?copies=-1", "the option `copies=-1` must be a number from 0 to 8"),
        ("serial:COM3?copies", "the option `copies=` must be a number from 0 to 8"),
        ("serial:COM3?copies=1&copies=1", "the option `copies` is given twice"),
        ("tcp://plc?window=1s&window=1s", "the option `window` is given twice"),
        ("tcp://plc?quiet=1s&quiet=2s", "the option `quiet` is given twice"),
        ("tcp://plc?one_request=true&one_request=true", "the option `one_request` is given twice"),
        ("tcp://plc?settle=1s&settle=2s", "the option `settle` is given twice"),
        ("tcp://plc?settle=700", "the option `settle=700` must be a time in `ms` or `s`"),
        ("tcp://plc?window=100", "the option `window=100` must be a time in `ms` or `s`, such as `100ms` or `1.5s`"),
        ("tcp://plc?quiet=25h", "the option `quiet=25h` must be a time in `ms` or `s`"),
        ("tcp://plc?quiet=86400.000000001s", "the option `quiet=86400.000000001s` must be a time"),
        ("tcp://plc?window=86400001ms", "`100ms` or `1.5s`, at most a day"),
        ("udp://plc?one_request=yes", "the option `one_request=yes` must be `true` or `false`"),
        ("udp://plc?one_request", "the option `one_request=` must be `true` or `false`"),
        ("serial:COM3?dtr=1", "the level `1` of `dtr` must be `on` or `off`"),
        ("serial:COM3?rts=high", "the level `high` of `rts` must be `on` or `off`"),
        (
            "serial:COM3?rs485=on",
            "the RS-485 mode `on` must be `rts` (RTS is on while sending) or `rts-inverted` (off)",
        ),
        ("serial:COM3?rs485=rts&rts=on", "`rs485` and `rts` exclude each other"),
        ("tcp://plc?rs485=rts", "the option `rs485` is for serial ports, not for tcp"),
        ("serial:COM3?framing=binary&frame=7E1", "the binary framing needs 8 data bits, and 9600 baud 7E1 has 7"),
    ] {
        let message = text.parse::<Endpoint>().unwrap_err().to_string();
        let shown = text.replace('\0', r"\0");
        assert!(message.starts_with(&format!("`{shown}` is not an endpoint: ")), "{message}");
        assert!(message.contains(rule), "{message} should say: {rule}");
    }
}

#[test]
fn built_endpoints_equal_parsed_ones() {
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
        (
            Endpoint::tcp("plc", 500)
                .with_in_step(InStepSettings::new().with_quiet(Duration::from_millis(1500)).with_one_request(true)),
            "tcp://plc?quiet=1.5s&one_request=true",
        ),
        (Endpoint::serial("COM3").with_in_step(InStepSettings::new().with_copies(3).unwrap()), "serial:COM3?copies=3"),
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
    assert_eq!(endpoint.to_string(), "serial:COM3?frame=8E2&framing=binary", "settings with 8 data bits are kept");
}

#[test]
fn serial_settings_need_a_serial_port() {
    let error = Endpoint::tcp("plc", 500).with_serial(SerialSettings::new(Framing::Ascii)).unwrap_err();
    assert_eq!(error.to_string(), "tcp://plc:500 is not a serial port");
    let error = SerialSettings::new(Framing::Ascii).with_baud(0).unwrap_err();
    assert_eq!(error.to_string(), "the baud rate 0 is not within 300 to 921600");
}

#[test]
fn in_step_settings_have_defaults_and_limits() {
    let usual = InStepSettings::new();
    assert_eq!(usual, InStepSettings::default());
    assert_eq!((usual.copies(), usual.window(), usual.quiet()), (DEFAULT_COPIES, DEFAULT_COPY_WINDOW, DEFAULT_QUIET));
    assert!(!usual.one_request() && usual.settle().is_zero());
    assert_eq!(Endpoint::udp("plc", 500).in_step(), usual);

    for copies in 0..=u8::MAX {
        match usual.with_copies(copies) {
            Ok(settings) => assert!(copies <= MAX_COPIES && settings.copies() == copies),
            Err(error) => {
                assert!(copies > MAX_COPIES);
                assert_eq!(error, InvalidSettings::Copies { copies });
                assert_eq!(error.to_string(), format!("the number of copies {copies} is not within 0 to 8"));
            }
        }
    }
    const DAY: Duration = Duration::from_secs(86_400);
    let nanosecond = Duration::from_nanos(1);
    for (time, bounded) in [
        (Duration::ZERO, Duration::ZERO),
        (nanosecond, nanosecond),
        (DAY, DAY),
        (DAY + nanosecond, DAY),
        (Duration::MAX, DAY),
    ] {
        assert_eq!((usual.with_window(time).window(), usual.with_window(time).quiet()), (bounded, DEFAULT_QUIET));
        assert_eq!(usual.with_settle(time).settle(), bounded);
        assert_eq!((usual.with_quiet(time).quiet(), usual.with_quiet(time).window()), (bounded, DEFAULT_COPY_WINDOW));
    }
    assert!(usual.with_one_request(true).one_request());
    assert!(!usual.with_one_request(true).with_one_request(false).one_request());
}

#[test]
fn in_step_settings_are_kept_by_other_settings() {
    let settings = InStepSettings::new().with_copies(4).unwrap();
    let serial = SerialSettings::new(Framing::Binary);
    let endpoint = Endpoint::serial("COM3").with_in_step(settings).with_framing(Framing::Binary);
    assert_eq!(endpoint.with_serial(serial).unwrap().in_step(), settings);
}

#[test]
fn times_are_decimals_of_milliseconds_or_seconds() {
    for (text, nanoseconds, shown) in [
        ("0ms", 0, "0ms"),
        ("0s", 0, "0ms"),
        ("0.0s", 0, "0ms"),
        ("0.000001ms", 1, "0.000001ms"),
        ("0.000000001s", 1, "0.000001ms"),
        ("1.5ms", 1_500_000, "1.5ms"),
        ("10ms", 10_000_000, "10ms"),
        ("0020.500ms", 20_500_000, "20.5ms"),
        ("999.999999ms", 999_999_999, "999.999999ms"),
        ("2000ms", 2_000_000_000, "2s"),
        ("10s", 10_000_000_000, "10s"),
        ("1.000000001s", 1_000_000_001, "1.000000001s"),
        ("1001ms", 1_001_000_000, "1.001s"),
        ("86400s", 86_400_000_000_000, "86400s"),
        ("86400000.000000ms", 86_400_000_000_000, "86400s"),
    ] {
        let endpoint: Endpoint = format!("tcp://plc?window={text}&quiet={text}").parse().unwrap();
        let settings = endpoint.in_step();
        assert_eq!((settings.window().as_nanos(), settings.quiet().as_nanos()), (nanoseconds, nanoseconds), "{text}");
        assert_eq!(endpoint.to_string(), format!("tcp://plc:500?window={shown}&quiet={shown}"));
    }
    for text in [
        "",
        "1",
        "s",
        "ms",
        ".",
        ".s",
        ".5s",
        "1.s",
        "1..5s",
        "1.5.5s",
        "1,5s",
        "-1s",
        "+1s",
        "1 s",
        " 1s",
        "1s ",
        "1S",
        "1Ms",
        "1us",
        "1m",
        "1e3ms",
        "0x1s",
        "1ms1",
        "1mss",
        "1sms",
        "\u{661}s",
        "0.0000000001s",
        "0.0000001ms",
        "NaNs",
        "infs",
        "18446744073709551616s",
        "18446744073.709551616s",
        "99999999999999999999999ms",
    ] {
        for option in ["window", "quiet"] {
            let error = format!("udp://plc?{option}={text}").parse::<Endpoint>().unwrap_err().to_string();
            let rule = format!("the option `{option}={text}` must be a time in `ms` or `s`");
            assert!(error.contains(&rule), "{error} should say: {rule}");
        }
    }
}

const RTS: &[Rts] = &[Rts::Unchanged, Rts::On, Rts::Off, Rts::OnWhileSending, Rts::OffWhileSending];

proptest::proptest! {
    #[test]
    fn displayed_endpoints_parse_to_the_same(
        transport in 0..3_u8,
        binary in proptest::bool::ANY,
        copies in 0..=MAX_COPIES,
        // Seconds, milliseconds and nanoseconds, and how many of these are used.
        window in (0..100_000_u64, 0..1_000_u64, 0..1_000_000_u64, 0..3_u8),
        quiet in (0..100_000_u64, 0..1_000_u64, 0..1_000_000_u64, 0..3_u8),
        one_request in proptest::bool::ANY,
        dtr in proptest::option::of(proptest::bool::ANY),
        rts in proptest::sample::select(RTS),
    ) {
        let time = |(seconds, millis, nanos, parts): (u64, u64, u64, u8)| {
            let millis = Duration::from_millis(millis);
            match parts {
                0 => millis,
                1 => millis + Duration::from_nanos(nanos),
                _ => millis + Duration::from_nanos(nanos) + Duration::from_secs(seconds),
            }
        };
        let endpoint = match transport {
            0 => Endpoint::tcp("plc", 500),
            1 => Endpoint::udp("::1", 7),
            _ => {
                let settings = SerialSettings::new(Framing::Ascii).with_rts(rts);
                let settings = dtr.map_or(settings, |on| settings.with_dtr(on));
                Endpoint::serial("/dev/ttyUSB0").with_serial(settings).unwrap()
            }
        };
        let settings = InStepSettings::new()
            .with_copies(copies)
            .unwrap()
            .with_window(time(window))
            .with_quiet(time(quiet))
            .with_one_request(one_request);
        let framing = if binary { Framing::Binary } else { Framing::Ascii };
        let endpoint = endpoint.with_framing(framing).with_in_step(settings);
        proptest::prop_assert_eq!(endpoint.to_string().parse::<Endpoint>(), Ok(endpoint));
    }

    #[test]
    fn no_text_panics_and_every_accepted_text_round_trips(
        address in "(tcp://|udp://|serial:)?[\\PC]{0,24}",
        options in "([?&](framing|baud|frame|dtr|rts|rs485|copies|window|quiet|one_request)=[a-z0-9NEO.]{0,6}){0,3}",
    ) {
        if let Ok(endpoint) = format!("{address}{options}").parse::<Endpoint>() {
            proptest::prop_assert_eq!(endpoint.to_string().parse::<Endpoint>(), Ok(endpoint));
        }
    }
}
