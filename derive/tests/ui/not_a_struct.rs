#[derive(fatek::Tags)]
enum Tank { //~ Tags can be derived for a struct only
    Full,
}

#[derive(fatek::Tags)]
struct Pair(u16); //~ the fields of a struct of tags have names

fn main() {}
