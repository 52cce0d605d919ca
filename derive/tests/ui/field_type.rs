#[derive(fatek::Tags)]
struct Tank {
    #[tag("R100:f32")]
    level: i16, //~ level: the values of R100:f32 do not fit `i16`
    #[tag("R5:u16*0.1")]
    scaled: f32, //~ scaled: the values of R5:u16*0.1 do not fit `f32`
    #[tag("R6")]
    number: Vec<i16>, //~ number: the values of R6 do not fit `Vec < i16 >`
    #[tag("R0-R9")]
    one: u16, //~ one: the values of R0-R9 do not fit `u16`
}

fn main() {}
