const LEVEL: fatek::Tag = fatek::tag!("R100:f33"); //~ not a tag: the type is unknown

fn main() {}
