use tokio_util::codec::Decoder;

use super::*;

/// The reply of a PLC with this quirk to a frame that is sent to the bus.
fn reply(quirk: Quirk, request: &[u8], framing: Framing) -> Vec<u8> {
    let plc = Plc::new();
    plc.add_quirk(quirk);
    plc.write(crate::register!("R0"), 0xABCD_u16).unwrap();
    let bus = Bus::new().with_station(1, plc).unwrap();
    let item = Codec::new(framing, Side::Plc).decode(&mut BytesMut::from(request)).unwrap().unwrap();
    let mut reply = BytesMut::new();
    bus.answer(&item, framing, &mut reply);
    reply.to_vec()
}

#[test]
fn each_quirk_changes_the_reply_it_is_about() {
    let read = b"\x02014601R0000070\x03";
    let ascii = |quirk, request: &[u8]| String::from_utf8(reply(quirk, request, Framing::Ascii)).unwrap();
    assert_eq!(ascii(Quirk::LowerCase, read), "\x0201460abcd87\x03");
    assert_eq!(ascii(Quirk::AnswersBadChecksum, b"\x02014601R0000071\x03"), "\x0201460ABCD07\x03");
    assert_eq!(ascii(Quirk::LowerCase, b"\x02014601R0000071\x03"), "");
    assert_eq!(&ascii(Quirk::AnswersAnyStation, b"\x02094601R0000078\x03")[..6], "\x0201460");
    assert_eq!(ascii(Quirk::DataWithErrors, b"\x02014601R0900079\x03"), "\x020146A0000CE\x03");
    assert_eq!(ascii(Quirk::reply(0x46, "01R00000", None), read), "");
    assert_eq!(&ascii(Quirk::reply(0x46, "01R00000", Some("3")), read)[..6], "\x0201463");
}

#[test]
fn quirks_are_those_of_the_binary_framing_too() {
    // R0, with a wrong checksum.
    let read = b"\x51\x10\x00\x06\x01\x46\x01R\x00\x00\x00\x00\x55\xAA";
    assert_eq!(reply(Quirk::AnswersBadChecksum, read, Framing::Binary)[4..9], [1, 0x46, 0, 0xAB, 0xCD]);
    assert_eq!(reply(Quirk::LowerCase, read, Framing::Binary), [0_u8; 0]);
}

#[test]
fn reads_and_loop_backs_change_places_as_the_quirk_says() {
    let order = |quirk: Option<Quirk>, commands: &[u8]| {
        let plc = Plc::new();
        quirk.into_iter().for_each(|quirk| plc.add_quirk(quirk));
        let bus = Bus::new().with_station(1, plc).unwrap();
        let frame = |&command: &u8| Received::Frame(Frame { station: 1, command, data: Bytes::new() });
        let mut items: Vec<_> = commands.iter().map(frame).collect();
        bus.reorder(&mut items);
        items.into_iter().map(|item| item.frame().unwrap().command).collect::<Vec<_>>()
    };
    assert_eq!(order(None, &[0x46, 0x44, 0x4E]), [0x46, 0x44, 0x4E]);
    assert_eq!(order(Some(Quirk::ReadsReversed), &[0x46, 0x44, 0x4E]), [0x44, 0x46, 0x4E]);
    assert_eq!(order(Some(Quirk::LoopBackFirst), &[0x46, 0x4E]), [0x4E, 0x46]);
    assert_eq!(order(Some(Quirk::LoopBackFirst), &[0x46, 0x44]), [0x46, 0x44]);
}
