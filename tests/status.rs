//! Brief and detailed status: the position of each field, and the meaning of the codes.

use fatek::command::{
    BriefStatus, DetailedStatus, LoopBack, MainUnit, ProgramCapacity, ProgramPage, Series, StatusFlags,
};

#[test]
fn each_flag_bit_is_one_state() {
    type State = (fn(StatusFlags) -> bool, &'static str);
    let states: [State; 7] = [
        (StatusFlags::running, "RUN"),
        (StatusFlags::battery_low, "STOP, battery low"),
        (StatusFlags::ladder_checksum_error, "STOP, ladder checksum error"),
        (StatusFlags::memory_card, "STOP, memory card in use"),
        (StatusFlags::watchdog_timeout, "STOP, watchdog timeout"),
        (StatusFlags::id_set, "STOP, id set"),
        (StatusFlags::emergency_stop, "STOP, emergency stop"),
    ];
    for (bit, (_, text)) in states.iter().enumerate() {
        let flags = StatusFlags(1 << bit);
        assert_eq!(flags.to_string(), *text);
        for (other, (state, name)) in states.iter().enumerate() {
            assert_eq!(state(flags), other == bit, "bit {bit}: {name}");
            assert_eq!(state(StatusFlags(!flags.0)), other != bit, "all but bit {bit}: {name}");
        }
    }
    assert_eq!(StatusFlags(0x80).to_string(), "STOP", "B7 has no meaning");
    let all = "RUN, battery low, ladder checksum error, memory card in use, watchdog timeout, id set, emergency stop";
    assert_eq!(StatusFlags(0xFF).to_string(), all);
}

#[test]
fn a_brief_status_is_its_three_bytes() {
    let status = BriefStatus::from_raw([0x21, 0x54, 0xA5]);
    assert_eq!(status.raw(), [0x21, 0x54, 0xA5]);
    assert_eq!((status.flags(), status.capacity()), (StatusFlags(0x21), ProgramCapacity::Fbe13K));
}

#[test]
fn each_documented_capacity_has_its_name() {
    let named = [
        (0x00, "not stated"),
        (0xFF, "FB 8K"),
        (0x53, "FBE 8K"),
        (0x54, "FBE 13K"),
        (0x55, "FBN 8K"),
        (0x56, "FBN 13K"),
    ];
    for byte in 0..=0xFF_u8 {
        let text = named.iter().find(|(code, _)| *code == byte).map(|(_, name)| (*name).to_owned());
        let expected = text.unwrap_or_else(|| format!("unknown ({byte:02X}h)"));
        assert_eq!(ProgramCapacity::from(byte).to_string(), expected);
    }
}

#[test]
fn each_documented_main_unit_has_its_name() {
    for (byte, unit, name) in [
        (0x00, MainUnit::MaMu, "MA/MU"),
        (0x01, MainUnit::Mc, "MC"),
        (0x02, MainUnit::Unknown(0x02), "unknown (02h)"),
        (0xFF, MainUnit::Unknown(0xFF), "unknown (FFh)"),
    ] {
        assert_eq!(MainUnit::from(byte), unit);
        assert_eq!(unit.to_string(), name);
    }
}

/// A status whose byte n is n: STATUS1 is byte 1, STATUS64 byte 64.
fn numbered() -> DetailedStatus {
    DetailedStatus::from(std::array::from_fn::<u8, 64, _>(|i| u8::try_from(i + 1).expect("64 fit")))
}

#[test]
fn each_field_of_a_detailed_status_is_read_from_its_own_bytes() {
    let status = numbered();
    assert_eq!((status.flags(), status.main_unit()), (StatusFlags(1), MainUnit::Unknown(2)));
    assert_eq!((status.io_points_code(), status.os_version()), (3, (0, 4)));
    let words = [
        (status.ladder_words(), 5),
        (status.discrete_inputs(), 7),
        (status.discrete_outputs(), 9),
        (status.analog_inputs(), 11),
        (status.analog_outputs(), 13),
        (status.m_relays(), 15),
        (status.s_relays(), 17),
        (status.l_relays(), 19),
        (status.r_registers(), 21),
        (status.d_registers(), 23),
        (status.timers(), 25),
        (status.counters(), 27),
    ];
    for (word, high) in words {
        assert_eq!(word, high << 8 | (high + 1), "STATUS{high}");
    }
}

#[test]
fn the_os_version_is_two_nibbles() {
    let mut raw = [0; 64];
    raw[3] = 0xA7;
    assert_eq!(DetailedStatus::from(raw).os_version(), (10, 7));
}

#[test]
fn io_points_depend_on_the_series() {
    let fb = [(0x01, 20), (0x02, 28), (0x03, 40)];
    let fbs = [(0x00, 10), (0x01, 14), (0x02, 20), (0x03, 24), (0x04, 32), (0x05, 40), (0x06, 60)];
    for code in 0..=0xFF_u8 {
        let mut raw = [0; 64];
        raw[2] = code;
        let status = DetailedStatus::from(raw);
        for (series, table) in [(Series::Fb, &fb[..]), (Series::Fbs, &fbs[..])] {
            let expected = table.iter().find(|(known, _)| *known == code).map(|&(_, points)| points);
            assert_eq!(status.io_points(series), expected, "{series:?} {code:02X}h");
        }
    }
}

#[test]
fn loop_back_data_and_pages_are_accessible() {
    assert_eq!(&LoopBack::new(&b"ABC"[..]).expect("three are legal").data()[..], b"ABC");
    let words = std::array::from_fn(|i| if i == 0 { 0xA00F } else { 0 });
    let text = format!("{:?}", ProgramPage::new(words));
    assert_eq!(text, format!("ProgramPage(A00F{})", "0000".repeat(63)));
}
