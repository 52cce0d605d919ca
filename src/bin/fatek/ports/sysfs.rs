//! Serial ports of Linux, by the files of the kernel in `sys` and of udev in `dev`. No library of udev
//! is needed.
//!
//! ```text
//! sys/class/tty/ttyUSB0/device      the device of the port; consoles and terminals have none
//! sys/class/tty/ttyS7/type          0: a place for a port that is not there
//! device/driver, or one of its parents
//! the first parent with idVendor    the USB adapter
//! dev/serial/by-id/NAME             symbolic link to the device file
//! ```

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use super::access::Access;
use super::{Port, Usb};

/// Limit of a text in a file of the kernel.
const MAX_TEXT: u64 = 256;
/// Limit of parents: the longest paths of USB hubs in hubs are shorter.
const MAX_PARENTS: usize = 16;

/// The ports of the system whose files are in this folder: `/`, or another one in tests. In the order
/// of their names.
pub(super) fn ports(root: &Path) -> io::Result<Vec<Port>> {
    let class = root.join("sys/class/tty");
    let mut names = Vec::new();
    for entry in fs::read_dir(&class)? {
        // Names of devices are ASCII.
        names.extend(entry?.file_name().into_string());
    }
    names.sort_by_key(|name| natural(name));
    let by_id = links(&root.join("dev/serial/by-id"));
    let port = |name: &String| {
        let device = fs::canonicalize(class.join(name).join("device")).ok()?;
        let is_missing = text(&class.join(name).join("type")).is_some_and(|number| number == "0");
        (!is_missing).then(|| {
            let alias = by_id.iter().find(|(_, target)| target == name).map(|(alias, _)| alias);
            Port {
                path: format!("/dev/{name}"),
                driver: driver(&device),
                usb: usb(&device),
                by_id: alias.map(|alias| format!("/dev/serial/by-id/{alias}")),
                access: Access::of(&root.join("dev").join(name), root),
            }
        })
    };
    Ok(names.iter().filter_map(port).collect())
}

/// A name in two parts, so that `ttyUSB10` is behind `ttyUSB9`.
fn natural(name: &str) -> (String, u64) {
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    (stem.to_owned(), name.get(stem.len()..).and_then(|digits| digits.parse().ok()).unwrap_or_default())
}

/// Symbolic links of a folder: their names, and the last parts of their targets.
fn links(folder: &Path) -> Vec<(String, String)> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let link = |entry: io::Result<fs::DirEntry>| {
        let entry = entry.ok()?;
        let target = fs::read_link(entry.path()).ok()?;
        Some((entry.file_name().into_string().ok()?, target.file_name()?.to_str()?.to_owned()))
    };
    let mut links: Vec<_> = entries.filter_map(link).collect();
    // The order of a folder is not fixed, and a port may have two links.
    links.sort();
    links
}

/// A device and its parents, itself first.
fn parents(device: &Path) -> impl Iterator<Item = &Path> {
    device.ancestors().take(MAX_PARENTS)
}

/// Name of the driver. The kernel has devices of its own between a port and its hardware; their
/// drivers, of the bus `serial-base`, say nothing.
fn driver(device: &Path) -> Option<String> {
    let drivers = parents(device).filter_map(|device| fs::canonicalize(device.join("driver")).ok());
    let mut drivers = drivers.filter(|driver| !driver.iter().any(|part| part == "serial-base"));
    drivers.next()?.file_name()?.to_str().map(str::to_owned)
}

fn usb(device: &Path) -> Option<Usb> {
    let adapter: PathBuf = parents(device).find(|device| device.join("idVendor").is_file())?.to_owned();
    let text = |name: &str| text(&adapter.join(name));
    Some(Usb {
        id: format!("{}:{}", text("idVendor")?, text("idProduct")?),
        manufacturer: text("manufacturer"),
        product: text("product"),
        serial: text("serial"),
    })
}

/// Text of a file of the kernel without blanks around it; `None` if it is empty or missing.
fn text(path: &Path) -> Option<String> {
    let mut bytes = Vec::new();
    File::open(path).ok()?.take(MAX_TEXT).read_to_end(&mut bytes).ok()?;
    let text = String::from_utf8_lossy(&bytes).trim().to_owned();
    (!text.is_empty()).then_some(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_in_the_order_of_their_numbers() {
        let mut names = ["ttyUSB10", "ttyUSB9", "ttyACM0", "ttyS1", "rfcomm", "tty99999999999999999999"];
        names.sort_by_key(|name| natural(name));
        assert_eq!(names, ["rfcomm", "tty99999999999999999999", "ttyACM0", "ttyS1", "ttyUSB9", "ttyUSB10"]);
    }
}
