#[derive(fatek::Tags)]
struct Tank {
    level: f32, //~ the field `level` has no tag: write #[tag("R100:f32")] or the like before it
    #[tag("R1")]
    #[tag("R2")] //~ the field `twice` has two tags
    twice: u16,
}

fn main() {}
