#[derive(fatek::Tags)]
struct Tank<T> { //~ a struct of tags has no generic parameters
    #[tag("R100:f32")]
    level: T,
}

fn main() {}
