//! The library within a program of another: held, shared and dropped.

use lasertrace::accel::Accel;
use lasertrace::{Scene, Simulation};
use std::path::{Path, PathBuf};

fn plane() -> Scene {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("scenes/plane/scene.toml");
    Scene::load(&path).unwrap()
}

/// What a server, a Python object or a C handle asks of what it holds.
#[test]
fn what_is_held_owns_itself_and_goes_between_threads() {
    fn is_held<T: Send + Sync + 'static>() {}
    is_held::<Scene>();
    is_held::<Simulation>();
    is_held::<Accel>();
}

/// Two threads take 500 frames through one simulation: each frame is what it is alone.
#[test]
fn threads_share_a_simulation() {
    let simulation = std::sync::Arc::new(Simulation::new(&plane()).unwrap());
    let frames = simulation.scene.scan.frames;
    let alone: Vec<_> = (0..frames).map(|frame| simulation.image(frame)).collect();
    let workers = [0, 1].map(|worker| {
        let (simulation, alone) = (simulation.clone(), alone.clone());
        std::thread::spawn(move || {
            for i in 0..250 {
                let frame = (2 * i + worker) % frames;
                assert!(simulation.image(frame) == alone[frame as usize], "{frame}");
            }
        })
    });
    for worker in workers {
        worker.join().unwrap();
    }
}

/// A scene given as text is that of the file, and its mistakes name the text.
#[test]
fn a_scene_may_be_text() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenes/bracket");
    let text = std::fs::read_to_string(root.join("scene.toml")).unwrap();
    let (parsed, loaded) = (
        Scene::parse(&text, &root),
        Scene::load(&root.join("scene.toml")),
    );
    let (parsed, loaded) = (parsed.unwrap(), loaded.unwrap());
    assert_eq!((parsed.hash, &parsed.mesh), (loaded.hash, &loaded.mesh));
    let wrong = text.replace("f_number", "f_numbre");
    let message = Scene::parse(&wrong, &root).err().unwrap().to_string();
    assert!(
        message.contains("scene text:21: camera.f_numbre: "),
        "{message}"
    );
}
