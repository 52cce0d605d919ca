#[derive(fatek::Tags)]
struct Tank {
    #[tag("R5", onescan)] //~ `onescan` is not an option of a tag (known: one_scan read_only)
    level: u16,
    #[tag(one_scan)] //~ the text of a tag is expected first, such as "R100:f32"
    alarm: bool,
}

fn main() {}
