//! Overload, slow devices.

use std::time::Duration;

use fatek::{Register, register};
use tokio::time::Instant;

use crate::device::{Behaviour, Device};

const MS: Duration = Duration::from_millis(1);
const SECOND: Duration = Duration::from_secs(1);

/// Before: 12 callers had 47 good replies a second, 14 had none, while the PLC executed 47.
#[tokio::test(start_paused = true)]
async fn goodput_stays_at_the_capacity_at_any_number_of_callers() {
    for callers in [1_usize, 8, 12, 14, 16, 20, 50, 200] {
        let device = Device::new(Behaviour { plc_time: 20 * MS, ..Behaviour::default() });
        let link = device.link().call_timeout(290 * MS).build();
        let end = Instant::now() + 20 * SECOND;
        let tasks: Vec<_> = (0..callers)
            .map(|caller| {
                let station = link.station(1).unwrap();
                let first = Register::new(fatek::Symbol::R, u16::try_from(caller).unwrap() * 7).unwrap();
                tokio::spawn(async move {
                    let mut good = 0_u32;
                    while Instant::now() < end {
                        good += u32::from(station.read_registers(first, 1).await.is_ok());
                    }
                    good
                })
            })
            .collect();
        let mut good = 0;
        for task in tasks {
            good += task.await.unwrap();
        }
        let (good, executed) = (f64::from(good) / 20.0, device.executed() / 20);
        println!("{callers} callers: {good:.1} good replies a second, {executed} executed");
        assert!(good >= 45.0, "{callers} callers: {good:.1} good replies a second, {executed} executed");
    }
}

/// Before: given up after 1 s though bytes came.
#[tokio::test(start_paused = true)]
async fn a_slow_reply_is_awaited_while_its_bytes_come() {
    for byte_time in [2 * MS, 5 * MS, 20 * MS] {
        let device = Device::new(Behaviour { byte_time, ..Behaviour::default() });
        let link = device.link().build();
        let began = Instant::now();
        let read = link.station(1).unwrap().read_registers(register!("R0"), 64).await;
        println!("{byte_time:?} a byte: {:?} after {:?}", read.as_ref().map(Vec::len), began.elapsed());
        assert_eq!(read.map(|values| values.len()).ok(), Some(64), "{byte_time:?} a byte");
    }
}
