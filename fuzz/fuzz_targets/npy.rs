#![no_main]

mod harness;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    harness::is_npy(bytes);
});
