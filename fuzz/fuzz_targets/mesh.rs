//! What the mesh targets share.

use lasertrace::mesh;
use std::path::Path;

/// Bytes become a valid mesh with a finite report, or an error of one line that says
/// what was expected.
pub fn mesh_or_error(bytes: &[u8]) {
    match mesh::parse(Path::new("part"), bytes, 1.0) {
        Ok(mesh) => {
            let vertices = mesh.positions.len();
            assert!(!mesh.triangles.is_empty());
            let corners = mesh.triangles.as_flattened();
            assert!(corners.iter().all(|&v| (v as usize) < vertices));
            assert!(mesh.positions.iter().all(|p| p.is_finite()));
            let report = mesh::report(&mesh);
            assert!(report.volume_mm3.is_finite());
            assert!(!report.to_string().contains("NaN"));
        }
        Err(error) => {
            let text = error.to_string();
            assert!(text.contains("expected") && text.lines().count() == 1, "{text}");
            assert_eq!(error.exit_code(), 65);
        }
    }
}
