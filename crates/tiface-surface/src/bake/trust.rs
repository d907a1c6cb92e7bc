//! How far what photographs show of a surface can be trusted.
//!
//! A camera tells the more of a point the more directly it looks: seen at an angle, a pixel covers
//! more of the surface, an error of the surface moves it farther, and in front of lamps light comes
//! through hair. Each camera counts with the fourth power of the cosine between its line of sight
//! and the normal; trust goes from 0 to 1 between two sums of these. Smaller sums are a glimpse: it
//! is trusted, too, where it agrees with what is certain of its material (`smooth`).

use super::cover::Bands;
use super::fill::fill;
use super::light::Visibility;
use crate::appearance::{Nodes, Photograph};
use rayon::prelude::*;
use tiface_base::geom::{Atlas, Bvh, Camera, Hit, Mesh};
use tiface_base::image::{Gray, Image};

/// Sums of cos⁴ at which trust begins and is complete: one camera at 68 degrees, and one at 56 or
/// five at 68.
const TRUST: [f32; 2] = [0.02, 0.1];

/// The same of a glimpse: one camera at 75 degrees, and one at 65.
const GLIMPSE: [f32; 2] = [0.005, 0.03];

/// Rounds in which trust is smoothed over neighboring vertices: normals are rough, and trust must
/// not come and go from vertex to vertex.
pub(super) const ROUNDS: usize = 2;

/// What the cameras have seen of the vertices of a mesh.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Seen {
    /// Number of cameras that see each vertex, up to 255: in the frame, at most 75 degrees from its
    /// normal, nothing between.
    pub cameras: Vec<u8>,
    /// Trust in each vertex's color, 0..=1.
    pub trust: Vec<f32>,
    /// The same if its color agrees with others of its material; not less.
    pub glimpse: Vec<f32>,
}

impl Seen {
    /// Looks at the vertices of a mesh. `reach` as in [`super::BakeConfig`]. A camera
    /// counts for trust only where the mask of its photograph shows the head alone; without
    /// photographs `cameras` do, wherever they look.
    pub fn of(mesh: &Mesh, cameras: &[Camera], photographs: &[Photograph], reach: f32) -> Seen {
        let bvh = Bvh::new(mesh);
        let visibility = Visibility { cameras, bvh: &bvh, clearance: 0.5 * reach, max_cameras: usize::MAX };
        let (eyes, masked): (Vec<&Camera>, bool) = match photographs {
            [] => (cameras.iter().collect(), false),
            some => (some.iter().map(|p| p.camera).collect(), true),
        };
        let own = (mesh.normals.len() != mesh.positions.len()).then(|| mesh.angle_weighted_normals());
        let normals = own.as_ref().unwrap_or(&mesh.normals);
        let one = |vertex: usize| {
            let (p, normal) = (mesh.positions[vertex], normals[vertex]);
            let (mut count, mut sum) = (0u8, 0f32);
            for (i, camera) in eyes.iter().enumerate() {
                let Some((_, cosine)) = visibility.seen_from(camera, p, p, normal) else { continue };
                count = count.saturating_add(1);
                if !masked || photographs[i].shows_head_at(p) {
                    sum += cosine.powi(4);
                }
            }
            (count, sum)
        };
        let found: Vec<(u8, f32)> =
            (0..mesh.positions.len()).into_par_iter().with_min_len(256).map(one).collect();
        let (cameras, sums): (Vec<u8>, Vec<f32>) = found.into_iter().unzip();
        let sums = Nodes::vertices(mesh).smoothed(sums, ROUNDS);
        Seen { cameras, trust: ramp(&sums, TRUST), glimpse: ramp(&sums, GLIMPSE) }
    }
}

/// Returns values as 0 below a range, 1 above it, and smoothly between.
fn ramp(values: &[f32], [low, high]: [f32; 2]) -> Vec<f32> {
    let share = |value: &f32| ((value - low) / (high - low)).clamp(0.0, 1.0);
    values.iter().map(share).map(|t| t * t * (3.0 - 2.0 * t)).collect()
}

/// Returns the shares of a mesh's area that 0, 1, 2, and 3 or more cameras see; a corner of a
/// triangle stands for a third of it. All 0 where the mesh has no numbers of cameras.
pub fn seen_shares(mesh: &Mesh) -> [f64; 4] {
    let mut areas = [0f64; 4];
    if mesh.seen_by.len() != mesh.positions.len() {
        return areas;
    }
    for (t, corners) in mesh.triangles.iter().enumerate() {
        let third = mesh.area(t as u32) / 3.0;
        corners.iter().for_each(|&v| areas[usize::from(mesh.seen_by[v as usize]).min(3)] += third);
    }
    let total: f64 = areas.iter().sum();
    areas.map(|a| if total > 0.0 { a / total } else { 0.0 })
}

/// Returns the number of cameras at the nearest corner of a triangle.
pub(super) fn seen_at(mesh: &Mesh, hit: &Hit) -> u8 {
    let [a, b, c] = hit.weights();
    let corner = if a >= b.max(c) { 0 } else { 2 - usize::from(b >= c) };
    mesh.seen_by[mesh.triangles[hit.triangle as usize][corner] as usize]
}

/// Returns a map of a mesh that knows its numbers of cameras, of the size of its atlas: black where
/// no camera looked, then 85 and 170, and 255 for 3 and more.
pub fn seen_map(mesh: &Mesh, atlas: &Atlas, gutter_px: u32) -> Gray {
    let (width, height) = (atlas.width, atlas.height);
    let mut image = Image::new(width, height, 1);
    let mut covered = vec![false; image.data.len()];
    let bands = Bands::new(atlas, 1);
    for sample in (0..bands.len()).flat_map(|band| bands.samples(atlas, band, 1)) {
        covered[sample.texel as usize] = true;
        image.data[sample.texel as usize] = f32::from(seen_at(mesh, &sample.hit()).min(3));
    }
    fill(&mut image, &covered, gutter_px);
    let values = image.data.iter().map(|v| 85 * v.round() as u8).collect();
    Gray { width, height, values }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bake::testing::ball;
    use glam::Vec3;
    use tiface_base::image::Photo;

    #[test]
    fn the_map_has_a_gray_for_each_number_of_cameras() {
        let head = ball();
        let (mut mesh, atlas) = (head.mesh, head.texture.unwrap().atlas);
        mesh.seen_by =
            mesh.positions.iter().map(|p| if p.x > 0.0 { 200 } else { u8::from(p.y > 0.0) }).collect();
        let map = seen_map(&mesh, &atlas, 4);
        assert!(map.values.iter().all(|v| [0, 85, 170, 255].contains(v)));
        let bands = Bands::new(&atlas, 1);
        for s in (0..bands.len()).flat_map(|band| bands.samples(&atlas, band, 1)) {
            let p = mesh.point_at(&s.hit());
            // a triangle's side away from borders
            if p.x > 2.0 {
                assert_eq!(map.values[s.texel as usize], 255, "{p}");
            } else if p.x < -2.0 && p.y.abs() > 2.0 {
                assert_eq!(map.values[s.texel as usize], if p.y > 0.0 { 85 } else { 0 }, "{p}");
            }
        }
    }

    /// Returns a ball with normals, its radius, and a camera above it.
    fn seen_ball() -> (Mesh, f32, Camera) {
        let mesh = ball().mesh;
        let radius = mesh.positions[0].length();
        (mesh, radius, Camera::above(64, 64, 64.0, 10.0 * f64::from(radius)))
    }

    #[test]
    fn a_camera_sees_its_side_of_a_ball_and_trusts_the_middle_of_it() {
        let (mut mesh, radius, camera) = seen_ball();
        let eye = camera.position.as_vec3();
        let seen = Seen::of(&mesh, &[camera.clone(), camera], &[], 0.02 * radius);
        for (v, p) in mesh.positions.iter().enumerate() {
            let cosine = (eye - *p).normalize().dot(mesh.normals[v]);
            // 75 degrees
            if (cosine - 0.2588).abs() > 0.01 {
                assert_eq!(seen.cameras[v], if cosine > 0.2588 { 2 } else { 0 }, "{p}");
            }
            // 2 · 0.75⁴ = 0.63 is enough, 2 · 0.2⁴ = 0.003 is not
            assert!(cosine < 0.75 || seen.trust[v] == 1.0, "{p} {}", seen.trust[v]);
            assert!(cosine > 0.1 || seen.trust[v] == 0.0, "{p} {}", seen.trust[v]);
            assert!(seen.glimpse[v] >= seen.trust[v], "{p}");
        }
        mesh.seen_by = seen.cameras;
        let shares = seen_shares(&mesh);
        // from 10 radii a point at the angle a from the axis is seen at a + atan(sin a / (10 − cos
        // a)), so up to 69.4°: (1 − cos 69.4°) / 2
        assert!((shares[2] - 0.325).abs() < 0.03 && shares[1] == 0.0 && shares[3] == 0.0, "{shares:?}");
        assert!((shares.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        mesh.seen_by.clear();
        assert_eq!(seen_shares(&mesh), [0.0; 4]);
    }

    #[test]
    fn where_the_mask_shows_no_head_a_camera_sees_but_is_not_trusted() {
        let (mesh, radius, camera) = seen_ball();
        let photo = Photo { width: 64, height: 64, rgb: vec![[9; 3]; 64 * 64], alpha: None };
        let none = Gray { width: 64, height: 64, values: vec![0; 64 * 64] };
        let photograph =
            Photograph { camera: &camera, photo: &photo, mask: Some(&none), valid: None, rendered: false };
        let seen = Seen::of(&mesh, &[], &[photograph], 0.02 * radius);
        assert!(seen.cameras.contains(&1) && seen.trust.iter().all(|&t| t == 0.0));
        let all = Photograph { mask: None, ..photograph };
        assert!(Seen::of(&mesh, &[], &[all], 0.02 * radius).trust.contains(&1.0));
    }

    #[test]
    fn a_hidden_point_is_not_seen() {
        let (mut mesh, radius, camera) = seen_ball();
        let plain = Seen::of(&mesh, std::slice::from_ref(&camera), &[], 0.02 * radius);
        // a triangle between, much larger than the ball
        let at = mesh.positions.len() as u32;
        let far = 20.0 * radius;
        let height = 3.0 * radius;
        for (x, y) in [(-far, -far), (far, -far), (0.0, far)] {
            mesh.positions.push(Vec3::new(x, y, height));
            mesh.normals.push(Vec3::Z);
        }
        mesh.triangles.push([at, at + 1, at + 2]);
        let hidden = Seen::of(&mesh, &[camera], &[], 0.02 * radius);
        assert!(plain.cameras.contains(&1));
        assert!(hidden.cameras[..at as usize].iter().all(|&n| n == 0));
    }
}
