//! Packets of a capture: addresses, ports and payload of TCP and UDP, below any link layer that
//! carries IP.

use std::net::{IpAddr, SocketAddr};

use etherparse::{EtherType, LaxNetSlice, LaxSlicedPacket, TransportSlice};

/// Link types of captures (<https://www.tcpdump.org/linktypes.html>).
const NULL: i32 = 0;
const ETHERNET: i32 = 1;
/// Raw IP has several numbers: of systems, and of the list.
const RAW_IP: i32 = 101;
const RAW: [i32; 5] = [12, 14, RAW_IP, 228, 229];
const LOOP: i32 = 108;
const LINUX_SLL: i32 = 113;
const LINUX_SLL2: i32 = 276;

/// Length of the header with the family of addresses of `NULL` and `LOOP`.
const FAMILY_LEN: usize = 4;
/// Length of the header, and position of the protocol in it.
const SLL: (usize, usize) = (16, 14);
const SLL2: (usize, usize) = (20, 0);

/// A packet of TCP or UDP.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Packet<'a> {
    pub(super) from: SocketAddr,
    pub(super) to: SocketAddr,
    pub(super) segment: Segment,
    pub(super) payload: &'a [u8],
    /// Bytes of the payload that the capture has cut off.
    pub(super) missing: usize,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Segment {
    Udp,
    Tcp {
        sequence: u32,
        /// Next byte that the sender expects.
        acknowledged: Option<u32>,
        begins: bool,
        /// FIN.
        ends: bool,
        /// RST.
        resets: bool,
    },
}

/// The reason why a packet is skipped.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Skipped {
    LinkType(i32),
    /// A part of an IP packet. Frames of PLCs fit into one.
    Fragment,
    /// Neither TCP nor UDP, or cut off in its headers.
    Other,
}

/// Parses a packet with a link layer of this type. Checksums are not checked: computers leave them to
/// the network card, behind the place of the capture.
pub(super) fn parse(link_type: i32, data: &[u8]) -> Result<Packet<'_>, Skipped> {
    let cooked = |(len, protocol): (usize, usize)| {
        let [high, low] = *data.get(protocol..).and_then(|rest| rest.first_chunk()).ok_or(Skipped::Other)?;
        let payload = data.get(len..).ok_or(Skipped::Other)?;
        Ok(LaxSlicedPacket::from_ether_type(EtherType(u16::from_be_bytes([high, low])), payload))
    };
    let ip = |data| LaxSlicedPacket::from_ip(data).map_err(|_| Skipped::Other);
    let sliced = match link_type {
        ETHERNET => LaxSlicedPacket::from_ethernet(data).map_err(|_| Skipped::Other)?,
        NULL | LOOP => ip(data.get(FAMILY_LEN..).ok_or(Skipped::Other)?)?,
        LINUX_SLL => cooked(SLL)?,
        LINUX_SLL2 => cooked(SLL2)?,
        raw if RAW.contains(&raw) => ip(data)?,
        other => return Err(Skipped::LinkType(other)),
    };
    of_ip(&sliced)
}

/// The payload of a packet that begins with Ethernet or IP.
pub(super) fn payload(data: &[u8]) -> Option<&[u8]> {
    [ETHERNET, RAW_IP].into_iter().find_map(|link_type| parse(link_type, data).ok()).map(|packet| packet.payload)
}

fn of_ip<'a>(sliced: &LaxSlicedPacket<'a>) -> Result<Packet<'a>, Skipped> {
    let net = sliced.net.as_ref().ok_or(Skipped::Other)?;
    let (source, destination, missing) = match net {
        LaxNetSlice::Ipv4(slice) => {
            let header = slice.header();
            let captured = header.slice().len() + slice.payload().payload.len();
            // With extensions the length is not known; the next segment shows it.
            let whole = if slice.extensions().auth.is_some() { 0 } else { usize::from(header.total_len()) };
            (IpAddr::V4(header.source_addr()), IpAddr::V4(header.destination_addr()), whole.saturating_sub(captured))
        }
        LaxNetSlice::Ipv6(slice) => {
            let header = slice.header();
            let whole = if slice.extensions().is_empty() { usize::from(header.payload_length()) } else { 0 };
            let missing = whole.saturating_sub(slice.payload().payload.len());
            (IpAddr::V6(header.source_addr()), IpAddr::V6(header.destination_addr()), missing)
        }
        LaxNetSlice::Arp(_) => return Err(Skipped::Other),
    };
    if net.ip_payload_ref().is_some_and(|payload| payload.fragmented) {
        return Err(Skipped::Fragment);
    }
    let (ports, segment, payload) = match sliced.transport.as_ref().ok_or(Skipped::Other)? {
        TransportSlice::Udp(udp) => ((udp.source_port(), udp.destination_port()), Segment::Udp, udp.payload()),
        TransportSlice::Tcp(tcp) => {
            let segment = Segment::Tcp {
                sequence: tcp.sequence_number(),
                acknowledged: tcp.ack().then(|| tcp.acknowledgment_number()),
                begins: tcp.syn(),
                ends: tcp.fin(),
                resets: tcp.rst(),
            };
            ((tcp.source_port(), tcp.destination_port()), segment, tcp.payload())
        }
        TransportSlice::Icmpv4(_) | TransportSlice::Icmpv6(_) | TransportSlice::Igmp(_) => return Err(Skipped::Other),
    };
    let (from, to) = (SocketAddr::new(source, ports.0), SocketAddr::new(destination, ports.1));
    Ok(Packet { from, to, segment, payload, missing })
}

#[cfg(test)]
mod tests {
    use etherparse::{EtherType, PacketBuilder};

    use super::*;

    const PAYLOAD: &[u8] = b"\x0201411F9\x03";

    fn tcp_v4() -> Vec<u8> {
        let builder = PacketBuilder::ipv4([10, 0, 0, 1], [10, 0, 0, 2], 64).tcp(4000, 500, 77, 1000).ack(88);
        let mut packet = Vec::new();
        builder.write(&mut packet, PAYLOAD).unwrap();
        packet
    }

    fn udp_v6() -> Vec<u8> {
        let builder = PacketBuilder::ipv6([1; 16], [2; 16], 64).udp(4000, 500);
        let mut packet = Vec::new();
        builder.write(&mut packet, PAYLOAD).unwrap();
        packet
    }

    #[test]
    fn every_link_layer_carries_both_versions_of_ip() {
        let v4 = |before: &[u8]| [before, &tcp_v4()].concat();
        let v6 = |before: &[u8]| [before, &udp_v6()].concat();
        let vlan = [&[0xFF; 12][..], &[0x81, 0, 0, 5, 0x08, 0]].concat();
        let sll = [&[0; 14][..], &[0x86, 0xDD]].concat();
        let sll2 = [&[0x08, 0][..], &[0; 18]].concat();
        for (link_type, data, is_udp) in [
            (ETHERNET, v4(&[&[1; 12][..], &[8, 0]].concat()), false),
            (ETHERNET, v4(&vlan), false),
            (NULL, v4(&[2, 0, 0, 0]), false),
            (NULL, v6(&[30, 0, 0, 0]), true),
            (LOOP, v6(&[0, 0, 0, 24]), true),
            (101, v4(&[]), false),
            (229, v6(&[]), true),
            (LINUX_SLL, v6(&sll), true),
            (LINUX_SLL2, v4(&sll2), false),
        ] {
            let packet = parse(link_type, &data).unwrap_or_else(|skipped| panic!("{link_type}: {skipped:?}"));
            let ports = (packet.from.port(), packet.to.port());
            assert_eq!((ports, packet.payload, packet.missing), ((4000, 500), PAYLOAD, 0), "{link_type}");
            let tcp = Segment::Tcp { sequence: 77, acknowledged: Some(88), begins: false, ends: false, resets: false };
            assert_eq!(packet.segment, if is_udp { Segment::Udp } else { tcp });
        }
        assert_eq!(EtherType::IPV4.0, 0x0800);
    }

    #[test]
    fn cut_off_packets_state_their_missing_bytes() {
        for (whole, link_type) in [(tcp_v4(), 101), (udp_v6(), 101)] {
            let cut = parse(link_type, &whole[..whole.len() - 4]).unwrap();
            assert_eq!((cut.payload, cut.missing), (&PAYLOAD[..PAYLOAD.len() - 4], 4));
        }
        for len in 0..20 {
            assert_eq!(parse(101, &tcp_v4()[..len]), Err(Skipped::Other));
        }
    }

    #[test]
    fn other_packets_are_skipped() {
        let mut fragment = tcp_v4();
        // More fragments.
        fragment[6] |= 0x20;
        assert_eq!(parse(101, &fragment), Err(Skipped::Fragment));
        assert_eq!(parse(147, &tcp_v4()), Err(Skipped::LinkType(147)));
        assert_eq!(parse(ETHERNET, &[0; 60]), Err(Skipped::Other));
    }

    proptest::proptest! {
        #[test]
        fn no_packet_makes_the_parser_panic(
            data in proptest::collection::vec(proptest::prelude::any::<u8>(), 0..200),
            link_type in proptest::sample::select(vec![0, 1, 101, 108, 113, 228, 229, 276, 7]),
            changes in proptest::collection::vec((0_usize..60, proptest::prelude::any::<u8>()), 0..6),
        ) {
            let _ = parse(link_type, &data);
            for mut packet in [tcp_v4(), udp_v6()] {
                for &(at, byte) in &changes {
                    let at = at % packet.len();
                    packet[at] = byte;
                }
                let _ = parse(link_type, &packet);
                let _ = parse(101, &packet);
            }
        }
    }
}
