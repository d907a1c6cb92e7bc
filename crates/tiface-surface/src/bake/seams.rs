//! Both sides of a seam show the same color.
//!
//! Charts sample the surface with different grids of texels, so their bilinear pictures differ
//! along a common edge by what lies between texels: little on skin, much across the hard edge of a
//! painted brow. [`Seams::even`] moves the texels that a seam is drawn from as little as makes both
//! sides agree, in the least squares (after Liu, Ferguson, Jacobson, Gingold 2017, "Seamless: seam
//! erasure and seam-aware decoupling of shape from mesh resolution").

use glam::Vec2;
use std::collections::HashMap;
use tiface_base::geom::{Atlas, Mesh, bilinear_taps};
use tiface_base::image::{Image, Photo};
use tiface_base::math::cg::{conjugate_gradients, dot};

/// Weight of a texel's change relative to a difference along one texel of a seam: so low that the
/// rest of a step is below the rounding to bytes, enough that a texel which hardly matters to a
/// seam keeps its color.
const STIFFNESS: f64 = 0.02;

/// Number of points along each texel of a seam at which its sides are held together.
const DENSITY: f32 = 2.0;

/// Most rounds of conjugate gradients; each texel of a seam hangs on a dozen others only, so errors
/// fade fast.
const ROUNDS: usize = 60;

/// Number of points along each edge of a seam that [`Seams::step`] compares.
const POINTS: u32 = 4;

/// Edges of a mesh whose two triangles lie apart in the atlas.
pub struct Seams {
    /// Both sides of each edge, run through in the same direction: texture coordinates of its ends.
    edges: Vec<[(Vec2, Vec2); 2]>,
    width: u32,
    height: u32,
}

impl Seams {
    /// Finds the seams of a manifold mesh, closed or open, edge by edge in the order of its
    /// triangles.
    pub fn new(mesh: &Mesh, atlas: &Atlas) -> Seams {
        // each directed edge of a triangle, with its texture coordinates
        let mut sides: HashMap<(u32, u32), (Vec2, Vec2)> = HashMap::with_capacity(3 * mesh.triangles.len());
        for (t, uv) in mesh.triangles.iter().zip(&atlas.triangles) {
            for k in 0..3 {
                let at = |k: usize| atlas.uvs[uv[k % 3] as usize];
                sides.insert((t[k], t[(k + 1) % 3]), (at(k), at(k + 1)));
            }
        }
        let mut edges = Vec::new();
        for t in &mesh.triangles {
            for k in 0..3 {
                let (a, b) = (t[k], t[(k + 1) % 3]);
                if a > b {
                    continue;
                }
                if let (Some(&one), Some(&(q1, q0))) = (sides.get(&(a, b)), sides.get(&(b, a)))
                    && one != (q0, q1)
                {
                    edges.push([one, (q0, q1)]);
                }
            }
        }
        Seams { edges, width: atlas.width, height: atlas.height }
    }

    /// Returns the mean difference of the colors that both sides show at the same points of the
    /// surface, bilinear, in 255ths of the coded range, over points and channels; 0 without seams.
    ///
    /// `color` has the atlas's size.
    pub fn step(&self, color: &Photo) -> f64 {
        let mut sum = 0.0;
        for sides in &self.edges {
            for i in 0..POINTS {
                let s = (i as f32 + 0.5) / POINTS as f32;
                let [p, q] = sides.map(|(from, to)| {
                    let mut at = [0f32; 3];
                    for (texel, w) in self.taps(from.lerp(to, s)) {
                        (0..3).for_each(|c| at[c] += w * f32::from(color.rgb[texel as usize][c]));
                    }
                    at
                });
                sum += (0..3).map(|c| f64::from((p[c] - q[c]).abs())).sum::<f64>();
            }
        }
        sum / (3 * POINTS as usize * self.edges.len()).max(1) as f64
    }

    /// Changes the texels around the seams of a picture with 3 channels, so that both sides agree
    /// in the values that `code` makes of them; `decode` goes back. Texels between charts must be
    /// filled already: a seam is drawn from the first of them, too.
    ///
    /// # Panics
    ///
    /// Panics if the picture does not have the atlas's size and 3 channels.
    pub fn even(&self, image: &mut Image, code: impl Fn(f32) -> f32, decode: impl Fn(f32) -> f32) {
        assert_eq!((image.width, image.height, image.channels), (self.width, self.height, 3));
        let (texels, rows) = self.system();
        let at = |i: usize, c: usize| 3 * texels[i] as usize + c;
        for c in 0..3 {
            let start: Vec<f64> = (0..texels.len()).map(|i| f64::from(code(image.data[at(i, c)]))).collect();
            for (i, change) in changes(&rows, &start).into_iter().enumerate() {
                // a value that stays is not sent through the code and back
                if change.abs() > 1e-6 {
                    image.data[at(i, c)] = decode((start[i] + change) as f32);
                }
            }
        }
    }

    fn taps(&self, uv: Vec2) -> [(u32, f32); 4] {
        bilinear_taps(uv * self.size() - 0.5, [self.width, self.height])
    }

    fn size(&self) -> Vec2 {
        Vec2::new(self.width as f32, self.height as f32)
    }

    /// Returns the texels that seams are drawn from, and one row for each point of a seam: weights
    /// of its texels whose sum should be zero, times the root of the length the point stands for.
    fn system(&self) -> (Vec<u32>, Vec<[(u32, f64); 8]>) {
        let size = self.size();
        let mut texels = Vec::new();
        let mut known: HashMap<u32, u32> = HashMap::new();
        let mut rows = Vec::new();
        for sides in &self.edges {
            let length = sides.map(|(a, b)| ((b - a) * size).length());
            let length = length[0].max(length[1]);
            let points = (length * DENSITY).ceil().clamp(1.0, 4096.0) as u32;
            let weight = f64::from((length / points as f32).sqrt());
            for i in 0..points {
                let s = (i as f32 + 0.5) / points as f32;
                let [p, q] = sides.map(|(from, to)| self.taps(from.lerp(to, s)));
                let mut row = [(0, 0.0); 8];
                for (entry, (texel, w)) in row.iter_mut().zip(p.into_iter().chain(q.map(|(t, w)| (t, -w)))) {
                    let index = *known.entry(texel).or_insert_with(|| {
                        texels.push(texel);
                        texels.len() as u32 - 1
                    });
                    *entry = (index, weight * f64::from(w));
                }
                rows.push(row);
            }
        }
        (texels, rows)
    }
}

/// Returns the x that minimizes ‖R (start + x)‖² + STIFFNESS ‖x‖², by conjugate gradients.
fn changes(rows: &[[(u32, f64); 8]], start: &[f64]) -> Vec<f64> {
    // Rᵀ R v + stiffness v
    let normal = |v: &[f64], stiffness: f64, out: &mut [f64]| {
        out.iter_mut().zip(v).for_each(|(out, v)| *out = stiffness * v);
        for row in rows {
            let sum: f64 = row.iter().map(|&(i, w)| w * v[i as usize]).sum();
            row.iter().for_each(|&(i, w)| out[i as usize] += w * sum);
        }
    };
    let (mut x, mut residual) = (vec![0.0; start.len()], vec![0.0; start.len()]);
    normal(start, 0.0, &mut residual);
    residual.iter_mut().for_each(|r| *r = -*r);
    let enough = 1e-8 * dot(&residual, &residual);
    conjugate_gradients(
        &mut x,
        residual,
        |v, out| normal(v, STIFFNESS, out),
        |r, z| z.copy_from_slice(r),
        |round, r| round == ROUNDS || dot(r, r) <= enough,
    );
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;

    #[test]
    fn only_seams_count_and_their_step_is_in_bytes() {
        // two triangles over a common edge 0–1, laid apart: the left half of the picture and the
        // right half
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
        assert!((Seams::new(&mesh, &apart).step(&photo) - 3.0).abs() < 1e-5);
        let joined = Atlas {
            uvs: vec![uv(0.5, 0.9), uv(0.5, 0.1), uv(0.1, 0.5), uv(0.9, 0.5)],
            triangles: vec![[0, 1, 2], [1, 0, 3]],
            ..apart
        };
        assert_eq!(Seams::new(&mesh, &joined).step(&photo), 0.0);
    }

    /// Two triangles over a common edge, laid apart and turned, on a picture of stripes.
    fn striped() -> (Mesh, Atlas, Image) {
        let mesh = Mesh {
            positions: vec![Vec3::ZERO, Vec3::Y, Vec3::X, -Vec3::X],
            triangles: vec![[0, 1, 3], [1, 0, 2]],
            ..Mesh::default()
        };
        let uv = |x: f32, y: f32| Vec2::new(x, y) / 64.0;
        let atlas = Atlas {
            uvs: vec![
                uv(28.3, 60.0),
                uv(21.7, 4.2),
                uv(3.0, 30.0),
                uv(35.9, 5.0),
                uv(36.2, 61.3),
                uv(60.0, 30.0),
            ],
            triangles: vec![[0, 1, 2], [3, 4, 5]],
            width: 64,
            height: 64,
        };
        let mut image = Image::new(64, 64, 3);
        for (i, v) in image.data.iter_mut().enumerate() {
            let y = i / 192;
            *v = if y % 8 < 4 { 0.2 } else { 0.7 };
        }
        (mesh, atlas, image)
    }

    fn coded(image: &Image) -> Photo {
        let rgb = image.data.as_chunks::<3>().0.iter();
        let rgb = rgb.map(|c| c.map(|v| (255.0 * v).round() as u8)).collect();
        Photo { width: image.width, height: image.height, rgb, alpha: None }
    }

    #[test]
    fn stripes_meet_and_only_texels_of_the_seam_move() {
        let (mesh, atlas, mut image) = striped();
        let seams = Seams::new(&mesh, &atlas);
        let before = image.clone();
        let step = seams.step(&coded(&image));
        seams.even(&mut image, |v| v, |v| v.clamp(0.0, 1.0));
        let after = seams.step(&coded(&image));
        assert!(step > 10.0 && after < 1.0, "{step} -> {after}");
        for y in 0..64u32 {
            for x in 0..64u32 {
                // the left side leans from column 28.3 to 21.7, the right one stands at 36
                let lean = 28.3 + (21.7 - 28.3) * (60.0 - (y as f32 + 0.5)) / 55.8;
                let near = (x as f32 + 0.5 - lean).abs() < 2.0 || (x as f32 + 0.5 - 36.0).abs() < 2.0;
                assert!(near || image.pixel(x, y) == before.pixel(x, y), "{x} {y}");
            }
        }
    }

    #[test]
    fn a_picture_that_agrees_stays_to_the_bit() {
        let (mesh, atlas, mut image) = striped();
        image.data.fill(0.3);
        let before = image.clone();
        Seams::new(&mesh, &atlas).even(&mut image, |v| v.sqrt(), |v| v * v);
        assert_eq!(image, before);
        // and no seam at all is no system
        let joined = Atlas { triangles: vec![[0, 1, 2], [1, 0, 5]], ..atlas };
        assert!(Seams::new(&mesh, &joined).system().1.is_empty());
        Seams::new(&mesh, &joined).even(&mut image, |v| v, |v| v);
        assert_eq!(image, before);
    }

    #[test]
    fn no_other_change_of_one_texel_does_better() {
        // the minimum: the objective grows with every texel moved either way
        let (mesh, atlas, image) = striped();
        let (texels, rows) = Seams::new(&mesh, &atlas).system();
        let start: Vec<f64> = texels.iter().map(|&t| f64::from(image.data[3 * t as usize])).collect();
        let x = changes(&rows, &start);
        let value = |x: &[f64]| {
            let point = |row: &[(u32, f64); 8]| -> f64 {
                row.iter().map(|&(i, w)| w * (start[i as usize] + x[i as usize])).sum()
            };
            rows.iter().map(|r| point(r).powi(2)).sum::<f64>()
                + STIFFNESS * x.iter().map(|x| x * x).sum::<f64>()
        };
        let least = value(&x);
        for i in (0..x.len()).step_by(7) {
            for by in [-1e-3, 1e-3] {
                let mut other = x.clone();
                other[i] += by;
                assert!(value(&other) > least, "{i}");
            }
        }
    }
}
