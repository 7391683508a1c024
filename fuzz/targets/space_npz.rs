#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| drop(muybridge_fuzz::read("space_npz", bytes)));
