macro_rules! tank {
    ($name:ident, $level:ty, $item:ident, $tag:literal) => {
        #[derive(fatek::Tags)]
        struct $name {
            #[tag($tag)]
            level: $level, //~ level: the values of R5:f32 do not fit `u16`
            #[tag("R9")]
            item: $item,
        }
    };
}

tank!(Good, u16, u16, "R5");
tank!(Bad, u16, u16, "R5:f32");

fn main() {}
