//! Values and movements of `--set`: `TAG=VALUE`, `TAG=MOVEMENT`.

use fatek::plant::PlantPlc;
use fatek::sim::{Movement, Plc, Shape};
use fatek::tag::{Assignment, Tag};

use crate::hint;
use crate::printable::excerpt;

/// Initial values of a tag, or its movement.
#[derive(Debug)]
enum Setting {
    Values(Assignment),
    Moves(Tag, Movement),
}

/// Returns the name in front of `=`, if it is the name of a tag of this PLC, or the text of a tag.
pub(super) fn is_for(text: &str, plc: Option<&PlantPlc>) -> bool {
    let Some(plc) = plc else { return true };
    // Without `=`, or with neither, the fault is reported by `apply`.
    let Some((name, _)) = text.split_once('=') else { return true };
    plc.tag(name.trim()).is_some() || name.parse::<Tag>().is_ok()
}

/// Writes the values, or starts the movement. The error is the rule that the text breaks.
pub(super) fn apply(text: &str, plc: &Plc, tags: Option<&PlantPlc>, seed: u64) -> Result<(), String> {
    match parse(text, tags, seed)? {
        Setting::Values(assignment) => {
            let mut values = assignment.tag().elements().zip(assignment.encode());
            values.try_for_each(|(element, value)| plc.write(element, value)).map_err(|error| error.to_string())
        }
        Setting::Moves(tag, movement) => plc.set_movement(tag, movement).map_err(|error| error.to_string()),
    }
}

fn parse(text: &str, tags: Option<&PlantPlc>, seed: u64) -> Result<Setting, String> {
    let Some((name, value)) = text.split_once('=') else {
        let parsed = text.parse::<Assignment>().map(Setting::Values);
        return parsed.map_err(|error| error.to_string());
    };
    let named = tags.and_then(|plc| plc.tag(name.trim())).map(|tag| tag.tag());
    let tag: Tag = match (named, tags) {
        (Some(tag), _) => tag,
        (None, None) => name.parse().map_err(|error| format!("{error}"))?,
        (None, Some(plc)) => {
            name.parse().map_err(|error| format!("{error}; nor is it a name of the tags of {}", plc.name()))?
        }
    };
    if !tag.tag_type().is_text() && is_movement(value) {
        let movement: Movement = value.parse().map_err(|error| format!("{error}"))?;
        return Ok(Setting::Moves(tag, movement.with_seed(seed)));
    }
    let values = tag.parse_values(value).map_err(|error| match hint::with_other_type(&tag, name, value) {
        Some(other) => format!("{error}; perhaps {}", excerpt(&other)),
        None => error.to_string(),
    })?;
    Assignment::new(tag, values).map(Setting::Values).map_err(|error| error.to_string())
}

/// Returns whether a value of a number or discrete is meant as a movement: none of them has brackets.
fn is_movement(value: &str) -> bool {
    value.contains('(') || Shape::ALL.iter().any(|shape| shape.as_str() == value.trim())
}
