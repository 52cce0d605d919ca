use super::*;

#[test]
fn each_kind_of_transport_is_in_the_table() {
    let hosts = |host: &str| {
        [Transport::Tcp { host: host.to_owned(), port: 500 }, Transport::Udp { host: host.to_owned(), port: 500 }]
    };
    let [tcp, udp] = hosts("PLC-1");
    for (transport, scheme, is_remote, is_one_line) in
        [(&tcp, "tcp", true, false), (&udp, "udp", false, false), (&serial::new("COM3"), "serial", false, true)]
    {
        assert_eq!((transport.kind().scheme(), transport.is_remote()), (scheme, is_remote));
        assert_eq!((transport.is_one_line(), transport.serial_settings().is_some()), (is_one_line, is_one_line));
        assert!(KINDS.iter().any(|kind| std::ptr::eq(*kind, transport.kind())), "{scheme} cannot be parsed");
    }
    assert_eq!(hosts("PLC-1").map(|transport| transport.identity()), hosts("plc-1"));
}

#[test]
fn settings_are_no_part_of_the_identity_of_a_serial_port() {
    let mut port = serial::new("/dev/ttyUSB0");
    *port.serial_settings_mut().unwrap() = SerialSettings::new(Framing::Binary);
    assert_eq!(port.identity(), serial::new("/dev/ttyUSB0"));
    assert_ne!(port.identity(), serial::new("/dev/ttyusb0").identity(), "paths are case-sensitive");
}

#[test]
fn a_port_of_windows_is_the_same_in_all_its_spellings() {
    for name in ["COM10", "com10", r"\\.\COM10", r"\\.\Com10"] {
        assert_eq!(serial::new(name).identity(), serial::new("COM10").identity(), "{name}");
    }
    for name in ["COM1", "COM", "COM1O", "/dev/COM10", r"\\.\COM", r"\\.\pipe", "ÄCOM10", "COÄ10"] {
        assert_ne!(serial::new(name).identity(), serial::new("COM10").identity(), "{name}");
        assert_eq!(serial::new(name).identity(), serial::new(name), "{name}");
    }
}
