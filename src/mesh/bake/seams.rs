//! Do both sides of a seam show the same colour?

use crate::geom::{Atlas, Mesh};
use crate::image::Photo;
use glam::Vec2;
use std::collections::HashMap;

/// Points looked at along each edge of a seam.
const POINTS: u32 = 4;

/// Mean difference of the colours that both sides of a seam show at the same points of the surface, bilinear, in
/// 255ths of the coded range, over points and channels; 0 where there is no seam.
pub fn seam_step(mesh: &Mesh, atlas: &Atlas, color: &Photo) -> f64 {
    // each directed edge of a triangle, with its texture coordinates
    let mut sides: HashMap<(u32, u32), (Vec2, Vec2)> = HashMap::with_capacity(3 * mesh.triangles.len());
    for (t, uv) in mesh.triangles.iter().zip(&atlas.triangles) {
        for k in 0..3 {
            let at = |k: usize| atlas.uvs[uv[k % 3] as usize];
            sides.insert((t[k], t[(k + 1) % 3]), (at(k), at(k + 1)));
        }
    }
    let (mut sum, mut count) = (0.0, 0u64);
    for t in &mesh.triangles {
        for k in 0..3 {
            let (a, b) = (t[k], t[(k + 1) % 3]);
            if a > b {
                continue;
            }
            let (Some(one), Some(other)) = (sides.get(&(a, b)), sides.get(&(b, a))) else { continue };
            if one.0 == other.1 && one.1 == other.0 {
                continue;
            }
            for i in 0..POINTS {
                let s = (i as f32 + 0.5) / POINTS as f32;
                let (p, q) = (one.0.lerp(one.1, s), other.1.lerp(other.0, s));
                let (p, q) = (look_up(color, p), look_up(color, q));
                sum += (0..3).map(|c| f64::from((p[c] - q[c]).abs())).sum::<f64>();
                count += 3;
            }
        }
    }
    if count > 0 { sum / count as f64 } else { 0.0 }
}

/// Bilinear, in bytes.
fn look_up(photo: &Photo, uv: Vec2) -> [f32; 3] {
    let at = |u: f32, n: u32| {
        let p = (u * n as f32 - 0.5).clamp(0.0, (n - 1) as f32);
        (p as usize, (p as usize + 1).min(n as usize - 1), p.fract())
    };
    let ((x0, x1, fx), (y0, y1, fy)) = (at(uv.x, photo.width), at(uv.y, photo.height));
    let texel = |x: usize, y: usize| photo.rgb[y * photo.width as usize + x].map(f32::from);
    let (a, b, c, d) = (texel(x0, y0), texel(x1, y0), texel(x0, y1), texel(x1, y1));
    std::array::from_fn(|k| {
        let (top, bottom) = (a[k] + fx * (b[k] - a[k]), c[k] + fx * (d[k] - c[k]));
        top + fy * (bottom - top)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn only_seams_count_and_their_step_is_in_bytes() {
        // two triangles over a common edge 0–1, laid apart: the left half of the picture and the right half
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::Y, Vec3::X, -Vec3::X],
            triangles: vec![[0, 1, 3], [1, 0, 2]],
            ..Mesh::default()
        };
        let uv = |x: f32, y: f32| Vec2::new(x, y);
        let apart = Atlas {
            uvs: vec![uv(0.2, 0.9), uv(0.2, 0.1), uv(0.0, 0.5), uv(0.7, 0.1), uv(0.7, 0.9), uv(0.9, 0.5)],
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            width: 10,
            height: 10,
        };
        let rgb = (0..100).map(|i| if i % 10 < 5 { [10, 20, 30] } else { [13, 20, 36] }).collect();
        let photo = Photo { width: 10, height: 10, rgb, alpha: None };
        // 3, 0 and 6 of three channels: 3
        assert!((seam_step(&mesh, &apart, &photo) - 3.0).abs() < 1e-5);
        let joined = Atlas {
            uvs: vec![uv(0.5, 0.9), uv(0.5, 0.1), uv(0.1, 0.5), uv(0.9, 0.5)],
            triangles: vec![[0, 1, 2], [1, 0, 3]],
            ..apart
        };
        assert_eq!(seam_step(&mesh, &joined, &photo), 0.0);
    }
}
