#[derive(fatek::Tags)]
struct Twice {
    #[tag("R5", one_scan, one_scan = "b")] //~ the field `level` has `one_scan` twice
    level: u16,
}

#[derive(fatek::Tags)]
struct ReadOnly {
    #[tag("R5", read_only, one_scan, read_only)] //~ the field `level` has `read_only` twice
    level: u16,
}

#[derive(fatek::Tags)]
struct Empty {
    #[tag("R5", one_scan = "")] //~ the name of a group is empty: write `one_scan` alone
    level: u16,
}

#[derive(fatek::Tags)]
struct Unknown {
    #[tag("R5", readonly)] //~ `readonly` is not an option of a tag (known: one_scan read_only)
    level: u16,
}

fn main() {}
