//! `fatek ports` as a process, on the files of a system that does not exist.
#![cfg(all(feature = "cli", target_os = "linux"))]

mod process;

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::Path;

use process::{Folder, Output, fatek};
use serde_json::{Value, json};

fn write(path: impl AsRef<Path>, text: &[u8]) {
    fs::create_dir_all(path.as_ref().parent().unwrap()).unwrap();
    fs::write(path, text).unwrap();
}

/// Makes the port of a device. `driver`: bus and name, such as `usb-serial/ftdi_sio`.
fn port(root: &Path, name: &str, device: &str, driver: &str) {
    let folder = root.join("sys/devices").join(device);
    fs::create_dir_all(folder.join("tty").join(name)).unwrap();
    let (bus, driver) = driver.split_once('/').unwrap();
    let drivers = root.join("sys/bus").join(bus).join("drivers").join(driver);
    fs::create_dir_all(&drivers).unwrap();
    symlink(&drivers, folder.join("driver")).unwrap();
    symlink("../..", folder.join("tty").join(name).join("device")).unwrap();
    let class = root.join("sys/class/tty");
    fs::create_dir_all(&class).unwrap();
    symlink(Path::new("../../devices").join(device).join("tty").join(name), class.join(name)).unwrap();
}

/// A system with two USB adapters, a modem, a built-in port, a place for a port, and a console.
fn system(root: &Path) {
    let usb = root.join("sys/devices/pci0/usb1/1-4");
    for (file, text) in [
        ("idVendor", "0403\n"),
        ("idProduct", "6015\n"),
        ("manufacturer", "FTDI\n"),
        ("product", "FT230X Basic UART\n"),
        ("serial", "D30AB1CD\n"),
    ] {
        write(usb.join(file), text.as_bytes());
    }
    port(root, "ttyUSB10", "pci0/usb1/1-4/1-4:1.0/ttyUSB10", "usb-serial/ftdi_sio");
    // An adapter without names, of a vendor with bytes that control a terminal.
    write(root.join("sys/devices/pci0/usb1/1-5/idVendor"), b"1a86\n");
    write(root.join("sys/devices/pci0/usb1/1-5/idProduct"), b"7523\n");
    write(root.join("sys/devices/pci0/usb1/1-5/product"), b"USB\x1b[31m Serial\xff\n");
    port(root, "ttyUSB9", "pci0/usb1/1-5/1-5:1.0/ttyUSB9", "usb-serial/ch341-uart");
    port(root, "ttyACM0", "pci0/usb1/1-4/1-4:1.2", "usb/cdc_acm");
    // Of newer kernels: devices of their own between the port and its hardware.
    port(root, "ttyS0", "pnp0/00:04/00:04:0/00:04:0.0", "serial-base/port");
    let serial = root.join("sys/bus/pnp/drivers/serial");
    fs::create_dir_all(&serial).unwrap();
    symlink(serial, root.join("sys/devices/pnp0/00:04/driver")).unwrap();
    write(root.join("sys/devices/pnp0/00:04/00:04:0/00:04:0.0/tty/ttyS0/type"), b"4\n");
    port(root, "ttyS1", "platform/serial8250", "platform/serial8250");
    write(root.join("sys/devices/platform/serial8250/tty/ttyS1/type"), b"0\n");
    fs::create_dir_all(root.join("sys/class/tty/console")).unwrap();

    for name in ["ttyUSB9", "ttyUSB10", "ttyS0"] {
        write(root.join("dev").join(name), b"");
    }
    let by_id = root.join("dev/serial/by-id");
    fs::create_dir_all(&by_id).unwrap();
    symlink("../../ttyUSB10", by_id.join("usb-FTDI_FT230X_Basic_UART_D30AB1CD-if00-port0")).unwrap();
    write(root.join("etc/group"), b"root:x:0:\ndialout:x:20:\n");
}

fn ports(root: &Folder, args: &[&str]) -> Output {
    fatek(&[&["ports", "--root", root.0.to_str().unwrap()], args].concat())
}

#[test]
fn ports_have_driver_usb_names_and_stable_names() {
    let root = Folder::new("ports");
    system(&root.0);
    let found = ports(&root, &["--format", "json"]);
    assert!(
        found.stderr.contains("hint: to find the settings of a PLC: fatek detect /dev/serial/by-id/usb-FTDI_"),
        "{found:?}"
    );
    let found: Value = found.ok().parse().unwrap();
    let found = found.as_array().unwrap();
    let column = |key: &str| found.iter().map(|port| port[key].clone()).collect::<Vec<_>>();
    // In the order of their numbers; a place without a port, and a console, are none.
    assert_eq!(column("port"), ["/dev/ttyACM0", "/dev/ttyS0", "/dev/ttyUSB9", "/dev/ttyUSB10"]);
    assert_eq!(column("driver"), ["cdc_acm", "serial", "ch341-uart", "ftdi_sio"]);
    assert_eq!(column("usb"), [json!("0403:6015"), Value::Null, json!("1a86:7523"), json!("0403:6015")]);
    assert_eq!(column("product")[3], "FT230X Basic UART");
    assert_eq!(column("serial"), [json!("D30AB1CD"), Value::Null, Value::Null, json!("D30AB1CD")]);
    assert_eq!(column("by_id")[3], "/dev/serial/by-id/usb-FTDI_FT230X_Basic_UART_D30AB1CD-if00-port0");
    assert_eq!(column("by_id")[2], Value::Null);
    assert_eq!(column("access"), [false, true, true, true]);
    assert_eq!(column("note")[0], "no device file");
}

#[test]
fn tables_and_csv_have_the_same_ports() {
    let root = Folder::new("ports-table");
    system(&root.0);
    let table = ports(&root, &[]).ok();
    assert!(table.starts_with("PORT           DRIVER      USB        NAME                    SERIAL"), "{table}");
    assert_eq!(table.lines().count(), 5);
    assert!(table.contains("FTDI FT230X Basic UART") && table.contains(r"USB\u{1b}[31m Serial"), "{table}");
    assert!(table.lines().all(|line| line.chars().count() <= 80), "{table}");
    let csv = ports(&root, &["--format", "csv"]).ok();
    assert!(csv.starts_with("port,driver,usb,manufacturer,product,serial,by_id,access,note\n"), "{csv}");
    assert!(csv.contains("/dev/ttyS0,serial,,,,,,true,\n"), "{csv}");
}

/// The rights are those of the files in the fake system. The superuser has all of them.
#[test]
fn a_port_without_access_says_who_has_it() {
    let root = Folder::new("ports-access");
    system(&root.0);
    for name in ["ttyUSB9", "ttyUSB10", "ttyS0"] {
        let path = root.0.join("dev").join(name);
        fs::set_permissions(&path, fs::Permissions::from_mode(0o060)).unwrap();
    }
    let found = ports(&root, &["--format", "json"]);
    if rustix::process::geteuid().is_root() {
        assert!(found.stdout.contains("\"access\": true"), "{found:?}");
        return;
    }
    let found: Value = found.ok().parse().unwrap();
    assert_eq!(found[3]["access"], false);
    assert!(
        ["not for this user", "for the group "].iter().any(|note| found[3]["note"].as_str().unwrap().contains(note))
    );
}

#[test]
fn no_ports_are_an_empty_list_and_no_error() {
    let root = Folder::new("ports-none");
    fs::create_dir_all(root.0.join("sys/class/tty/console")).unwrap();
    let none = ports(&root, &["--format", "json"]);
    assert_eq!((none.status, none.stdout.as_str(), none.stderr.as_str()), (0, "[]\n", "no serial ports\n"));
    assert_eq!(ports(&root, &["--quiet"]).ok(), "");
}

#[test]
fn a_system_without_a_list_of_ports_is_an_error() {
    let root = Folder::new("ports-no-sys");
    let failed = ports(&root, &[]);
    assert_eq!((failed.status, failed.stdout.as_str()), (1, ""));
    assert!(failed.stderr.starts_with("error: cannot list the serial ports: "), "{failed:?}");
}
