//! Subcommand `fatek ports`: the serial ports of this computer. None is opened: that could change the
//! lines DTR and RTS, and disturb another program.

pub(crate) mod access;
#[cfg(any(not(target_os = "linux"), test))]
mod library;
#[cfg(target_os = "linux")]
mod sysfs;

use self::access::Access;
use crate::args::PortsArgs;
use crate::failure::Failure;
use crate::output::{Format, Output, Rows};
use crate::printable::excerpt;

/// Serial port, as the system describes it.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Port {
    /// Its name for a program, such as `/dev/ttyUSB0` or `COM3`.
    pub(crate) path: String,
    pub(crate) driver: Option<String>,
    pub(crate) usb: Option<Usb>,
    /// A name that stays the same when adapters are plugged into other sockets.
    pub(crate) by_id: Option<String>,
    pub(crate) access: Access,
}

/// USB adapter of a port.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(crate) struct Usb {
    /// Numbers of vendor and product, as `0403:6015`.
    pub(crate) id: String,
    pub(crate) manufacturer: Option<String>,
    pub(crate) product: Option<String>,
    pub(crate) serial: Option<String>,
}

impl Usb {
    /// Manufacturer and product for people.
    fn name(&self) -> Option<String> {
        match (&self.manufacturer, &self.product) {
            (Some(manufacturer), Some(product)) if !product.starts_with(manufacturer.as_str()) => {
                Some(format!("{manufacturer} {product}"))
            }
            (_, Some(name)) | (Some(name), None) => Some(name.clone()),
            (None, None) => None,
        }
    }
}

pub(crate) fn ports(args: &PortsArgs, output: &Output) -> Result<(), Failure> {
    let ports = list(args)?;
    print(&ports, output)?;
    if ports.is_empty() {
        output.remark(format_args!("no serial ports"));
    }
    for port in ports.iter().filter(|port| port.access != Access::Granted) {
        if let Some(remedy) = port.access.remedy() {
            output.remark(format_args!("hint: {}: {remedy}", excerpt(&port.path)));
            // One group is enough for all.
            break;
        }
    }
    let usable = |port: &&Port| matches!(port.access, Access::Granted | Access::Unknown);
    let first = ports.iter().filter(usable).max_by_key(|port| port.usb.is_some());
    if let Some(port) = first {
        let path = port.by_id.as_ref().unwrap_or(&port.path);
        output.remark(format_args!("hint: to find the settings of a PLC: fatek detect {}", excerpt(path)));
    }
    Ok(())
}

#[cfg(target_os = "linux")]
fn list(args: &PortsArgs) -> Result<Vec<Port>, Failure> {
    sysfs::ports(&args.root).map_err(Failure::Ports)
}

#[cfg(not(target_os = "linux"))]
fn list(_: &PortsArgs) -> Result<Vec<Port>, Failure> {
    library::ports().map_err(Failure::Ports)
}

fn print(ports: &[Port], output: &Output) -> Result<(), Failure> {
    let mut table = Rows::new(["port", "driver", "usb", "name", "serial", "access"]);
    let mut rows = Rows::new(["port", "driver", "usb", "manufacturer", "product", "serial", "by_id", "access", "note"]);
    for port in ports {
        let usb = port.usb.as_ref();
        let id = usb.map(|usb| usb.id.clone());
        let serial = usb.and_then(|usb| usb.serial.clone());
        let (path, driver) = (port.path.clone(), port.driver.clone());
        if output.format == Format::Table {
            let name = usb.and_then(Usb::name);
            table.push([
                path.into(),
                driver.into(),
                id.into(),
                name.into(),
                serial.into(),
                port.access.to_string().into(),
            ]);
        } else {
            rows.push([
                path.into(),
                driver.into(),
                id.into(),
                usb.and_then(|usb| usb.manufacturer.clone()).into(),
                usb.and_then(|usb| usb.product.clone()).into(),
                serial.into(),
                port.by_id.clone().into(),
                port.access.is_granted().into(),
                port.access.reason().into(),
            ]);
        }
    }
    output.rows(if output.format == Format::Table { &table } else { &rows })
}
