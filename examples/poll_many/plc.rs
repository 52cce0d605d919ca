//! Contents and address of each simulated PLC.

use std::net::{Ipv4Addr, SocketAddr};

use fatek::sim::{Bus, Plc};
use fatek::{Register, register};

use crate::Result;

/// First polled register.
pub(crate) const FIRST: Register = register!("R0");

/// Number of polled registers.
pub(crate) const COUNT: usize = 10;

/// Register values of PLC `n`: its number, and values derived from it.
pub(crate) fn values(n: u32) -> [u16; COUNT] {
    std::array::from_fn(|i| match i {
        0 => (n & 0xFFFF) as u16,
        1 => (n >> 16) as u16,
        i => (n.wrapping_add(1).wrapping_mul(0x9E37_79B9) >> i) as u16,
    })
}

/// Returns PLC `n` as station 1 of a bus of its own.
pub(crate) fn bus(n: u32) -> Result<Bus> {
    let plc = Plc::new();
    for (i, value) in values(n).into_iter().enumerate() {
        plc.write(FIRST.nth(i)?, value)?;
    }
    Ok(Bus::new().with_station(1, plc)?)
}

/// Address of PLC `n`: a port of its own, or a loopback address of its own with the common port.
pub(crate) fn address(n: u32, ports: &[u16]) -> SocketAddr {
    match ports {
        [port] => (Ipv4Addr::from(FIRST_ADDRESS + n), *port).into(),
        ports => (Ipv4Addr::LOCALHOST, ports[n as usize]).into(),
    }
}

/// Number of the PLC with this loopback address.
pub(crate) fn number(at: Ipv4Addr) -> Option<u32> {
    u32::from(at).checked_sub(FIRST_ADDRESS)
}

/// Address 127.1.0.0 of PLC 0.
const FIRST_ADDRESS: u32 = 0x7F01_0000;
