pub fn generic<T>() -> fatek::Tag {
    fatek::tag!("R0-R8:f32") //~ not a tag: the range is not a whole number of values
}

fn main() {}
