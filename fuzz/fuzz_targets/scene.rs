#![no_main]

use lasertrace::scene::Scene;
use std::path::PathBuf;
use std::sync::LazyLock;

/// In a folder of its own, so that no name in a scene finds a file.
static SCENE: LazyLock<PathBuf> = LazyLock::new(|| {
    let name = format!("lasertrace-fuzz-{}", std::process::id());
    let folder = std::env::temp_dir().join(name);
    std::fs::create_dir_all(&folder).unwrap();
    folder.join("scene.toml")
});

// A scene loads, and every pose in it is finite; or an error of one line says what
// was expected.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    std::fs::write(&*SCENE, bytes).unwrap();
    match Scene::load(&SCENE) {
        Ok(scene) => {
            assert!(!scene.mesh.triangles.is_empty());
            assert!(scene.mesh.positions.iter().all(|p| p.is_finite()));
            for frame in [0, scene.scan.frames - 1] {
                let pose = scene.part_from_head(frame);
                assert!(pose.translation.is_finite() && pose.rotation.is_finite());
            }
        }
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains("expected") && text.lines().count() == 1, "{text}");
            assert_eq!(error.exit_code(), 65);
        }
    }
});
