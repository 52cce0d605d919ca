#[derive(fatek::Tags)]
struct Tank {
    #[tag("R70000")] //~ not a tag: the address is past the last one
    level: u16,
    #[tag("Q5")] //~ not a tag: no element has these letters
    alarm: bool,
}

fn main() {}
