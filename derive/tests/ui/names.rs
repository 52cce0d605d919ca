use fatek::{Tags, tag};

const TAG: &str = "R5:i16";
const TAG_0: usize = 2;
const N: usize = 3;

#[derive(Tags)]
struct Names {
    #[tag("R5")]
    r#type: u16,
    #[tag("R6")]
    values: u16,
    #[tag("M0-M1")]
    tag: [bool; TAG_0],
    #[tag("M2-M4")]
    braces: [bool; { N }],
    #[tag("M5-M8")]
    own: [bool; Self::COUNT],
}

impl Names {
    pub const FIELDS: [&str; 1] = ["x"];
    const COUNT: usize = 4;
}

macro_rules! tank {
    ($name:ident, $level:ident, $tag:literal) => {
        #[derive(Tags)]
        struct $name {
            #[tag($tag)]
            level: $level,
        }
    };
}

tank!(Tank, u16, "R5");

fn main() {
    let _ = (tag!(TAG), <Names as Tags>::FIELDS, Names::FIELDS, Tank::FIELDS);
}
