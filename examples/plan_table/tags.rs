//! Tag sets of docs/PLAN.md, the same in each run.

use std::error::Error;

use fatek::tag::{Tag, TagType};
use fatek::{Discrete, Element, Register, Symbol};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Returns `n` clustered tags: five sixths are values in clusters of 20, a quarter of them floats,
/// with gaps of one to seven registers. The others are relays. From 9000 on the addresses repeat.
pub(crate) fn clustered(n: usize) -> Result<Vec<Tag>> {
    let mut seed = 1;
    let mut tags = Vec::new();
    let relays = n / 6;
    let mut address = 0;
    for value in 0..n - relays {
        let (cluster, index) = (value / 20, value % 20);
        if index == 0 {
            address = u16::try_from(cluster % 130)? * 500;
        }
        let register = match cluster / 130 % 3 {
            0 => Register::r(address),
            1 => Register::d(address),
            _ => Register::f(address),
        };
        let tag_type = if index % 4 == 0 { TagType::F32 } else { TagType::U16 };
        tags.push(Tag::new(register, tag_type, 1)?);
        address += 2 + below(&mut seed, 7);
    }
    for relay in 0..relays {
        let address = u16::try_from(relay % 3333)? * 3;
        tags.push(Tag::from(Element::from(Discrete::new(Symbol::M, address)?)));
    }
    Ok(tags)
}

/// Returns `n` random tags in the first `r`, `d` and `m` elements of `R`, `D` and `M`.
pub(crate) fn random(n: usize, r: u16, d: u16, m: u16) -> Result<Vec<Tag>> {
    let mut seed = 2;
    let one = |_| {
        Ok(match below(&mut seed, 10) {
            0..5 => Tag::from(Element::from(Register::r(below(&mut seed, r)))),
            5..7 => Tag::new(Register::r(below(&mut seed, r)), TagType::F32, 1)?,
            7..9 => Tag::from(Element::from(Register::d(below(&mut seed, d)))),
            _ => Tag::from(Element::from(Discrete::new(Symbol::M, below(&mut seed, m))?)),
        })
    };
    (0..n).map(one).collect()
}

/// Returns a random number below `n`, by SplitMix64.
fn below(seed: &mut u64, n: u16) -> u16 {
    *seed = seed.wrapping_add(0x9E37_79B9_7F4A_7C15);
    let mut z = *seed;
    z = (z ^ z >> 30).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ z >> 27).wrapping_mul(0x94D0_49BB_1331_11EB);
    u16::try_from((z ^ z >> 31) % u64::from(n)).unwrap_or(0)
}
