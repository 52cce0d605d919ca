pub fn generic<T>() -> fatek::Register {
    fatek::register!("WM4") //~ WM4 is not a 16-bit register of the protocol
}

fn main() {}
