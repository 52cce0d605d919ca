//! Subcommand `fatek forced [RANGE…]`.

use fatek::tag::{Tag, TagValue};
use fatek::{Discrete, Element, MemoryMap, Plan, Station};

use crate::args::ForcedArgs;
use crate::failure::Failure;
use crate::output::{Output, Rows, complain};
use crate::ranges::DiscreteRange;

/// Lists the disabled discretes with their states.
pub(crate) async fn forced(station: &Station, args: &ForcedArgs, output: &Output) -> Result<(), Failure> {
    let ranges = if args.ranges.is_empty() { of_memory(station).await? } else { args.ranges.clone() };
    let (mut disabled, mut refused) = (Vec::new(), 0);
    for range in &ranges {
        let flags = match station.read_disabled(range.first(), range.len()).await {
            Ok(flags) => flags,
            Err(error) if error.error_code().is_some() && ranges.len() > 1 => {
                complain(format_args!("{range}: {error}"));
                refused += 1;
                continue;
            }
            Err(error) => return Err(Failure::of(range)(error)),
        };
        disabled.extend(range.iter().zip(flags).filter(|(_, is_disabled)| *is_disabled).map(|(discrete, _)| discrete));
    }
    // A range may be given twice.
    disabled.sort_unstable();
    disabled.dedup();
    let mut rows = Rows::new(["discrete", "state"]);
    for (discrete, state) in states(station, &disabled).await? {
        rows.push([discrete.to_string().into(), state.into()]);
    }
    let examined: usize = ranges.iter().map(DiscreteRange::len).sum();
    output.rows(&rows)?;
    if refused > 0 {
        return Err(Failure::RefusedRanges { refused, all: ranges.len() });
    }
    output.remark(format_args!("{} of {examined} discretes are disabled", disabled.len()));
    Ok(())
}

/// The discretes that the PLC has, by its detailed status.
async fn of_memory(station: &Station) -> Result<Vec<DiscreteRange>, Failure> {
    let status = station.read_detailed_status().await.map_err(|error| {
        Failure::of("the sizes of the memory are not known; give ranges, such as X0-X255 Y0-Y255 M0-M1911")(error)
    })?;
    let map = MemoryMap::from_status(&status);
    let range = |first, last| match (first, last) {
        (Element::Discrete(first), Element::Discrete(last)) => DiscreteRange::new(first, last),
        (Element::Discrete(_) | Element::Register(_) | Element::Register32(_), _) => None,
    };
    Ok(map.ranges().iter().filter_map(|of_area| range(of_area.first, of_area.last)).collect())
}

async fn states(station: &Station, discretes: &[Discrete]) -> Result<Vec<(Discrete, TagValue)>, Failure> {
    let plan = Plan::builder_for(station).tags(discretes.iter().map(|&discrete| Tag::from(Element::from(discrete))));
    let plan = plan.build().map_err(Failure::usage)?;
    let readings = plan.read(station).await;
    let mut states = Vec::with_capacity(discretes.len());
    for (&discrete, (_, values)) in discretes.iter().zip(readings.iter()) {
        let values = values.map_err(|error| Failure::of(discrete)(error.clone()))?;
        states.extend(values.into_iter().map(|state| (discrete, state)));
    }
    Ok(states)
}
