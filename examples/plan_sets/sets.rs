//! Twelve tag sets of machines and plants.

use fatek::tag::Tag;

use super::Result;

pub(crate) fn all() -> Result<Vec<(&'static str, Vec<Tag>)>> {
    let parsed = |texts: &[&str]| -> Result<Vec<Tag>> { texts.iter().map(|text| Ok(text.parse()?)).collect() };
    let numbered = |prefix: &str, numbers: &mut dyn Iterator<Item = u32>| -> Result<Vec<Tag>> {
        numbers.map(|n| Ok(format!("{prefix}{n}").parse()?)).collect()
    };
    let relays_and_registers =
        [parsed(&["M0-M255", "R0-R50"])?, numbered("R", &mut (0..20).map(|n| 100 + n * 37))?].concat();
    let alarms = numbered("M", &mut (0..120).map(|n| 200 + n * 2))?;
    let machine = [
        parsed(&["X0-X47", "Y0-Y31", "M0-M31", "R0-R19", "D100-D107:f32", "R4128-R4134"])?,
        numbered("M", &mut [400, 403, 410, 417, 512].into_iter())?,
    ]
    .concat();
    let pump = parsed(&["X0", "X1", "Y0", "Y1", "M10", "R100:f32", "R102:f32", "R200"])?;
    let tank_farm =
        [numbered("R", &mut (0..24).map(|n| 1000 + n * 40))?, numbered("M", &mut (0..24).map(|n| 600 + n * 16))?]
            .concat();
    let steps = parsed(&["S0-S99", "S500", "M1924", "T0-T15", "RT0-RT15"])?;
    let conveyor = [
        parsed(&["X0-X127", "Y0-Y127"])?,
        numbered("RC", &mut (0..12).map(|n| n * 3))?,
        parsed(&["DRC200", "DRC204"])?,
    ]
    .concat();
    let states = [parsed(&["WM0", "WM16", "WM80:i16"])?, numbered("M", &mut (0..12).map(|n| n * 7))?].concat();
    let hmi = [
        numbered("M", &mut (0..40).map(|n| n * 11 % 300))?,
        numbered("X", &mut (0..16).map(|n| n * 2))?,
        numbered("D", &mut (0..50).map(|n| n * 5))?,
    ]
    .concat();
    Ok(vec![
        ("M0–M255, R0–R50 and 20 R", relays_and_registers),
        ("M0–M255", parsed(&["M0-M255"])?),
        ("X, Y, M and S 0–255 each", parsed(&["X0-X255", "Y0-Y255", "M0-M255", "S0-S255"])?),
        ("all relays, M0–M1999", parsed(&["M0-M1999"])?),
        ("120 alarms, every second M", alarms),
        ("machine: I/O, 37 M, 36 registers", machine),
        ("pump: 5 discretes, 3 values", pump),
        ("tank farm: 24 R, 24 M, scattered", tank_farm),
        ("step chain: S, T, RT", steps),
        ("conveyor: X, Y, counters", conveyor),
        ("states as words, and relays in them", states),
        ("panel: 56 discretes, 50 D", hmi),
    ])
}
