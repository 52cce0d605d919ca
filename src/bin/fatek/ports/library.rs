//! Serial ports of systems other than Linux, as the library for ports lists them.

use std::io;

use super::Port;

#[cfg(feature = "serial")]
#[cfg_attr(target_os = "linux", allow(dead_code, reason = "compiled here for its test"))]
pub(super) fn ports() -> io::Result<Vec<Port>> {
    let all = tokio_serial::available_ports()?;
    let names: Vec<String> = all.iter().map(|port| port.port_name.clone()).collect();
    let mut ports: Vec<Port> = all.into_iter().filter(|port| !has_twin(&port.port_name, &names)).map(port).collect();
    ports.sort_by(|one, other| one.path.cmp(&other.path));
    Ok(ports)
}

#[cfg(not(feature = "serial"))]
#[cfg_attr(target_os = "linux", allow(dead_code, reason = "compiled here for its test"))]
pub(super) fn ports() -> io::Result<Vec<Port>> {
    Err(io::Error::new(io::ErrorKind::Unsupported, "this program was built without serial ports"))
}

/// Returns whether a port of macOS is listed also under the name for calling out. The other name waits
/// for a modem.
#[cfg(feature = "serial")]
fn has_twin(name: &str, names: &[String]) -> bool {
    let twin = name.strip_prefix("/dev/tty.").map(|rest| format!("/dev/cu.{rest}"));
    twin.is_some_and(|twin| names.contains(&twin))
}

#[cfg(feature = "serial")]
fn port(port: tokio_serial::SerialPortInfo) -> Port {
    use tokio_serial::SerialPortType::{BluetoothPort, PciPort, Unknown, UsbPort};

    let usb = match port.port_type {
        UsbPort(usb) => Some(super::Usb {
            id: format!("{:04x}:{:04x}", usb.vid, usb.pid),
            manufacturer: usb.manufacturer,
            product: usb.product,
            serial: usb.serial_number,
        }),
        BluetoothPort | PciPort | Unknown => None,
    };
    Port { path: port.port_name, usb, ..Port::default() }
}

#[cfg(all(test, feature = "serial"))]
mod tests {
    use super::*;
    use tokio_serial::{SerialPortInfo, SerialPortType, UsbPortInfo};

    #[test]
    fn a_port_of_the_library_has_its_usb_names() {
        let usb = UsbPortInfo {
            vid: 0x0403,
            pid: 0x6015,
            serial_number: Some("D30AB1CD".to_owned()),
            manufacturer: Some("FTDI".to_owned()),
            product: None,
        };
        let found = port(SerialPortInfo { port_name: "COM3".to_owned(), port_type: SerialPortType::UsbPort(usb) });
        assert_eq!((found.path.as_str(), found.usb.unwrap().id.as_str()), ("COM3", "0403:6015"));
    }

    #[test]
    fn ports_of_macos_are_listed_once() {
        let names = ["/dev/cu.usb1", "/dev/tty.usb1", "/dev/tty.other"].map(str::to_owned);
        let has_twin = names.each_ref().map(|name| has_twin(name, &names));
        assert_eq!(has_twin, [false, true, false]);
    }
}
