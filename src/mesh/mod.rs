use crate::math::{Aabb, DVec3};
pub struct Mesh {
    pub positions: Vec<DVec3>,
    pub triangles: Vec<[u32; 3]>,
}
impl Mesh {
    pub fn bounds(&self) -> Aabb {
        Aabb::of(self.positions.iter().copied())
    }
    pub fn triangle(&self, i: usize) -> [DVec3; 3] {
        self.triangles[i].map(|v| self.positions[v as usize])
    }
}
