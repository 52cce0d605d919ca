#[derive(fatek::Tags)]
struct Tank {
    #[tag("R7.3")] //~ runs: a bit of a register is not written by itself
    runs: bool,
}

fn main() {}
