//! A head-like mesh.

use glam::Vec3;
use tiface::geom::Mesh;

/// A wrinkled ball with a nose: a cube's six n × n grids blown up, 12 n² triangles.
pub fn head(n: usize) -> Mesh {
    let mut mesh = Mesh::default();
    for side in 0..6 {
        let (axis, sign) = (side % 3, if side < 3 { 1.0 } else { -1.0 });
        let first = mesh.positions.len() as u32;
        for j in 0..=n {
            for i in 0..=n {
                let (a, b) = (2.0 * i as f32 / n as f32 - 1.0, 2.0 * j as f32 / n as f32 - 1.0);
                let mut d = [0.0; 3];
                (d[axis], d[(axis + 1) % 3], d[(axis + 2) % 3]) = (sign, a, b);
                let d = Vec3::from(d).normalize();
                let nose = 0.15 * (-(d - Vec3::Z).length_squared() * 40.0).exp();
                let wrinkles = 0.01 * (40.0 * d.x).sin() * (33.0 * d.y).sin() + 0.004 * (150.0 * d.z).sin();
                mesh.positions.push(Vec3::new(0.7, 0.9, 0.75) * d * (1.0 + nose + wrinkles));
            }
        }
        for j in 0..n as u32 {
            for i in 0..n as u32 {
                let at = |i: u32, j: u32| first + j * (n as u32 + 1) + i;
                let (a, b, c, d) = (at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1));
                let faces = [[a, b, c], [a, c, d]];
                mesh.triangles.extend(faces.map(|f| if sign > 0.0 { f } else { [f[0], f[2], f[1]] }));
            }
        }
    }
    mesh
}
