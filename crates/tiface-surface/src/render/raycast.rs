//! Ray casting of a mesh: a pixel is the mean of `samples × samples` rays, colored where they hit.
//!
//! Edges get twice as many rays each way to avoid aliasing: pixels where some rays hit and some
//! miss, or where depth jumps by more than a surface seen at 84° would within one pixel. Misses
//! count as transparent black. The mean is of sRGB-coded values, as everywhere in rendering here:
//! the fields composite coded color, so alpha does too.

use super::hits::RayHits;
use super::view::RenderedView;
use glam::Vec2;
use rayon::prelude::*;
use tiface_base::geom::{Bvh, Camera, Hit, Mesh, Ray, ShellCaster, Similarity};

/// Pixels processed at once by one thread: bounds memory, and gives the color network large
/// batches.
const BATCH: usize = 8192;

/// Columns of a band that are rendered one row after the other.
const COLUMNS: usize = 16;

/// Depth change over one pixel, in pixel footprints, from which on it is an edge: tan 84°.
const JUMP: f32 = 10.0;

/// Options of ray casting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RaycastOptions {
    /// Rays along each side of a pixel; twice as many on an edge. 1 is one ray everywhere.
    pub samples: u32,
    /// The transform from the mesh's coordinates (which the camera is in, too) to those of depth
    /// and normals.
    pub world_from_scene: Similarity,
}

impl Default for RaycastOptions {
    fn default() -> RaycastOptions {
        RaycastOptions { samples: 2, world_from_scene: Similarity::IDENTITY }
    }
}

/// Casts the rays of a camera at a mesh.
///
/// `color` gets batches of hits and returns sRGB-coded colors in 0..=1, one per hit, `[n, 3]`;
/// missing ones are black. It runs on several threads at once.
///
/// # Examples
///
/// A triangle before a camera at the origin's front, painted by its normal:
///
/// ```
/// use glam::Vec3;
/// use tiface_base::geom::{Bvh, Camera, Mesh};
/// use tiface_surface::render::{RaycastOptions, raycast};
///
/// let corners = [(-3.0, -3.0), (3.0, -3.0), (0.0, 3.0)].map(|(x, y)| Vec3::new(x, y, 0.0));
/// let mesh = Mesh { positions: corners.to_vec(), triangles: vec![[0, 1, 2]], ..Mesh::default() };
/// let camera = Camera::above(20, 10, 10.0, 2.0);
/// let view = raycast(&Bvh::new(&mesh), &mesh, None, &camera, &RaycastOptions::default(), |hits| {
///     hits.normals.iter().map(|n| n.to_array().map(|v| v.abs())).collect()
/// });
/// // blue where the normal is +Z, two units away
/// assert_eq!(view.color.pixel(10, 5), [0.0, 0.0, 1.0, 1.0]);
/// assert_eq!(view.depth.pixel(10, 5), [2.0]);
/// ```
pub fn raycast(
    bvh: &Bvh,
    mesh: &Mesh,
    shells: Option<&ShellCaster>,
    camera: &Camera,
    options: &RaycastOptions,
    color: impl Fn(&RayHits) -> Vec<[f32; 3]> + Sync,
) -> RenderedView {
    raycast_each(bvh, mesh, shells, camera, options, 1, |hits| vec![color(hits)]).remove(0)
}

/// Casts the rays of a camera at a mesh once, for `count` views, at least 1, that differ in color
/// alone. `colors` returns what `color` of [`raycast`] does, a list for each view.
pub fn raycast_each(
    bvh: &Bvh,
    mesh: &Mesh,
    shells: Option<&ShellCaster>,
    camera: &Camera,
    options: &RaycastOptions,
    count: usize,
    colors: impl Fn(&RayHits) -> Vec<Vec<[f32; 3]>> + Sync,
) -> Vec<RenderedView> {
    let (width, height) = (camera.width, camera.height);
    let mut view = RenderedView::new(width, height, true);
    if width == 0 || height == 0 {
        return vec![view; count.max(1)];
    }
    let w = width as usize;
    let rows = (BATCH / w).max(1);
    let mut others = vec![view.color.clone(); count.max(1) - 1];
    // the rows of each band in every picture
    let mut pictures: Vec<Vec<&mut [[f32; 4]]>> = Vec::new();
    for image in std::iter::once(&mut view.color).chain(&mut others) {
        let parts = image.data.as_chunks_mut::<4>().0.chunks_mut(rows * w);
        pictures.resize_with(parts.len(), Vec::new);
        pictures.iter_mut().zip(parts).for_each(|(band, part)| band.push(part));
    }
    let bands = pictures
        .into_par_iter()
        .zip(view.depth.data.par_chunks_mut(rows * w))
        .zip(view.normal.data.par_chunks_mut(rows * w * 3));
    let caster = Raycaster { bvh, mesh, shells, camera, options };
    bands.enumerate().for_each(|(band, ((mut rgba, depth), normal))| {
        caster.band(band * rows, &mut rgba, depth, normal.as_chunks_mut().0, &colors);
    });
    let others: Vec<RenderedView> =
        others.into_iter().map(|color| RenderedView { color, ..view.clone() }).collect();
    std::iter::once(view).chain(others).collect()
}

/// The data that every band of rows shares.
struct Raycaster<'a> {
    bvh: &'a Bvh,
    mesh: &'a Mesh,
    shells: Option<&'a ShellCaster<'a>>,
    camera: &'a Camera,
    options: &'a RaycastOptions,
}

impl Raycaster<'_> {
    /// Renders the rows from `top` on, as many as the slices hold, of all pictures.
    fn band(
        &self,
        top: usize,
        rgba: &mut [&mut [[f32; 4]]],
        depth: &mut [f32],
        normal: &mut [[f32; 3]],
        colors: &(impl Fn(&RayHits) -> Vec<Vec<[f32; 3]>> + Sync),
    ) {
        let w = self.camera.width as usize;
        let n = self.options.samples.max(1) as usize;
        let mut queue = RayHits::default();
        let mut found = Vec::with_capacity(4 * n * n);
        // neighbors meet the same boxes and triangles
        let rows = depth.len() / w;
        let columns = (0..w).step_by(COLUMNS).map(|left| left..w.min(left + COLUMNS));
        let pixels =
            columns.flat_map(|tile| (0..rows).flat_map(move |y| tile.clone().map(move |x| y * w + x)));
        for i in pixels {
            let (x, y) = ((i % w) as f32, (top + i / w) as f32);
            let center = self.cast(x + 0.5, y + 0.5);
            if let Some((ray, Some(hit))) = &center {
                depth[i] = self.depth(ray, hit) * self.options.world_from_scene.scale as f32;
                let up = self.options.world_from_scene.direction(self.mesh.shading_normal(hit));
                normal[i] = up.normalize_or_zero().to_array();
            }
            found.clear();
            if n == 1 {
                found.push(center);
            } else {
                self.cast_grid(x, y, n, &mut found);
                if self.is_edge(&found) {
                    found.clear();
                    self.cast_grid(x, y, 2 * n, &mut found);
                }
            }
            for one in &found {
                self.enqueue(&mut queue, i, one, 1.0 / found.len() as f32);
            }
            if queue.pixels.len() >= BATCH {
                queue.shade_each(rgba, colors);
            }
        }
        queue.shade_each(rgba, colors);
    }

    /// Casts `n × n` rays through the pixel at a corner.
    fn cast_grid(&self, x: f32, y: f32, n: usize, found: &mut Vec<CastRay>) {
        let sub = |k: usize| (k as f32 + 0.5) / n as f32;
        found.extend((0..n * n).map(|k| self.cast(x + sub(k % n), y + sub(k / n))));
    }

    /// Returns the ray through a pixel and its first hit with the mesh; `None` where the lens has
    /// no ray.
    fn cast(&self, x: f32, y: f32) -> CastRay {
        let ray = self.camera.ray(Vec2::new(x, y))?;
        Some((ray, self.bvh.closest_hit(&ray)))
    }

    /// Returns the distance along the viewing axis, in the mesh's units.
    fn depth(&self, ray: &Ray, hit: &Hit) -> f32 {
        hit.t * ray.direction.dot(self.camera.forward())
    }

    /// Returns whether some of a pixel's rays miss and others hit, or hit at very different depths.
    fn is_edge(&self, found: &[CastRay]) -> bool {
        let (mut low, mut high) = (f32::INFINITY, 0f32);
        for one in found {
            let depth = match one {
                Some((ray, Some(hit))) => self.depth(ray, hit),
                _ => 0.0,
            };
            (low, high) = (low.min(depth), high.max(depth));
        }
        // 0 is a miss; a pixel's footprint is depth / focal length
        (low == 0.0) != (high == 0.0) || high - low > JUMP * low / self.camera.fx.abs() as f32
    }

    /// Queues a hit for its color.
    fn enqueue(&self, queue: &mut RayHits, pixel: usize, met: &CastRay, weight: f32) {
        let Some((ray, hit)) = met else { return };
        let mut left = weight;
        let mut push = |hit: &Hit, weight: f32| {
            queue.points.push(self.mesh.point_at(hit));
            queue.normals.push(self.mesh.shading_normal(hit));
            queue.directions.push(ray.direction);
            queue.hits.push(*hit);
            queue.pixels.push((pixel, weight));
        };
        if let Some(shells) = self.shells {
            shells.cast(ray, hit.map_or(ray.t_max, |hit| hit.t), |_, hit, alpha| {
                push(&hit, left * alpha);
                left *= 1.0 - alpha;
            });
        }
        if let Some(hit) = hit {
            push(hit, left);
        }
    }
}

/// A ray, and its first hit of the mesh.
type CastRay = Option<(Ray, Option<Hit>)>;

#[cfg(test)]
mod tests {
    use super::*;
    use glam::{DMat3, DVec3, Vec3};
    use tiface_base::geom::{ShellLayer, Shells};

    fn camera(width: u32, height: u32) -> Camera {
        Camera::above(width, height, 100.0, 4.0)
    }

    /// Wound towards +z.
    fn half_plane(right_of: f32) -> Mesh {
        Mesh {
            positions: vec![
                Vec3::new(right_of, -50.0, 0.0),
                Vec3::new(right_of + 50.0, 0.0, 0.0),
                Vec3::new(right_of, 50.0, 0.0),
            ],
            triangles: vec![[0, 1, 2]],
            ..Mesh::default()
        }
    }

    fn red(hits: &RayHits) -> Vec<[f32; 3]> {
        vec![[1.0, 0.5, 0.0]; hits.points.len()]
    }

    #[test]
    fn an_edge_through_a_pixel_covers_half_of_it() {
        // pixel 10 spans x = 0..1 pixel right of the axis: 0..0.04 at distance 4. The edge is at
        // 0.02.
        let mesh = half_plane(0.02);
        let bvh = Bvh::new(&mesh);
        let view = raycast(&bvh, &mesh, None, &camera(20, 8), &RaycastOptions::default(), red);
        assert_eq!(view.color.pixel(9, 4), [0.0, 0.0, 0.0, 0.0]);
        assert_eq!(view.color.pixel(10, 4), [0.5, 0.25, 0.0, 0.5]);
        assert_eq!(view.color.pixel(11, 4), [1.0, 0.5, 0.0, 1.0]);
        let hard = RaycastOptions { samples: 1, ..Default::default() };
        let hard = raycast(&bvh, &mesh, None, &camera(20, 8), &hard, red);
        assert!(hard.color.data.as_chunks::<4>().0.iter().all(|p| p[3] == 0.0 || p[3] == 1.0));
    }

    #[test]
    fn depth_is_along_the_axis_in_world_units_and_normals_turn_with_the_world() {
        let mesh = half_plane(-10.0);
        let options = RaycastOptions {
            world_from_scene: Similarity {
                scale: 2.5,
                rotation: DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X), // z → x
                translation: DVec3::ONE,
            },
            ..Default::default()
        };
        let view = raycast(&Bvh::new(&mesh), &mesh, None, &camera(20, 8), &options, red);
        // the plane is 4 away along the axis for every pixel, 10 in the world
        for (d, n) in view.depth.data.iter().zip(view.normal.data.as_chunks::<3>().0) {
            assert!((d - 10.0).abs() < 1e-4);
            assert!(Vec3::from(*n).distance(Vec3::X) < 1e-6);
        }
        assert!(view.color.data.as_chunks::<4>().0.iter().all(|p| *p == [1.0, 0.5, 0.0, 1.0]));
    }

    #[test]
    fn one_surface_before_another_is_smoothed_too() {
        let mut mesh = half_plane(-10.0); // far, green
        let near = half_plane(0.015);
        mesh.positions.extend(near.positions.iter().map(|p| *p + Vec3::Z));
        mesh.triangles.push([3, 4, 5]);
        // the near edge, at 3 away, crosses pixel 10 (0..0.03) in its middle
        let color = |hits: &RayHits| -> Vec<[f32; 3]> {
            hits.points.iter().map(|p| if p.z > 0.5 { [1.0, 0.0, 0.0] } else { [0.0, 1.0, 0.0] }).collect()
        };
        let view = raycast(&Bvh::new(&mesh), &mesh, None, &camera(20, 8), &RaycastOptions::default(), color);
        assert_eq!(view.color.pixel(10, 4), [0.5, 0.5, 0.0, 1.0]);
        assert_eq!(view.color.pixel(9, 4), [0.0, 1.0, 0.0, 1.0]);
    }

    #[test]
    fn vertex_normals_are_interpolated_and_directions_are_unit() {
        let mut mesh = half_plane(-10.0);
        mesh.normals = vec![Vec3::X; 3];
        let color = |hits: &RayHits| -> Vec<[f32; 3]> {
            assert!(hits.directions.iter().all(|d| (d.length() - 1.0).abs() < 1e-5 && d.z < 0.0));
            hits.normals.iter().map(|n| n.to_array()).collect()
        };
        let view = raycast(&Bvh::new(&mesh), &mesh, None, &camera(6, 6), &RaycastOptions::default(), color);
        assert!((view.color.pixel(3, 3)[0] - 1.0).abs() < 1e-6 && view.color.pixel(3, 3)[2] < 1e-6);
    }

    #[test]
    fn batches_and_bands_leave_no_trace() {
        // taller than one band of 8192 pixels
        let mesh = half_plane(0.02);
        let bvh = Bvh::new(&mesh);
        let color = |hits: &RayHits| -> Vec<[f32; 3]> {
            hits.points.iter().map(|p| [p.x.abs() % 1.0, p.y.abs() % 1.0, 0.3]).collect()
        };
        let look = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| raycast(&bvh, &mesh, None, &camera(150, 200), &RaycastOptions::default(), color))
        };
        assert_eq!(look(1), look(3));
        let nothing = raycast(
            &Bvh::new(&Mesh::default()),
            &mesh,
            None,
            &camera(10, 10),
            &RaycastOptions::default(),
            red,
        );
        assert!(nothing.color.data.iter().chain(&nothing.depth.data).all(|v| *v == 0.0));
    }

    #[test]
    fn several_colors_of_the_same_rays_are_several_views() {
        let mesh = half_plane(0.02);
        let (bvh, camera, options) = (Bvh::new(&mesh), camera(150, 200), RaycastOptions::default());
        let green = |hits: &RayHits| -> Vec<[f32; 3]> {
            hits.points.iter().map(|p| [0.0, p.y.abs().min(1.0), 0.0]).collect()
        };
        let each = raycast_each(&bvh, &mesh, None, &camera, &options, 2, |hits| vec![red(hits), green(hits)]);
        assert!(each[0] == raycast(&bvh, &mesh, None, &camera, &options, red));
        assert!(each[1] == raycast(&bvh, &mesh, None, &camera, &options, green));
        assert!(each.len() == 2 && each[0] != each[1]);
    }

    #[test]
    fn layers_are_blended_over_the_mesh_and_beyond_it() {
        // the half plane x > 0 and two layers before all of it, moved by 0.1 and 0.2, that end half
        // a unit further left
        let mut mesh = half_plane(0.0);
        mesh.normals = vec![Vec3::Z; mesh.positions.len()];
        let wide = half_plane(-0.5);
        let moved = |by: f32| {
            let offsets = vec![by; mesh.positions.len()];
            ShellLayer { offsets, alphas: vec![0.5; mesh.positions.len()] }
        };
        let shells = Shells { layers: vec![moved(0.1), moved(0.2)], ..Shells::default() };
        let source = Mesh { normals: mesh.normals.clone(), ..wide };
        let caster = ShellCaster::new(&source, &shells);
        let red = |hits: &RayHits| vec![[1.0, 0.0, 0.0]; hits.hits.len()];
        let options = RaycastOptions { samples: 1, ..RaycastOptions::default() };
        let view = raycast(&Bvh::new(&mesh), &mesh, Some(&caster), &camera(40, 8), &options, red);
        // all of it where the mesh is behind; 1 − ½ · ½ where only the layers are; nothing beyond.
        // A pixel is 0.04 wide.
        assert_eq!(view.color.pixel(30, 4), [1.0, 0.0, 0.0, 1.0]);
        assert_eq!(view.color.pixel(15, 4), [0.75, 0.0, 0.0, 0.75]);
        assert_eq!(view.color.pixel(4, 4), [0.0; 4]);
        // depth is that of the mesh
        assert_eq!((view.depth.pixel(30, 4), view.depth.pixel(15, 4)), (&[4.0][..], &[0.0][..]));
    }
}
