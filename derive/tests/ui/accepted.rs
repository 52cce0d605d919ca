use fatek::tag::{FromTag, IntoTagValues, TagAccessError, TagValue};
use fatek::{Tag, Tags, tag};

/// An own type.
#[derive(Clone)]
struct Bar(f64);

impl FromTag for Bar {
    fn type_name() -> String {
        "Bar".to_owned()
    }

    fn from_values(values: &[TagValue]) -> Option<Self> {
        f64::from_values(values).map(Bar)
    }
}

impl IntoTagValues for Bar {
    fn into_values(self, tag: &Tag) -> Result<Vec<TagValue>, TagAccessError> {
        self.0.into_values(tag)
    }
}

#[derive(Tags)]
struct Tank {
    #[tag("R100:f32")]
    level: f32,
    #[tag("R0-R9:i16", one_scan)]
    speeds: Vec<i16>,
    #[tag("Y0-Y3", one_scan = "outputs",)]
    valves: [bool; COUNT],
    #[tag("R30-R39:text", read_only, one_scan)]
    name: String,
    #[tag("R5:u16*0.01")]
    pressure: Bar,
    #[tag("R7.3", read_only)]
    runs: bool,
    #[tag("WM0.3")]
    alarm: bool,
    #[tag("DR20:hex")]
    raw: TagValue,
}

const COUNT: usize = 4;
const LEVEL: Tag = tag!("R5:i16*0.1-40");

fn generic<T>() -> Tag {
    tag!("R100:f32")
}

fn main() {
    let _ = (LEVEL, generic::<u8>(), Tank::FIELDS);
}
