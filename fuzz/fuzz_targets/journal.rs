#![no_main]

mod harness;

use std::path::PathBuf;
use std::sync::LazyLock;

static FILE: LazyLock<PathBuf> = LazyLock::new(|| {
    std::env::temp_dir().join(format!("lasertrace-fuzz-{}.journal", std::process::id()))
});

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    harness::is_journal(&FILE, bytes);
});
