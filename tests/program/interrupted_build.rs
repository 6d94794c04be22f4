//! An interrupted build of a hierarchy has no effect on others, which use the same device.

use lasertrace::Error;
use lasertrace::accel::{Accel, Backend};
use lasertrace::mesh::shapes;
use std::sync::Arc;

/// An interrupted build ends neither a build in another thread nor the next build in its
/// thread.
#[test]
fn an_interrupted_build_ends_no_other() {
    // Enough triangles that Embree calls the progress function before the end.
    let mesh = Arc::new(shapes::sphere(10.0, 2e-4).unwrap());
    let interrupted = |share| match share > 0.3 {
        true => Err(Error::Interrupted),
        false => Ok(()),
    };
    let interrupt = |backend| {
        let stopped = Accel::build_with(backend, &mesh, 2, &interrupted);
        assert!(matches!(stopped, Err(Error::Interrupted)));
    };
    let build = |backend| drop(Accel::build_with(backend, &mesh, 2, &|_| Ok(())).unwrap());
    for &backend in Backend::ALL {
        std::thread::scope(|scope| {
            scope.spawn(|| (0..8).for_each(|_| interrupt(backend)));
            (0..8).for_each(|_| build(backend));
        });
        interrupt(backend);
        build(backend);
    }
}
