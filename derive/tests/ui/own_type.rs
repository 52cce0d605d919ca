struct Bar;

#[derive(fatek::Tags)]
struct Tank {
    #[tag("R5", read_only)]
    level: Bar, //~ the trait bound `Bar: FromTag` is not satisfied
}

fn main() {}
