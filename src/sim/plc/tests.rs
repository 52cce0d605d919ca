use super::*;
use crate::command::{
    ControlDiscrete, ControlPlc, DiscreteControl, PAGE_WORDS, ReadDetailedStatus, ReadDisabled, ReadMixed,
    ReadProgramPage, ReadRegisters, ReadStatus, WriteDiscretes, WriteMixed, WriteProgramPage, WriteRegisters,
};
use crate::memory_map::PlcModel;
use crate::{discrete, element, register, register32};

#[test]
fn clones_are_the_same_plc() {
    let plc = Plc::new();
    plc.clone().write(register!("R0"), 7_u16).unwrap();
    assert_eq!(plc.read(register!("R0")), Value::Word(7));
}

#[test]
fn a_disabled_discrete_ignores_the_process() {
    let plc = Plc::new();
    control(&plc, DiscreteControl::Disable, discrete!("X9"));
    plc.write(element!("WX0"), 0xFFFF_u16).unwrap();
    assert_eq!(plc.read(element!("WX0")), Value::Word(0xFDFF));
    assert!(plc.is_disabled(discrete!("X9")));
    assert!(!plc.is_disabled(discrete!("X8")));
    // The same address in another area is another discrete.
    plc.write(discrete!("Y9"), true).unwrap();
    assert_eq!(plc.read(discrete!("Y9")), Value::Bit(true));
}

#[test]
fn enabling_applies_the_last_write_of_the_process() {
    let plc = Plc::new();
    plc.write(discrete!("X0"), true).unwrap();
    control(&plc, DiscreteControl::Disable, discrete!("X0"));
    plc.write(discrete!("X0"), false).unwrap();
    control(&plc, DiscreteControl::Disable, discrete!("X0")); // again, without effect
    assert_eq!(plc.read(discrete!("X0")), Value::Bit(true));
    control(&plc, DiscreteControl::Enable, discrete!("X0"));
    assert_eq!(plc.read(discrete!("X0")), Value::Bit(false));
}

#[test]
fn enabling_keeps_the_forced_state_without_a_write() {
    let plc = Plc::new();
    control(&plc, DiscreteControl::Disable, discrete!("M5"));
    control(&plc, DiscreteControl::Set, discrete!("M5"));
    control(&plc, DiscreteControl::Enable, discrete!("M5"));
    assert_eq!(plc.read(discrete!("M5")), Value::Bit(true));
}

#[test]
fn every_write_command_sets_disabled_discretes() {
    let plc = Plc::new();
    let relay = discrete!("M0");
    control(&plc, DiscreteControl::Disable, relay);

    control(&plc, DiscreteControl::Set, relay);
    assert_eq!(plc.read(relay), Value::Bit(true));
    control(&plc, DiscreteControl::Reset, relay);
    assert_eq!(plc.read(relay), Value::Bit(false));
    plc.execute(&WriteDiscretes::new(relay, [true]).unwrap()).unwrap();
    assert_eq!(plc.read(relay), Value::Bit(true));
    plc.execute(&WriteRegisters::new(register!("WM0"), [0]).unwrap()).unwrap();
    assert_eq!(plc.read(relay), Value::Bit(false));
    plc.execute(&WriteMixed::new([(element!("DWM0"), Value::DWord(1))]).unwrap()).unwrap();
    assert_eq!(plc.read(relay), Value::Bit(true));
    assert!(plc.is_disabled(relay));
}

#[test]
fn command_43_reports_disabled_discretes_as_1() {
    let plc = Plc::new();
    for output in [discrete!("Y10"), discrete!("Y12"), discrete!("Y16")] {
        control(&plc, DiscreteControl::Disable, output);
    }
    let states = plc.execute(&ReadDisabled::new(discrete!("Y10"), 7).unwrap());
    assert_eq!(states, Ok(vec![true, false, true, false, false, false, true]));
}

#[test]
fn run_and_stop_show_in_the_status() {
    let plc = Plc::new();
    assert!(!plc.is_running());
    plc.execute(&ControlPlc::Run).unwrap();
    assert!(plc.is_running());
    assert!(plc.execute(&ReadStatus).unwrap().flags().running());
    assert!(plc.execute(&ReadDetailedStatus).unwrap().flags().running());
    plc.execute(&ControlPlc::Stop).unwrap();
    assert!(!plc.is_running());
    plc.run();
    assert!(plc.is_running());
    plc.stop();
    assert!(!plc.is_running());
}

#[test]
fn a_plc_that_refuses_run_still_accepts_stop() {
    let plc = Plc::new();
    plc.refuse_run(Some(ErrorCode::LadderChecksum));
    assert_eq!(plc.execute(&ControlPlc::Run), Err(ErrorCode::LadderChecksum));
    assert!(!plc.is_running());
    plc.run();
    assert_eq!(plc.execute(&ControlPlc::Stop), Ok(()));
    assert!(!plc.is_running());
    plc.refuse_run(None);
    assert_eq!(plc.execute(&ControlPlc::Run), Ok(()));
}

#[test]
fn every_flag_has_its_own_bit() {
    let plc = Plc::new();
    plc.run();
    plc.set_memory_card(true);
    plc.set_id_set(true);
    assert_eq!(plc.flags(), StatusFlags(0x29)); // the manual's example of 40
    plc.set_battery_low(true);
    plc.set_ladder_checksum_error(true);
    plc.set_watchdog_timeout(true);
    plc.set_emergency_stop(true);
    assert_eq!(plc.flags(), StatusFlags(0x7F));
    plc.set_memory_card(false);
    plc.stop();
    assert_eq!(plc.flags(), StatusFlags(0x76));
}

#[test]
fn the_default_model_is_the_one_of_the_manuals_example() {
    let plc = Plc::new();
    plc.set_id_set(true);
    plc.run();
    let status = plc.execute(&ReadDetailedStatus).unwrap();
    let example = b"\x21\x01\x02\x31\x33\x80\x01\x00\x01\x00\x00\x64\x00\x64\
        \x07\xD2\x03\xE8\x00\x00\x1F\x88\x0C\x00\x01\x00\x01\x00";
    assert_eq!(status.raw().len(), 64);
    assert_eq!(status.raw()[..28], example[..]);
    assert!(status.raw()[28..].iter().all(|&byte| byte == 0));
}

#[test]
fn a_model_reports_the_status_that_was_set() {
    let model = Model::default()
        .program_capacity(0x40)
        .main_unit(0)
        .io_points_code(6)
        .os_version(4, 0)
        .ladder_words(1)
        .discrete_inputs(2)
        .discrete_outputs(3)
        .analog_inputs(4)
        .analog_outputs(5)
        .m_relays(6)
        .s_relays(7)
        .l_relays(8)
        .r_registers(9)
        .d_registers(10)
        .timers(11)
        .counters(0xFFFF);
    let plc = Plc::with_model(model);
    assert_eq!(plc.execute(&ReadStatus).unwrap().raw(), [0, 0x40, 0]);
    let status = plc.execute(&ReadDetailedStatus).unwrap();
    assert_eq!(status.raw()[..4], [0, 0, 6, 0x40]);
    let words: Vec<_> = status.raw()[4..28].chunks_exact(2).map(|w| u16::from_be_bytes([w[0], w[1]])).collect();
    assert_eq!(words, [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 0xFFFF]);
}

#[test]
fn the_last_element_limits_all_widths() {
    let plc = Plc::with_model(Model::largest().last(element!("M2001")).last(element!("DR100")));
    for (element, value) in [
        (element!("M2001"), Value::Bit(true)),
        (element!("WM1984"), Value::Word(1)),
        (element!("R101"), Value::Word(1)),
        (element!("DR100"), Value::DWord(1)),
        (element!("S9999"), Value::Bit(true)),
        (element!("DD65534"), Value::DWord(1)),
    ] {
        assert_eq!(plc.write(element, value), Ok(()));
    }
    for (element, value) in [
        (element!("M2002"), Value::Bit(true)),
        (element!("WM1992"), Value::Word(1)),
        (element!("DWM1976"), Value::DWord(1)),
        (element!("R102"), Value::Word(1)),
        (element!("DR101"), Value::DWord(1)),
    ] {
        assert_eq!(plc.write(element, value), Err(Error::BeyondModel { element }));
    }
}

#[test]
fn the_default_has_the_gap_and_the_ends_of_an_fbe_28mc() {
    let plc = Plc::new();
    let run =
        |first, count| plc.execute(&ReadRegisters::new(first, count).unwrap()).map(|values: Vec<u16>| values.len());
    assert_eq!(run(register!("R4160"), 8), Ok(8));
    assert_eq!(run(register!("R4160"), 9), Err(ErrorCode::IllegalAddress));
    assert_eq!(run(register!("R4999"), 2), Err(ErrorCode::IllegalAddress));
    assert_eq!(run(register!("R8010"), 62), Ok(62));
    for missing in [element!("R8072"), element!("D3072"), element!("M2002"), element!("F0"), element!("DR4167")] {
        let error = plc.execute(&ReadMixed::new([missing]).unwrap()).unwrap_err();
        assert_eq!(error, ErrorCode::IllegalAddress, "{missing}");
    }
    let newer = Plc::with_model(Model::of(PlcModel::Fbs20Mc));
    assert_eq!(newer.write(element!("D4095"), Value::Word(1)), Ok(()));
    assert_eq!((newer.pages(), Plc::new().pages()), (513, 207));
}

#[test]
fn the_last_element_keeps_gaps_below_it() {
    let plc = Plc::with_model(Model::default().last(element!("R9999")).last(element!("F10")));
    for (element, exists) in [("R9999", true), ("R4500", false), ("F10", true), ("F11", false)] {
        let written = plc.write(element.parse::<Element>().unwrap(), 1_u16);
        assert_eq!(written.is_ok(), exists, "{element}");
    }
    // The gap is above this one.
    let small = Plc::with_model(Model::default().last(element!("R4100")));
    assert!(small.write(element!("R4101"), 1_u16).is_err() && small.write(element!("R5000"), 1_u16).is_err());
}

#[test]
fn a_request_beyond_the_model_changes_nothing() {
    let plc = Plc::with_model(Model::default().last(element!("M3")).last(element!("R3")));
    let refused = Err(ErrorCode::IllegalAddress);
    assert_eq!(plc.execute(&WriteDiscretes::new(discrete!("M2"), [true; 3]).unwrap()), refused);
    assert_eq!(plc.execute(&WriteRegisters::new(register!("R2"), [1, 1, 1]).unwrap()), refused);
    assert_eq!(plc.execute(&WriteRegisters::new(register32!("DR0"), [1, 1, 1]).unwrap()), refused);
    let items = [(element!("R0"), Value::Word(1)), (element!("R4"), Value::Word(1))];
    assert_eq!(plc.execute(&WriteMixed::new(items).unwrap()), refused);
    for control in [DiscreteControl::Disable, DiscreteControl::Enable, DiscreteControl::Set, DiscreteControl::Reset] {
        assert_eq!(plc.execute(&ControlDiscrete::new(control, discrete!("M4"))), refused);
    }
    assert!(!plc.is_disabled(discrete!("M4")));
    assert_eq!(plc.execute(&ReadRegisters::new(register!("R0"), 4).unwrap()), Ok(vec![0; 4]));
    assert_eq!(plc.read(discrete!("M2")), Value::Bit(false));
}

#[test]
fn the_header_is_built_from_the_ladder_size() {
    for (words, pages, size) in
        [(8192, 129, [0x20, 0x00]), (13_184, 207, [0x33, 0x80]), (65, 3, [0, 65]), (0, 1, [0, 0])]
    {
        let plc = Plc::with_model(Model::default().ladder_words(words).program_mark(*b"FM12"));
        assert_eq!(plc.pages(), pages);
        let header = plc.execute(&ReadProgramPage::new(0)).unwrap().to_bytes();
        assert_eq!(header[..4], *b"FM12");
        assert_eq!(header[4..6], size);
        assert!(header[6..].iter().all(|&byte| byte == 0xFF));
        assert_eq!(plc.execute(&ReadProgramPage::new(pages)), Err(ErrorCode::IllegalAddress));
        assert_eq!(plc.page(pages), None);
    }
}

#[test]
fn a_program_write_needs_stop_and_no_memory_card() {
    let plc = Plc::new();
    let content = ProgramPage::new([0x1234; PAGE_WORDS]);
    let write = |page| plc.execute(&WriteProgramPage::new(page, content.clone()));

    plc.run();
    assert_eq!(write(1), Err(ErrorCode::IllegalFormat));
    plc.set_memory_card(true);
    assert_eq!(write(1), Err(ErrorCode::WriteProhibited));
    plc.stop();
    assert_eq!(write(1), Err(ErrorCode::WriteProhibited));
    plc.set_memory_card(false);
    assert_eq!(plc.page(1), Some(ProgramPage::new([0; PAGE_WORDS])));
    assert_eq!(write(1), Ok(()));
    assert_eq!(write(206), Ok(()));
    assert_eq!(write(207), Err(ErrorCode::IllegalAddress));
    assert_eq!(plc.execute(&ReadProgramPage::new(206)), Ok(content.clone()));
    assert_eq!(plc.page(1), Some(content.clone()));
    assert_eq!(plc.set_page(207, content), Err(Error::BeyondProgram { page: 207, last: 206 }));
}

#[test]
fn a_new_plc_takes_a_few_hundred_bytes() {
    assert!(size_of::<PlcInner>() <= 320, "{}", size_of::<PlcInner>());
}

fn control(plc: &Plc, control: DiscreteControl, discrete: Discrete) {
    plc.execute(&ControlDiscrete::new(control, discrete)).unwrap();
}
