#![no_main]

mod harness;

use std::path::PathBuf;
use std::sync::LazyLock;

/// In a folder of its own, so that no name in a scene finds a file.
static SCENE: LazyLock<PathBuf> = LazyLock::new(|| {
    let name = format!("lasertrace-fuzz-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    std::fs::create_dir_all(&folder).unwrap();
    folder.join("scene.toml")
});

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    harness::is_scene(&SCENE, bytes);
});
