use super::*;
use crate::backup::{Restore, RestoreOptions, TakeBackup};
use crate::command::{ProgramPage, ReadRegisters, Value};
use crate::memory_map::PlcModel;
use crate::sim::{Bus, connector};
use crate::wire::Framing;
use crate::{ErrorCode, Link, Station, register};

/// A station of a PLC of this model.
fn station_of(plc: &Plc) -> Station {
    let bus = Bus::new().with_station(1, plc.clone()).unwrap();
    let connector = connector(bus, Framing::Ascii);
    Link::connector_builder("simulated PLC", Framing::Ascii, connector).build().station(1).unwrap()
}

async fn backup(plc: &Plc, ranges: &[&str]) -> Backup {
    let ranges = ranges.iter().map(|range| range.parse().unwrap());
    TakeBackup::new(ranges).unwrap().run(&station_of(plc)).await.unwrap()
}

#[tokio::test]
async fn a_backup_of_a_copy_equals_its_backup() {
    const RANGES: [&str; 5] = ["R3800-R3839", "R5000-R5003", "WX0-WX32", "DRC200-DRC203", "R8000-R8070"];
    let plc = Plc::with_model(Model::of(PlcModel::Fbs20Mc).os_version(4, 7).program_capacity(0x40));
    for (address, value) in [("R3801", 7_u16), ("R5003", 9), ("WX16", 0xA5A5), ("R8070", 3)] {
        plc.write(address.parse::<crate::Register>().unwrap(), value).unwrap();
    }
    plc.write("DRC203".parse::<crate::Register32>().unwrap(), 70_000_u32).unwrap();
    let saved = backup(&plc, &RANGES).await;

    let copy = Plc::with_model(Model::of_backup(&saved));
    copy.write_backup(&saved).unwrap();
    assert_eq!(backup(&copy, &RANGES).await.differences(&saved), []);
    let report = Restore::new(&saved, RestoreOptions::new()).run(&station_of(&copy)).await.unwrap();
    assert_eq!((report.other_plc, report.differences), (vec![], vec![]), "it is the same PLC");
}

#[tokio::test]
async fn a_copy_has_the_elements_that_the_plc_had() {
    let plc = Plc::with_model(Model::largest().last(register!("R4200")));
    let saved = backup(&plc, &["R4160-R4199", "R4201-R4210"]).await;
    let copy = Plc::with_model(Model::of_backup(&saved));
    let read = |first, count| copy.execute(&ReadRegisters::new(first, count).unwrap());
    assert_eq!(read(register!("R4160"), 40), Ok(vec![0; 40]));
    assert_eq!(read(register!("R4200"), 1), Err(ErrorCode::IllegalAddress));
    // Those behind the gap stay.
    assert_eq!(read(register!("R5000"), 1), Ok(vec![0]));
}

#[tokio::test]
async fn a_backup_beyond_the_model_changes_nothing() {
    let source = Plc::new();
    source.write(register!("R0"), 1_u16).unwrap();
    source.write(register!("R200"), 1_u16).unwrap();
    let saved = backup(&source, &["R0-R9", "R200-R209"]).await;
    let small = Plc::with_model(Model::default().last(register!("R100")));
    assert_eq!(small.write_backup(&saved), Err(Error::BeyondModel { element: register!("R200").into() }));
    assert_eq!(small.read(register!("R0")), Value::Word(0));
}

#[test]
fn a_program_has_its_pages_and_its_size() {
    let source = Plc::with_model(Model::default().ladder_words(128));
    source.set_page(2, ProgramPage::new([0xABCD; 64])).unwrap();
    let pages = (0..source.pages()).filter_map(|page| source.page(page)).collect();
    let program = Program::from_pages(pages).unwrap();

    let copy = Plc::with_model(Model::default().for_program(&program));
    copy.set_program(&program).unwrap();
    assert_eq!((copy.pages(), copy.page(2)), (3, source.page(2)));
    let small = Plc::with_model(Model::default().ladder_words(64));
    assert_eq!(small.set_program(&program), Err(Error::BeyondProgram { page: 2, last: 1 }));
    assert_ne!(small.page(0), program.page(0).cloned(), "nothing is set");
}
