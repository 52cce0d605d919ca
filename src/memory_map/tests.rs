use super::*;
use crate::element;

#[test]
fn the_hole_and_the_ends_of_a_model_are_refused() {
    for &model in PlcModel::ALL {
        let map = MemoryMap::of(model);
        for exists in ["R4167", "R5000", "DR4166", "R8071", "M2001", "WM1984", "WX240", "S999", "RT255", "RC199"] {
            assert_eq!(map.check(exists.parse::<Element>().unwrap(), 1), Ok(()), "{model} has {exists}");
        }
        for missing in ["R4168", "R4999", "DR4167", "DR4999", "R8072", "DR8071", "M2002", "WM1992", "WX248", "S1000"] {
            assert!(map.check(missing.parse::<Element>().unwrap(), 1).is_err(), "{model} has no {missing}");
        }
    }
    let last_d = |model| MemoryMap::of(model).check(element!("D3071"), 2).map_err(|error| error.element);
    assert_eq!(last_d(PlcModel::Fbe28Mc), Err(element!("D3072")));
    assert_eq!(last_d(PlcModel::Fbs20Mc), Ok(()));
}

#[test]
fn a_run_across_the_hole_is_refused_at_its_start() {
    let map = MemoryMap::of(PlcModel::Fbs20Mc);
    let error = map.check_tag(&"R4100-R5100".parse().unwrap()).unwrap_err();
    assert_eq!(error.element, element!("R4168"));
    assert_eq!(map.check_tag(&"R4100-R4167".parse().unwrap()), Ok(()));
    // Adjacent ranges of different use are no gap.
    assert_eq!(map.check_tag(&"R3800-R4000".parse().unwrap()), Ok(()));
}

#[test]
fn counters_of_32_bits_are_a_range_of_their_own() {
    let map = MemoryMap::of(PlcModel::Fbs20Mc);
    assert_eq!(map.check_tag(&"DRC200-DRC255".parse().unwrap()), Ok(()));
    assert_eq!(map.check(element!("RC256"), 1).map_err(|error| error.existing), {
        Err(vec![(element!("RC0"), element!("RC199")), (element!("DRC200"), element!("DRC255"))])
    });
}

#[test]
fn file_registers_are_not_limited() {
    assert_eq!(MemoryMap::of(PlcModel::Fbs20Mc).check(element!("F65535"), 1), Ok(()));
}

#[test]
fn a_status_gives_counts_without_gaps() {
    let map = MemoryMap::from_status(&PlcModel::Fbs20Mc.detailed_status());
    assert_eq!((map.model(), map.usage(element!("R4500"))), (None, Some(AreaUsage::Unspecified)));
    assert!(map.check(element!("D4095"), 1).is_ok() && map.check(element!("D4096"), 1).is_err());
    assert!(map.check(element!("DRC255"), 1).is_ok() && map.check(element!("RC256"), 1).is_err());
    let error = map.check(element!("R8072"), 1).unwrap_err();
    assert_eq!(error.to_string(), "R8072 is not in the memory map of this PLC by its status (53), which has R0-R8071");
}

#[test]
fn a_count_of_0_does_not_limit_an_area() {
    let map = MemoryMap::from_status(&[0; 64].into());
    assert_eq!(map.check(element!("R65535"), 1), Ok(()));
    assert_eq!(map.limits(), Limits::new());
}

#[test]
fn the_ranges_of_a_model_have_the_counts_of_its_status() {
    for &model in PlcModel::ALL {
        let (own, counted) = (MemoryMap::of(model), MemoryMap::from_status(&model.detailed_status()));
        for extent in &counted.extents {
            let last = own.extents.iter().rfind(|other| other.area == extent.area).unwrap().last;
            assert_eq!(last, extent.last, "{:?} of {model}", extent.area);
        }
    }
}

#[test]
fn limits_have_the_elements_of_the_map_and_no_others() {
    for map in [MemoryMap::of(PlcModel::Fbe28Mc), MemoryMap::from_status(&PlcModel::Fbs20Mc.detailed_status())] {
        let limits = map.limits();
        for &symbol in Symbol::ALL {
            // Pairs of registers and double words are two cells of the planner.
            let is_pair = symbol != symbol.halved();
            for address in (0..=symbol.last_address()).filter(|n| n.is_multiple_of(symbol.alignment())) {
                let Ok(element) = Element::new(symbol, address) else { continue };
                if is_pair && !element.is_counter_of_32_bits() {
                    continue;
                }
                let readable = limits.segment(symbol.halved(), address).is_some();
                assert_eq!(readable, map.check(element, 1).is_ok(), "{element}");
            }
        }
    }
}

#[test]
fn models_are_parsed_by_their_names() {
    for &model in PlcModel::ALL {
        assert_eq!(model.to_string().to_ascii_lowercase().parse(), Ok(model));
    }
    let error = "fbs-99".parse::<PlcModel>().unwrap_err();
    assert_eq!(error.to_string(), "`fbs-99` is not a known model (known: fbe-28mc fbs-20mc)");
}

#[test]
fn special_ranges_are_those_of_the_table() {
    for &model in PlcModel::ALL {
        let map = MemoryMap::of(model);
        for range in map.ranges() {
            let special = matches!(range.usage, AreaUsage::Special | AreaUsage::AnalogInput | AreaUsage::AnalogOutput);
            for end in [range.first, range.last] {
                assert_eq!(special_range(end).is_some(), special, "{end} of {model}");
            }
        }
    }
    for before in ["R3839", "DR3838", "R4168", "M1911", "WM1896", "M2002", "D3840", "RT3840"] {
        assert_eq!(special_range(before.parse::<Element>().unwrap()), None, "{before}");
    }
}

#[test]
fn named_elements_are_sorted_and_exist() {
    let map = MemoryMap::of(PlcModel::Fbs20Mc);
    let keys: Vec<_> = NAMED_ELEMENTS.iter().map(|named| named.element).collect();
    assert!(keys.is_sorted(), "{keys:?}");
    assert!(keys.iter().all(|&element| map.check(element, 1).is_ok()));
}
