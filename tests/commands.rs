//! Every command as a method of `Station`, against the simulated PLC, in both framings.
#![cfg(feature = "sim")]

use fatek::command::{DiscreteControl, MainUnit, ProgramCapacity, ProgramPage, Series};
use fatek::sim::{Bus, Model, PageReply, Plc, serve};
use fatek::wire::Framing;
use fatek::{
    Discrete, Element, Error, ErrorCode, Link, Register, Symbol, Value, discrete, element, register, register32,
};
use tokio::io::duplex;

const FRAMINGS: [Framing; 2] = [Framing::Ascii, Framing::Binary];

fn connect(bus: Bus, framing: Framing) -> Link {
    let (client, plc) = duplex(4096);
    tokio::spawn(serve(plc, bus, framing));
    Link::from_stream(client, framing)
}

fn alone(plc: &Plc, framing: Framing) -> Link {
    connect(Bus::new().with_station(1, plc.clone()).unwrap(), framing)
}

#[tokio::test(start_paused = true)]
async fn registers_of_both_widths_are_read_and_written() {
    for framing in FRAMINGS {
        let plc = Plc::with_model(Model::largest());
        let station = alone(&plc, framing).station(1).unwrap();
        let values: Vec<u16> = (0..64).map(|n| n * 1021).collect();
        station.write_registers(register!("R100"), &values).await.unwrap();
        assert_eq!(station.read_registers(register!("R100"), 64).await.unwrap(), values);
        assert_eq!(plc.read(register!("R163")), Value::Word(values[63]));

        station.write_registers32(register32!("DR100"), &[10_000_000, (-500.125_f32).to_bits()]).await.unwrap();
        assert_eq!(station.read_registers(register!("R100"), 4).await.unwrap(), [0x9680, 0x0098, 0x1000, 0xC3FA]);
        assert_eq!(station.read_registers32(register32!("DR102"), 1).await.unwrap(), [0xC3FA_1000]);

        for symbol in ["WX", "WY", "WM", "WS", "WT", "WC", "RT", "RC", "R", "D", "F"] {
            let first: Register = format!("{symbol}8").parse().unwrap();
            station.write_registers(first, &[0x1234, 0xABCD]).await.unwrap();
            assert_eq!(station.read_registers(first, 2).await.unwrap(), [0x1234, 0xABCD], "{first}");
            let wide = first.widened().unwrap();
            assert_eq!(station.read_registers32(wide, 1).await.unwrap(), [0xABCD_1234], "{wide}");
        }
    }
}

#[tokio::test(start_paused = true)]
async fn discretes_are_read_written_forced_and_disabled() {
    for framing in FRAMINGS {
        let plc = Plc::with_model(Model::largest());
        let station = alone(&plc, framing).station(1).unwrap();
        let states: Vec<bool> = (0..256).map(|n| n % 3 == 0).collect();
        for symbol in ["X", "Y", "M", "S", "T", "C"] {
            let first: Discrete = format!("{symbol}8").parse().unwrap();
            station.write_discretes(first, &states).await.unwrap();
            assert_eq!(station.read_discretes(first, 256).await.unwrap(), states, "{first}, 256 is sent as 00");
        }
        assert_eq!(station.read_registers(register!("WM8"), 1).await.unwrap(), [0b1001_0010_0100_1001]);

        let y9 = discrete!("Y9");
        station.set(y9).await.unwrap();
        assert_eq!(station.read_discretes(y9, 1).await.unwrap(), [true]);
        station.reset(y9).await.unwrap();
        assert_eq!(station.read_discretes(y9, 1).await.unwrap(), [false]);
        station.disable(y9).await.unwrap();
        assert_eq!(station.read_disabled(discrete!("Y8"), 3).await.unwrap(), [false, true, false]);
        plc.write(y9, true).unwrap();
        assert_eq!(station.read_discretes(y9, 1).await.unwrap(), [false], "a disabled discrete ignores the process");
        station.set(y9).await.unwrap();
        assert_eq!(station.read_discretes(y9, 1).await.unwrap(), [true], "a disabled discrete can be forced");
        station.enable(y9).await.unwrap();
        assert_eq!(station.read_disabled(y9, 1).await.unwrap(), [false]);
    }
}

#[tokio::test(start_paused = true)]
async fn mixed_requests_keep_their_order() {
    for framing in FRAMINGS {
        let station = alone(&Plc::with_model(Model::largest()), framing).station(1).unwrap();
        let items = [
            (element!("Y0"), Value::Bit(true)),
            (element!("Y1"), Value::Bit(false)),
            (element!("WM8"), Value::Word(0x5555)),
            (element!("DR2"), Value::DWord(0xFF)),
            (element!("RT7"), Value::Word(7)),
        ];
        station.write_mixed(&items).await.unwrap();
        let (mut elements, mut values): (Vec<Element>, Vec<Value>) = items.into_iter().unzip();
        assert_eq!(station.read_mixed(&elements).await.unwrap(), values);
        elements.reverse();
        values.reverse();
        assert_eq!(station.read_mixed(&elements).await.unwrap(), values);
        let many: Vec<Element> = (0..64).map(|n| Register::d(n).into()).collect();
        assert_eq!(station.read_mixed(&many).await.unwrap(), [Value::Word(0); 64]);
    }
}

#[tokio::test(start_paused = true)]
async fn an_ambiguous_list_is_rejected_before_sending() {
    let list = [Element::from(Register::r(0x5400)), element!("WX0")];
    let plc = Plc::with_model(Model::largest());
    assert!(alone(&plc, Framing::Ascii).station(1).unwrap().read_mixed(&list).await.is_ok());
    let error = alone(&plc, Framing::Binary).station(1).unwrap().read_mixed(&list).await.unwrap_err();
    assert!(matches!(error, Error::Invalid(_)), "{error:?}");
    assert!(error.to_string().contains("R21504 WX0 can also be read as other elements"), "{error}");
}

#[tokio::test(start_paused = true)]
async fn status_is_typed_and_keeps_its_raw_bytes() {
    for framing in FRAMINGS {
        let plc = Plc::with_model(Model::default().program_capacity(0x40).ladder_words(8192));
        let station = alone(&plc, framing).station(1).unwrap();
        plc.set_battery_low(true);
        station.run().await.unwrap();
        let brief = station.read_status().await.unwrap();
        assert!(brief.flags().running() && brief.flags().battery_low() && !brief.flags().emergency_stop());
        assert_eq!(brief.flags().to_string(), "RUN, battery low");
        assert_eq!((brief.raw(), brief.capacity()), ([3, 0x40, 0], ProgramCapacity::Unknown(0x40)));
        station.stop().await.unwrap();
        assert!(!station.read_status().await.unwrap().flags().running());

        let detailed = station.read_detailed_status().await.unwrap();
        assert_eq!(detailed.raw().len(), 64);
        assert_eq!(detailed.main_unit(), MainUnit::Mc);
        assert_eq!((detailed.io_points(Series::Fb), detailed.os_version()), (Some(28), (3, 1)));
        assert_eq!(detailed.ladder_words(), 8192);
        assert_eq!((detailed.analog_inputs(), detailed.m_relays(), detailed.r_registers()), (100, 2002, 8072));
    }
}

#[tokio::test(start_paused = true)]
async fn loop_back_checks_the_echo() {
    for framing in FRAMINGS {
        let station = alone(&Plc::with_model(Model::largest()), framing).station(1).unwrap();
        for data in ["", "A", "4", "ABCDEFG"] {
            station.loop_back(data).await.unwrap();
        }
        station.loop_back(vec![b'~'; 256]).await.unwrap();
        let too_long = station.loop_back(vec![b'~'; 257]).await.unwrap_err();
        assert!(too_long.to_string().contains("257 items were asked for, and it takes 0 to 256"), "{too_long}");
    }
}

#[tokio::test(start_paused = true)]
async fn program_pages_work_with_both_forms_of_the_reply() {
    for form in [PageReply::WithErrorDigit, PageReply::Bare] {
        let plc = Plc::with_model(Model::default().ladder_words(8192).page_reply(form));
        let station = alone(&plc, Framing::Ascii).station(1).unwrap();
        let header = station.read_program_page(0).await.unwrap().to_bytes();
        assert_eq!(header[..7], *b"FB00\x20\x00\xFF");
        let page = ProgramPage::new(std::array::from_fn(|n| n as u16 * 257));
        station.write_program_page(128, &page).await.unwrap();
        assert_eq!(station.read_program_page(128).await.unwrap(), page);
        let refused = station.read_program_page(129).await.unwrap_err();
        assert_eq!(refused.error_code(), Some(ErrorCode::IllegalAddress));
        station.run().await.unwrap();
        let refused = station.write_program_page(1, &page).await.unwrap_err();
        assert_eq!(refused.error_code(), Some(ErrorCode::IllegalFormat), "a running PLC does not take a program");
    }
}

#[tokio::test(start_paused = true)]
async fn the_plc_refuses_addresses_outside_its_model() {
    for framing in FRAMINGS {
        let plc = Plc::with_model(Model::default().last(element!("X255")));
        let station = alone(&plc, framing).station(1).unwrap();
        assert!(station.read_discretes(discrete!("X255"), 1).await.is_ok());
        let error = station.read_discretes(discrete!("X256"), 1).await.unwrap_err();
        assert_eq!(error.error_code(), Some(ErrorCode::IllegalAddress));
        plc.refuse_run(Some(ErrorCode::Syntax));
        let error = station.run().await.unwrap_err();
        assert_eq!(error.to_string(), "station 1 refused control RUN/STOP (41h): cannot run: syntax error (7)");
    }
}

#[tokio::test(start_paused = true)]
async fn broadcasts_reach_every_station_of_a_link() {
    for framing in FRAMINGS {
        let plcs: Vec<Plc> = (0..3).map(|_| Plc::with_model(Model::largest())).collect();
        let mut bus = Bus::new();
        for (number, plc) in [1, 2, 254].into_iter().zip(&plcs) {
            bus = bus.with_station(number, plc.clone()).unwrap();
        }
        let link = connect(bus, framing);
        let all = link.broadcast();
        all.run().await.unwrap();
        all.write_registers(register!("R0"), &[9]).await.unwrap();
        all.write_registers32(register32!("DD0"), &[90_000]).await.unwrap();
        all.write_discretes(discrete!("M0"), &[true]).await.unwrap();
        all.control(DiscreteControl::Set, discrete!("M1")).await.unwrap();
        all.write_mixed(&[(element!("R1"), Value::Word(8))]).await.unwrap();
        for (number, plc) in [1, 2, 254].into_iter().zip(&plcs) {
            let station = link.station(number).unwrap();
            station.write_registers(register!("R2"), &[u16::from(number)]).await.unwrap();
            assert_eq!(station.read_registers(register!("R0"), 3).await.unwrap(), [9, 8, u16::from(number)]);
            assert_eq!(plc.read(register32!("DD0")), Value::DWord(90_000));
            assert_eq!(station.read_discretes(discrete!("M0"), 3).await.unwrap(), [true, true, false]);
            assert!(plc.is_running());
        }
        all.stop().await.unwrap();
        assert!(!link.station(2).unwrap().read_status().await.unwrap().flags().running());
    }
}

#[tokio::test(start_paused = true)]
async fn many_callers_share_one_station() {
    let plc = Plc::with_model(Model::largest());
    for n in 0..200_u16 {
        plc.write(Register::r(n), n * 7).unwrap();
    }
    let station = alone(&plc, Framing::Binary).station(1).unwrap();
    let calls: Vec<_> = (0..200_u16)
        .map(|n| {
            let station = station.clone();
            tokio::spawn(async move { (n, station.read_registers(Register::r(n), 1).await) })
        })
        .collect();
    for call in calls {
        let (n, values) = call.await.unwrap();
        assert_eq!(values.unwrap(), [n * 7]);
    }
}

#[tokio::test(start_paused = true)]
async fn both_framings_give_equal_results_from_equal_memory() {
    let plc = Plc::with_model(Model::largest());
    for (n, &symbol) in Symbol::ALL.iter().enumerate() {
        let value = match symbol.width() {
            fatek::Width::Bit => Value::Bit(n % 2 == 0),
            fatek::Width::Word => Value::Word(0x0111 * n as u16),
            fatek::Width::DWord => Value::DWord(0x0101_0101 * n as u32),
        };
        plc.write(Element::new(symbol, 0x48 + 8 * n as u16).unwrap(), value).unwrap();
    }
    let elements: Vec<Element> = Symbol::ALL.iter().map(|&symbol| Element::new(symbol, 0x48).unwrap()).collect();
    let mut results = Vec::new();
    for framing in FRAMINGS {
        let station = alone(&plc, framing).station(1).unwrap();
        let mut result = station.read_mixed(&elements).await.unwrap();
        for n in (0..256).step_by(32) {
            let first = Register::new(Symbol::WM, n).unwrap();
            result.extend(station.read_registers(first, 64).await.unwrap().into_iter().map(Value::Word));
        }
        results.push(result);
    }
    assert_eq!(results[0], results[1]);
}
