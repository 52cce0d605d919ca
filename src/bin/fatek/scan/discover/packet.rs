//! Packets of the discovery of Ethernet modules.
//!
//! ```text
//! request  two datagrams of 8 bytes to UDP port 111, from port 53238
//! reply    351 bytes or more:
//!          0      0Ah
//!          5-6    58h 76h
//!          9      firmware times 10: 38h is 5.6
//!          11-16  MAC address
//!          17-20  IPv4 address      21-24  gateway      25-28  network mask
//!          29-40  name              41-62  description
//!          76-77  FATEK port        79-80  Modbus port, both big-endian
//! ```
//!
//! The source is one program of users (repository ConnectorIO/connectorio-addons), which names firmware
//! 5.6. No document of the maker was found, and no reply was seen by this project: the bytes that are
//! not in the table are not known, and neither is the meaning of the requests.

use std::net::Ipv4Addr;

/// Port of the modules.
pub(super) const PORT: u16 = 111;
/// Requests, in this order.
pub(super) const PACKETS: [[u8; 8]; 2] =
    [[0x13, 0x0C, 0x2F, 0x9B, 0x77, 0x70, 0x89, 0xAA], [0x09, 0x50, 0x83, 0x04, 0x5A, 0x22, 0x00, 0x22]];
/// Shortest reply.
const MIN_LEN: usize = 351;
/// Shortest text of an unknown reply that is shown, and the limit of these texts.
const MIN_TEXT: usize = 4;
const MAX_TEXTS: usize = 4;

/// A module, as its reply states it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Module {
    /// Times 10.
    pub(super) firmware: u8,
    pub(super) mac: [u8; 6],
    pub(super) address: Ipv4Addr,
    pub(super) gateway: Ipv4Addr,
    pub(super) mask: Ipv4Addr,
    pub(super) name: String,
    pub(super) description: String,
    pub(super) fatek_port: u16,
    pub(super) modbus_port: u16,
}

impl Module {
    /// Parses a reply; `None` if it is of another form.
    pub(super) fn parse(reply: &[u8]) -> Option<Self> {
        if reply.len() < MIN_LEN || reply.first() != Some(&0x0A) || reply.get(5..7) != Some(&[0x58, 0x76]) {
            return None;
        }
        let address = |at: usize| Some(Ipv4Addr::from(*reply.get(at..)?.first_chunk::<4>()?));
        let port = |at: usize| Some(u16::from_be_bytes(*reply.get(at..)?.first_chunk()?));
        Some(Self {
            firmware: *reply.get(9)?,
            mac: *reply.get(11..)?.first_chunk()?,
            address: address(17)?,
            gateway: address(21)?,
            mask: address(25)?,
            name: text(reply.get(29..41)?),
            description: text(reply.get(41..63)?),
            fatek_port: port(76)?,
            modbus_port: port(79)?,
        })
    }

    pub(super) fn firmware_text(&self) -> String {
        format!("{}.{}", self.firmware / 10, self.firmware % 10)
    }

    pub(super) fn mac_text(&self) -> String {
        self.mac.map(|byte| format!("{byte:02x}")).join(":")
    }
}

/// A text of fixed length, up to its first NUL and without blanks around it.
fn text(field: &[u8]) -> String {
    let end = field.iter().position(|&byte| byte == 0).unwrap_or(field.len());
    String::from_utf8_lossy(field.get(..end).unwrap_or_default()).trim().to_owned()
}

/// The first readable texts of a reply of unknown form, in quotes.
pub(super) fn texts(reply: &[u8]) -> Vec<String> {
    let runs = reply.split(|byte| !(0x20..=0x7E).contains(byte));
    let texts = runs.map(|run| String::from_utf8_lossy(run).trim().to_owned());
    texts.filter(|text| text.len() >= MIN_TEXT).take(MAX_TEXTS).map(|text| format!("\"{text}\"")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A reply of the documented form. The bytes that are not known are FFh.
    fn reply() -> Vec<u8> {
        let mut reply = vec![0xFF; MIN_LEN];
        reply[0] = 0x0A;
        reply[5..7].copy_from_slice(&[0x58, 0x76]);
        reply[9] = 0x38;
        reply[11..17].copy_from_slice(&[0, 0x0D, 0xE0, 1, 2, 3]);
        reply[17..29].copy_from_slice(&[192, 168, 2, 3, 192, 168, 2, 1, 255, 255, 255, 0]);
        reply[29..41].copy_from_slice(b"PUMP1\0\0\0\0\0\0\0");
        reply[41..63].copy_from_slice(b"Boiler house          ");
        reply[76..78].copy_from_slice(&[0x01, 0xF4]);
        reply[79..81].copy_from_slice(&[0x01, 0xF6]);
        reply
    }

    #[test]
    fn a_reply_has_the_documented_fields() {
        let module = Module::parse(&reply()).unwrap();
        assert_eq!((module.name.as_str(), module.description.as_str()), ("PUMP1", "Boiler house"));
        assert_eq!((module.firmware_text(), module.mac_text()), ("5.6".to_owned(), "00:0d:e0:01:02:03".to_owned()));
        assert_eq!((module.fatek_port, module.modbus_port), (500, 502));
        let addresses = [module.address, module.gateway, module.mask].map(|address| address.to_string());
        assert_eq!(addresses, ["192.168.2.3", "192.168.2.1", "255.255.255.0"]);
        assert_eq!(Module::parse(&[&reply()[..], &[0; 100]].concat()), Some(module), "longer replies");
    }

    #[test]
    fn replies_of_another_form_are_unknown() {
        assert_eq!(Module::parse(&reply()[..350]), None);
        for (at, byte) in [(0, 0x0B), (5, 0x59), (6, 0x77)] {
            let mut other = reply();
            other[at] = byte;
            assert_eq!(Module::parse(&other), None, "byte {at}");
        }
        assert_eq!(Module::parse(b""), None);
        assert_eq!(texts(b"\x00\x01FATEK CBE\xff\xff192.168.2.3 \x00ab\x00"), ["\"FATEK CBE\"", "\"192.168.2.3\""]);
        assert_eq!(texts(&b"text\0".repeat(9)).len(), MAX_TEXTS);
    }
}
