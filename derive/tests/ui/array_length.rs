#[derive(fatek::Tags)]
struct Tank {
    #[tag("Y0-Y3")]
    valves: [bool; 3], //~ valves: the values of Y0-Y3 do not fit `[bool; 3]`
}

fn main() {}
