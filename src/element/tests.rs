use proptest::prelude::*;

use super::*;
use crate::{element, register, register32};

#[test]
fn every_symbol_round_trips_at_its_first_and_last_address() {
    assert_eq!(Symbol::ALL.len(), 28);
    for &symbol in Symbol::ALL {
        for address in [0, symbol.last_address_in(Framing::Ascii), symbol.last_address_in(Framing::Binary)] {
            let element = Element::new(symbol, address).unwrap();
            assert_eq!(element.to_string().parse(), Ok(element));
            assert_eq!(format!("{element:#}").parse(), Ok(element));
            assert_eq!(element.to_string().to_lowercase().parse(), Ok(element));
            if element.check_in(Framing::Ascii).is_ok() {
                assert_eq!(format!("{element:#}").len(), symbol.as_str().len() + symbol.digits());
            }
        }
        let past = u32::from(symbol.last_address()) + u32::from(symbol.alignment());
        assert!(format!("{symbol}{past}").parse::<Element>().is_err(), "{symbol}{past}");
    }
}

/// The manuals' own table.
#[test]
fn symbols_have_the_digits_limits_and_steps_of_the_manual() {
    // symbols, width, digits, last addresses in ASCII and in binary, step, alignment
    let rows = [
        ("X Y M S T C", Width::Bit, 4, [9999, 65535], 1, 1),
        ("WX WY WM WS WT WC", Width::Word, 4, [9984, 65520], 16, 8),
        ("RT RC", Width::Word, 4, [9999, 65535], 1, 1),
        ("R D F", Width::Word, 5, [65535, 65535], 1, 1),
        ("DWX DWY DWM DWS DWT DWC", Width::DWord, 4, [9968, 65504], 32, 8),
        ("DRT DRC", Width::DWord, 4, [9998, 65534], 2, 1),
        ("DR DD DF", Width::DWord, 5, [65534, 65534], 2, 1),
    ];
    let mut symbols = Symbol::ALL.iter();
    for (names, width, digits, last, step, alignment) in rows {
        for name in names.split(' ') {
            let symbol = *symbols.next().unwrap();
            assert_eq!(symbol.as_str(), name);
            assert_eq!((symbol.width(), symbol.digits()), (width, digits), "{symbol}");
            assert_eq!(
                [Framing::Ascii, Framing::Binary].map(|framing| symbol.last_address_in(framing)),
                last,
                "{symbol}"
            );
            assert_eq!(
                (symbol.last_address(), symbol.step(), symbol.alignment()),
                (last[1], step, alignment),
                "{symbol}"
            );
        }
    }
    assert_eq!(symbols.next(), None);
}

#[test]
fn every_symbol_is_one_of_its_area_and_has_letters_of_its_own() {
    for &area in MemoryArea::ALL {
        let symbols: Vec<_> = Symbol::ALL.iter().filter(|symbol| symbol.area() == area).collect();
        let (smallest, word, dword) = (area.smallest(), area.word(), area.dword());
        if smallest == word {
            assert_eq!(symbols, [&word, &dword]);
        } else {
            assert_eq!(symbols, [&smallest, &word, &dword]);
        }
        assert_eq!((word.width(), dword.width()), (Width::Word, Width::DWord));
    }
    for symbol in Symbol::ALL {
        assert_eq!(Symbol::from_letters(symbol.as_str().as_bytes()), Some(*symbol));
    }
}

#[test]
fn the_ascii_form_of_the_manual_is_five_six_or_seven_characters() {
    for &symbol in Symbol::ALL {
        let len = symbol.as_str().len() + symbol.digits();
        let expected = match symbol.width() {
            Width::Bit => 5,
            Width::Word => 6,
            Width::DWord => 7,
        };
        assert_eq!(len, expected, "{symbol}");
    }
}

#[test]
fn an_element_is_printed_in_its_canonical_form() {
    for (input, canonical) in
        [("R12", "R12"), ("R00012", "R12"), ("dwm0", "DWM0"), ("X0007", "X7"), ("drt9998", "DRT9998")]
    {
        assert_eq!(input.parse::<Element>().unwrap().to_string(), canonical);
    }
}

#[test]
fn consecutive_elements_step_as_the_manual_says() {
    let nth = |text: &str, n| text.parse::<Element>().unwrap().nth(n).map(|e| e.to_string());
    assert_eq!(nth("WY8", 1).unwrap(), "WY24");
    assert_eq!(nth("DWM0", 1).unwrap(), "DWM32");
    assert_eq!(nth("DR0", 1).unwrap(), "DR2");
    assert_eq!(nth("R12", 2).unwrap(), "R14");
    assert_eq!(nth("X50", 5).unwrap(), "X55");
    assert_eq!(nth("R65535", 0).unwrap(), "R65535");
    assert_eq!(nth("R65535", 1), Err(ElementError::OutOfRange { symbol: Symbol::R, address: 65536 }));
    assert_eq!(nth("WX9984", 1).unwrap(), "WX10000");
    assert!(nth("WX65520", 1).is_err());
    assert!(nth("X0", usize::MAX).is_err());
}

#[test]
fn errors_name_the_input_and_the_rule() {
    let message = |text: &str| text.parse::<Element>().unwrap_err().to_string();
    assert_eq!(message("R65536"), "`R65536` is not an element: R65536 is past the last address, R65535");
    assert_eq!(message("WM4"), "`WM4` is not an element: WM4: the address of WM must be a multiple of 8");
    assert_eq!(message("R"), "`R` is not an element: R needs a decimal address, such as R0");
    assert_eq!(message("R1A"), "`R1A` is not an element: the address of R must be decimal digits and nothing else");
    assert!(message("Q7").starts_with("`Q7` is not an element: no element has these letters (known: X Y M"));
    assert!(message("").contains("no element has these letters"));
    let error = "R5".parse::<Discrete>().unwrap_err().to_string();
    assert_eq!(error, "`R5` is not an element: R5 is a 16-bit register, not a discrete");
}

#[test]
fn low_word_and_widened_are_inverse() {
    for &symbol in Symbol::ALL.iter().filter(|s| s.width() == Width::DWord) {
        let wide = Register32::new(symbol, 8).unwrap();
        let low = wide.low().unwrap();
        assert_eq!(low.widened(), Ok(wide));
        assert_eq!(format!("D{}", low.symbol()), symbol.as_str());
    }
    assert!(Register::r(65535).widened().is_err());
}

/// Before: one limit for both framings, so `M10000` was no element at all.
#[test]
fn an_address_is_limited_by_the_framing() {
    for (text, ascii) in [("M9999", true), ("M10000", false), ("WM9992", false), ("RT65535", false), ("R65535", true)] {
        let element: Element = text.parse().unwrap();
        assert_eq!(element.check_in(Framing::Binary), Ok(()), "{text}");
        assert_eq!(element.check_in(Framing::Ascii).is_ok(), ascii, "{text}");
    }
    let error = element!("DWM10000").check_in(Framing::Ascii).unwrap_err().to_string();
    assert_eq!(error, "DWM10000 is past the last address of the ascii framing, DWM9968");
    assert_eq!(
        "M65536".parse::<Element>().unwrap_err().reason().to_string(),
        "M65536 is past the last address, M65535"
    );
}

/// Before: `RC200` was a register, and `DRC200`, `DRC202` two counters in succession.
#[test]
fn counters_of_32_bits_have_one_address_each() {
    let rule = "DRC200 to DRC255 are counters of 32 bits, with one address each";
    for text in ["RC200", "RC255", "DRC199"] {
        let error = text.parse::<Element>().unwrap_err().reason().to_string();
        assert_eq!(error, format!("{text} does not exist: {rule}"));
    }
    for text in ["RC199", "RC256", "DRC198", "DRC200", "DRC255", "DRC256"] {
        assert!(text.parse::<Element>().is_ok(), "{text}");
    }
    let nth = |text: &str, n| text.parse::<Element>().unwrap().nth(n).map(|e| e.to_string());
    assert_eq!(nth("DRC200", 5).unwrap(), "DRC205");
    assert_eq!(nth("DRC196", 1).unwrap(), "DRC198");
    assert_eq!(nth("DRC256", 1).unwrap(), "DRC258");
    for (first, n) in [("DRC198", 1), ("DRC255", 1), ("DRC0", 100), ("RC0", 200), ("RC0", 256), ("RC199", 57)] {
        assert!(nth(first, n).unwrap_err().to_string().ends_with(rule), "{first} {n}");
    }
    assert!(register32!("DRC200").low().is_err() && register!("RC199").widened().is_err());
    assert_eq!(register32!("DRC198").low(), Ok(register!("RC198")));
}

#[test]
fn a_received_request_can_name_half_a_counter() {
    let element = Element::received(Symbol::RC, 200, Framing::Ascii).unwrap();
    assert_eq!((element.to_string(), element.nth(0), element.nth(1).is_err()), ("RC200".to_owned(), Ok(element), true));
    assert!(Element::received(Symbol::M, 10_000, Framing::Ascii).is_err());
    assert!(Element::received(Symbol::M, 10_000, Framing::Binary).is_ok());
}

#[test]
fn a_run_has_the_elements_that_nth_gives() {
    let near = |address: u16| address.saturating_sub(70)..=address.saturating_add(70);
    let addresses = [0, 200, 256, 9999, u16::MAX].into_iter().flat_map(near);
    for (&symbol, address) in Symbol::ALL.iter().flat_map(|symbol| addresses.clone().map(move |at| (symbol, at))) {
        let Ok(first) = Element::received(symbol, address.into(), Framing::Binary) else { continue };
        for count in [0, 1, 2, 64, 80, 300] {
            let by_nth: Vec<_> = (0..count).map_while(|n| first.nth(n).ok()).collect();
            assert!(first.run(count).eq(by_nth), "{count} from {first}");
        }
    }
}

proptest! {
    #[test]
    fn no_text_panics_and_every_accepted_text_round_trips(text in "\\PC{0,12}|[xymstcwrdf]{0,4}[0-9]{0,12}") {
        if let Ok(element) = text.parse::<Element>() {
            prop_assert_eq!(element.to_string().parse::<Element>(), Ok(element));
        }
    }

    #[test]
    fn no_address_panics(symbol in prop::sample::select(Symbol::ALL), address: u16, n: usize) {
        if let Ok(element) = Element::new(symbol, address) {
            prop_assert!(address <= symbol.last_address());
            prop_assert_eq!(address % symbol.alignment(), 0);
            if let Ok(other) = element.nth(n) {
                prop_assert_eq!(usize::from(other.address()), usize::from(address) + n * usize::from(element.step()));
            }
        }
    }
}
