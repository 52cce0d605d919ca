#[derive(fatek::Tags)]
struct Tank {
    #[tag("R5")]
    level: f64, //~ level: R5 takes integers, and `f64` holds fractions
    #[tag("R6", read_only)]
    read: f64,
    #[tag("R7:u16*0.1")]
    scaled: f64,
}

fn main() {}
