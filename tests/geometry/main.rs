//! Tests of meshes, ray queries and assemblies.

#[path = "../common/flattened.rs"]
mod flattened;
#[path = "../common/program.rs"]
mod program;
#[path = "../common/random.rs"]
mod random;

mod assembly;
mod curvature;
mod embedding;
mod groups;
mod limits_degenerate;
mod limits_mutated;
mod limits_rays;
mod mesh_cases;
mod meshes;
mod obj_reference;
mod part_in_view;
mod real_parts;
