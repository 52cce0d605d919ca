#![no_main]

libfuzzer_sys::fuzz_target!(|input: &[u8]| fatek_fuzz::reply::run(input));
