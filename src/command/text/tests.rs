use bytes::Bytes;

use crate::command::*;
use crate::element::{Discrete, Element, Register, Symbol};
use crate::wire::{AsciiReader, FieldReader, Frame};
use crate::{discrete, element, register, register32};

/// Texts of a request, and of the request with its reply.
fn texts<C: Command>(request: C, reply: C::Reply) -> [String; 2] {
    [request.to_string(), ForwardedReply::new(request, reply).to_string()]
}

fn assert_texts<C: Command>(request: C, reply: C::Reply, expected: &str, reply_text: &str) {
    assert_eq!(texts(request, reply), [expected.to_owned(), format!("{expected}: {reply_text}")]);
}

#[test]
fn the_text_of_a_command_has_its_name_and_fields() {
    let control = |control| ControlDiscrete::new(control, discrete!("X3"));
    assert_texts(
        ReadStatus,
        BriefStatus::from_raw([0x21, 0x40, 0]),
        "read brief status (40h)",
        "RUN, id set (21 40 00)",
    );
    assert_texts(ControlPlc::Run, (), "control RUN/STOP (41h) run", "done");
    assert_texts(ControlPlc::Stop, (), "control RUN/STOP (41h) stop", "done");
    for (effect, name) in [
        (DiscreteControl::Disable, "disable"),
        (DiscreteControl::Enable, "enable"),
        (DiscreteControl::Set, "set"),
        (DiscreteControl::Reset, "reset"),
    ] {
        assert_texts(control(effect), (), &format!("control one discrete (42h) {name} X3"), "done");
    }
    let disabled = ReadDisabled::new(discrete!("M0"), 1).unwrap();
    assert_texts(disabled, vec![true], "read enable/disable (43h) M0", "1");
    let discretes = ReadDiscretes::new(discrete!("M0"), 3).unwrap();
    assert_texts(discretes, vec![true, false, true], "read discretes (44h) M0 to M2", "1, 0, 1");
    let write = WriteDiscretes::new(discrete!("Y7"), [false, true]).unwrap();
    assert_texts(write, (), "write discretes (45h) Y7 to Y8 = 0, 1", "done");
    let registers = ReadRegisters::new(register!("R12"), 3).unwrap();
    assert_texts(registers, vec![1, 2, 65535], "read registers (46h) R12 to R14", "1, 2, 65535");
    let registers32 = ReadRegisters::new(register32!("DR10"), 2).unwrap();
    assert_texts(registers32, vec![7, u32::MAX], "read registers (46h) DR10 to DR12", "7, 4294967295");
    let write = WriteRegisters::new(register!("R0"), [5]).unwrap();
    assert_texts(write, (), "write registers (47h) R0 = 5", "done");
    let mixed = ReadMixed::new([element!("R0"), element!("DR100"), element!("X3")]).unwrap();
    let values = vec![Value::Word(1), Value::DWord(2), Value::Bit(true)];
    assert_texts(mixed, values, "mixed read (48h) R0, DR100, X3", "1, 2, 1");
    let write = WriteMixed::new([(element!("WM8"), Value::Word(9)), (element!("Y0"), Value::Bit(false))]).unwrap();
    assert_texts(write, (), "mixed write (49h) WM8 = 9, Y0 = 0", "done");
    assert_texts(LoopBack::new("").unwrap(), (), r#"loop back (4Eh) """#, "done");
    assert_texts(LoopBack::new("a\"\\z").unwrap(), (), r#"loop back (4Eh) "a\"\\z""#, "done");
    assert_texts(LoopBack::new(&b"a\x1b\xff"[..]).unwrap(), (), "loop back (4Eh) 61 1B FF", "done");
}

#[test]
fn the_text_of_a_page_has_its_first_16_words() {
    let page = ProgramPage::new(std::array::from_fn(|i| 0xFB00 + u16::try_from(i).unwrap()));
    let words = "FB00, FB01, FB02, FB03, FB04, FB05, FB06, FB07, FB08, FB09, FB0A, FB0B, FB0C, FB0D, FB0E, FB0F ... \
                 (64 in all)";
    assert_texts(ReadProgramPage::new(206), page.clone(), "read program page (4Fh) 206", words);
    assert_texts(WriteProgramPage::new(1, page), (), &format!("write program page (50h) 1 = {words}"), "done");
}

#[test]
fn the_text_of_a_detailed_status_has_type_and_size() {
    let mut raw = [0; 64];
    raw[..6].copy_from_slice(&[0x02, 0x01, 0x06, 0x31, 0x33, 0x80]);
    let text = "STOP, battery low; main unit MC, OS 3.1, ladder of 13184 words";
    assert_texts(ReadDetailedStatus, raw.into(), "read detailed status (53h)", text);
}

#[test]
fn long_lists_and_data_are_cut() {
    let numbers = (0..16).map(|n| n.to_string()).collect::<Vec<_>>().join(", ");
    for (count, suffix) in [(16, ""), (17, " ... (17 in all)"), (64, " ... (64 in all)")] {
        let values: Vec<u16> = (0..count).collect();
        let last = count - 1;
        let write = WriteRegisters::new(register!("R0"), values).unwrap();
        assert_eq!(write.to_string(), format!("write registers (47h) R0 to R{last} = {numbers}{suffix}"));
        let list: Vec<Element> = (0..count).map(|n| Register::r(n).into()).collect();
        let elements = (0..16).map(|n| format!("R{n}")).collect::<Vec<_>>().join(", ");
        assert_eq!(ReadMixed::new(list).unwrap().to_string(), format!("mixed read (48h) {elements}{suffix}"));
    }
    let loop_back = |len| LoopBack::new(vec![b'x'; len]).unwrap().to_string();
    let shown = "x".repeat(64);
    assert_eq!(loop_back(64), format!("loop back (4Eh) \"{shown}\""));
    assert_eq!(loop_back(65), format!("loop back (4Eh) \"{shown}\" ... (65 bytes)"));
}

#[test]
fn a_run_without_a_last_element_has_its_count() {
    let mut fields = AsciiReader::new(b"02RC0199");
    let request = Request::read(Code::ReadRegisters, &mut fields).unwrap();
    assert!(fields.is_empty());
    assert_eq!(request.to_string(), "read registers (46h) 2 elements from RC199");
    let last = ReadDiscretes::new(Discrete::new(Symbol::M, 9999).unwrap(), 1).unwrap();
    assert_eq!(last.to_string(), "read discretes (44h) M9999");
}

#[test]
fn the_text_of_a_frame_has_station_command_and_data() {
    for (station, command, data, text) in [
        (1, 0x46, &b"03R00012"[..], r#"station 1: read registers (46h) "03R00012""#),
        (254, 0x46, b"\x03R\x00\x0C", "station 254: read registers (46h) 03 52 00 0C"),
        (0, 0x41, b"1", r#"broadcast: control RUN/STOP (41h) "1""#),
        (255, 0x40, b"", "station 255: read brief status (40h)"),
        (7, 0x99, b"\n", "station 7: command 99h 0A"),
        (7, 0x0A, b"say \"\\\"", r#"station 7: command 0Ah "say \"\\\"""#),
    ] {
        assert_eq!(Frame { station, command, data: Bytes::from_static(data) }.to_string(), text);
    }
    let data = Bytes::from(vec![0x80; 65_530]);
    let long = Frame { station: 1, command: 0x4E, data }.to_string();
    assert_eq!(long, format!("station 1: loop back (4Eh) {} ... (65530 bytes)", ["80"; 64].join(" ")));
}
