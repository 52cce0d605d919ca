use std::time::Duration;

use super::*;

const CLIENT: &str = "10.0.0.9:40000";
const PLC: &str = "10.0.0.3:500";

/// Packets of TCP with flags `S`, `F`, `R` and `A`.
fn tcp(from: &str, to: &str, flags: &str, sequence: u32, ack: u32, payload: &'static [u8]) -> Packet<'static> {
    let segment = Segment::Tcp {
        sequence,
        acknowledged: flags.contains('A').then_some(ack),
        begins: flags.contains('S'),
        ends: flags.contains('F'),
        resets: flags.contains('R'),
    };
    Packet { from: from.parse().unwrap(), to: to.parse().unwrap(), segment, payload, missing: 0 }
}

/// Changes of events, in short.
fn shown(events: &[Event]) -> Vec<String> {
    let text = |event: &Event| {
        let number = event.connection;
        match &event.change {
            Change::Open(ends) => format!("{number} open {ends}"),
            Change::Bytes { direction: Direction::ToPlc, bytes, .. } => format!("{number} > {}", bytes.escape_ascii()),
            Change::Bytes { direction: Direction::FromPlc, bytes, .. } => {
                format!("{number} < {}", bytes.escape_ascii())
            }
            Change::Missing { direction, count } => format!("{number} {count} missing {direction}"),
            Change::Close => format!("{number} close"),
        }
    };
    events.iter().map(text).collect()
}

fn run(flows: &mut Flows<'_>, packets: &[Packet<'_>]) -> Vec<String> {
    packets.iter().flat_map(|packet| shown(&flows.push(Duration::ZERO, packet))).collect()
}

#[test]
fn a_connection_has_a_beginning_bytes_and_an_end() {
    let mut flows = Flows::new(&[500]);
    let packets = [
        tcp(CLIENT, PLC, "S", 10, 0, b""),
        tcp(PLC, CLIENT, "SA", 90, 11, b""),
        tcp(CLIENT, PLC, "A", 11, 91, b"ask"),
        tcp(PLC, CLIENT, "A", 91, 14, b"reply"),
        tcp(CLIENT, PLC, "FA", 14, 96, b""),
        tcp(PLC, CLIENT, "FA", 96, 15, b""),
        // The last acknowledgement begins no other connection.
        tcp(CLIENT, PLC, "A", 15, 97, b""),
    ];
    let expected = ["1 open tcp 10.0.0.9:40000 > 10.0.0.3:500", "1 > ask", "1 < reply", "1 close"];
    assert_eq!(run(&mut flows, &packets), expected);
    assert!(flows.finish(Duration::ZERO).is_empty());
}

#[test]
fn the_same_ports_again_are_another_connection() {
    let mut flows = Flows::new(&[500]);
    let packets = [
        tcp(CLIENT, PLC, "S", 10, 0, b""),
        tcp(CLIENT, PLC, "A", 11, 0, b"a"),
        tcp(CLIENT, PLC, "S", 5000, 0, b""),
        tcp(CLIENT, PLC, "A", 5001, 0, b"b"),
        // One end is sufficient.
        tcp(PLC, CLIENT, "RA", 1, 5002, b""),
    ];
    let expected = [
        "1 open tcp 10.0.0.9:40000 > 10.0.0.3:500",
        "1 > a",
        "1 close",
        "2 open tcp 10.0.0.9:40000 > 10.0.0.3:500",
        "2 > b",
        "2 close",
    ];
    assert_eq!(run(&mut flows, &packets), expected);
    assert!(flows.finish(Duration::ZERO).is_empty());
}

#[test]
fn lost_packets_are_missing_when_their_receiver_has_them() {
    let mut flows = Flows::new(&[500]);
    let packets = [
        tcp(CLIENT, PLC, "A", 11, 91, b"ab"),
        tcp(CLIENT, PLC, "A", 15, 91, b"ef"),
        tcp(PLC, CLIENT, "A", 91, 17, b"x"),
        tcp(CLIENT, PLC, "A", 20, 92, b"h"),
    ];
    let expected = ["1 open tcp 10.0.0.9:40000 > 10.0.0.3:500", "1 > ab", "1 < x", "1 2 missing to the PLC", "1 > ef"];
    assert_eq!(run(&mut flows, &packets), expected);
    assert_eq!(shown(&flows.finish(Duration::ZERO)), ["1 3 missing to the PLC", "1 > h", "1 close"]);
}

#[test]
fn the_first_sender_is_the_client_if_both_ports_are_known() {
    let mut flows = Flows::new(&[500]);
    let udp = |from: &str, to: &str, payload| Packet { segment: Segment::Udp, ..tcp(from, to, "", 0, 0, payload) };
    let packets = [
        udp("[::1]:500", "[::2]:500", b"ask"),
        udp("[::2]:500", "[::1]:500", b"reply"),
        udp("[::9]:7", "[::8]:9", b"x"),
    ];
    assert_eq!(run(&mut flows, &packets), ["1 open udp [::1]:500 > [::2]:500", "1 > ask", "1 < reply"]);
    assert_eq!((flows.other_port(), flows.connections()), (Some(7), 1));
}

#[test]
fn many_connections_make_room() {
    let mut flows = Flows::new(&[500]);
    let mut open = std::collections::BTreeSet::new();
    for number in 0..5 * MAX_FLOWS {
        let client = format!("10.1.{}.{}:7", number >> 8, number & 0xFF);
        for event in flows.push(Duration::ZERO, &tcp(&client, PLC, "S", 1, 0, b"")) {
            let is_known = match event.change {
                Change::Open(_) => open.insert(event.connection),
                Change::Bytes { .. } | Change::Missing { .. } => open.contains(&event.connection),
                Change::Close => open.remove(&event.connection),
            };
            assert!(is_known, "{event:?}");
        }
        assert!(flows.by_key.len() <= MAX_FLOWS);
        assert_eq!(flows.by_key.len(), open.len());
    }
    assert_eq!(flows.connections(), 5 * MAX_FLOWS as u64);
}
