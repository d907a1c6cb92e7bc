use super::project::UNIT;
use super::project::{Corner, Face, area};
use super::*;
use crate::render::{RaycastOptions, raycast};
use glam::{DMat3, DVec3, Vec2, Vec3};
use tiface_base::geom::{Bvh, Distortion, ShellCaster};
use tiface_base::math::rng;

fn white(hits: &RayHits) -> Vec<[f32; 3]> {
    vec![[1.0; 3]; hits.hits.len()]
}

/// A bumpy ball of 12 n² triangles.
fn ball(n: usize) -> Mesh {
    let mut mesh = Mesh::default();
    for side in 0..6 {
        let (axis, sign) = (side % 3, if side < 3 { 1.0 } else { -1.0 });
        let first = mesh.positions.len() as u32;
        for k in 0..(n + 1) * (n + 1) {
            let [a, b] = [k % (n + 1), k / (n + 1)].map(|v| 2.0 * v as f32 / n as f32 - 1.0);
            let mut d = [0.0; 3];
            (d[axis], d[(axis + 1) % 3], d[(axis + 2) % 3]) = (sign, a, b);
            let d = Vec3::from(d).normalize();
            mesh.positions.push(d * (1.0 + 0.05 * (9.0 * d.x).sin() * (7.0 * d.y).cos()));
        }
        for k in (0..n * (n + 1)).filter(|k| k % (n + 1) < n) {
            let [a, b, c, d] = [0, 1, n + 2, n + 1].map(|step| first + (k + step) as u32);
            let faces = [[a, b, c], [a, c, d]];
            mesh.triangles.extend(faces.map(|f| if sign > 0.0 { f } else { [f[0], f[2], f[1]] }));
        }
    }
    mesh
}

fn camera(side: u32) -> Camera {
    let rotation = DMat3::from_rotation_y(0.4) * DMat3::from_rotation_x(-0.3);
    let position = rotation * DVec3::new(0.0, 0.0, 4.0);
    Camera { rotation, position, ..Camera::above(side, side, 1.7 * f64::from(side), 0.0) }
}

/// The triangles at each place of [`GRID`] in each pixel of a tile; of faces at one depth the first
/// stays.
fn drawn<'a>(tile: &mut Tile, faces: impl Iterator<Item = &'a Face>) -> Vec<u32> {
    tile.move_to(0, 0, TILE, TILE);
    faces.for_each(|face| tile.draw(face));
    tile.triangle.as_flattened().to_vec()
}

/// Draws meshes until they have so many shared edges.
fn draw_shared_edges(least: usize) {
    // a square over the tile with random corners inside, cut at each of them in turn: every edge
    // within is shared by two triangles, and every sample of the tile lies in exactly one of all
    let mut tile = Tile::new();
    let (mut edges, mut meshes, mut drawings) = (0, 0, 0);
    while edges < least {
        // from corners on samples and lines through them to a few far beyond the tile, which need
        // 64 bits
        let step = [1, 32, 64, 256][meshes % 4];
        let reach = if meshes % 5 == 4 { 1 << 20 } else { 0 };
        let (low, high) = (-reach, TILE as i32 * UNIT + reach);
        let corner = |x, y| Corner { x, y, inverse_depth: 1.0 };
        let mut next = || {
            drawings += 1;
            rng::below(7, 0, drawings, (TILE as i32 * UNIT / step) as u64) as i32 * step
        };
        let frame = [(low, low), (high, low), (high, high), (low, high)].map(|(x, y)| corner(x, y));
        let mut triangles = vec![[frame[0], frame[1], frame[2]], [frame[0], frame[2], frame[3]]];
        for _ in 0..400 {
            let p = corner(next(), next());
            let holds = |t: &[Corner; 3]| (0..3).all(|k| area([t[k], t[(k + 1) % 3], p]) > 0);
            if let Some(found) = triangles.iter().position(holds) {
                let [a, b, c] = triangles.swap_remove(found);
                triangles.extend([[a, b, p], [b, c, p], [c, a, p]]);
            }
        }
        edges += triangles.len() * 3 / 2;
        meshes += 1;
        let face = |(i, &corners): (usize, &[Corner; 3])| Face { corners, triangle: i as u32, back: false };
        let faces: Vec<Face> = triangles.iter().enumerate().map(face).collect();
        let (first, last) = (drawn(&mut tile, faces.iter()), drawn(&mut tile, faces.iter().rev()));
        assert!(!first.contains(&NOTHING), "mesh {meshes} has a gap");
        assert!(first == last, "mesh {meshes} hits a sample twice");
    }
}

#[test]
fn shared_edges_leave_no_gap_and_hit_no_sample_twice() {
    draw_shared_edges(100_000);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; a million edges take seconds"]
fn a_million_shared_edges_leave_no_gap_and_hit_no_sample_twice() {
    draw_shared_edges(1_000_000);
}

#[test]
fn a_closed_mesh_covers_every_sample_from_both_sides() {
    // twice 30,000 shared edges through projection and binning: what its front covers, its back
    // covers, too
    let (mesh, camera) = (ball(60), camera(300));
    let front =
        raster(&mesh, None, &camera, &RasterOptions { cull: true, ..RasterOptions::default() }, white);
    let mut inside_out = mesh.clone();
    inside_out.triangles.iter_mut().for_each(|t| t.swap(1, 2));
    let back =
        raster(&inside_out, None, &camera, &RasterOptions { cull: true, ..RasterOptions::default() }, white);
    assert_eq!(front.view.color, back.view.color);
    assert!(front.triangles.iter().zip(&back.triangles).all(|(a, b)| (*a == NOTHING) == (*b == NOTHING)));
}

/// Shares of pixels with another triangle, largest difference of depth, and PSNR against the ray
/// caster.
fn differences(mesh: &Mesh, camera: &Camera) -> (f64, f32, f64) {
    let color = |hits: &RayHits| -> Vec<[f32; 3]> {
        let wave = |p: &Vec3| [0.5 + 0.4 * (5.0 * p.x).sin(), 0.5 + 0.4 * (4.0 * p.y).cos(), 0.4 + 0.3 * p.z];
        hits.points.iter().map(wave).collect()
    };
    let bvh = Bvh::new(mesh);
    let seen = raster(mesh, None, camera, &RasterOptions::default(), color);
    let cast = raycast(&bvh, mesh, None, camera, &RaycastOptions::default(), color);
    let (mut other, mut depth) = (0, 0f32);
    for (i, &triangle) in seen.triangles.iter().enumerate() {
        let at = Vec2::new((i as u32 % camera.width) as f32 + 0.5, (i as u32 / camera.width) as f32 + 0.5);
        let hit = camera.ray(at).and_then(|ray| bvh.closest_hit(&ray));
        if hit.map_or(NOTHING, |hit| hit.triangle) == triangle {
            depth = depth.max((seen.view.depth.data[i] - cast.depth.data[i]).abs());
        } else {
            other += 1;
        }
    }
    let square = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
    let error: f64 = seen.view.color.data.iter().zip(&cast.color.data).map(square).sum();
    let psnr = -10.0 * (error / cast.color.data.len() as f64).log10();
    (f64::from(other) / seen.triangles.len() as f64, depth, psnr)
}

#[test]
fn it_sees_what_the_ray_caster_sees() {
    let mut mesh = ball(24);
    mesh.normals = mesh.angle_weighted_normals();
    let straight = camera(300);
    let distortion = Distortion { k1: -0.25, k2: 0.08, p1: 0.004, p2: -0.003, ..Distortion::default() };
    let bent = Camera { distortion, ..straight.clone() };
    let most = 1e-5 * mesh.bounds().size().length();
    for (what, camera) in [("straight", &straight), ("bent", &bent)] {
        let (other, depth, psnr) = differences(&mesh, camera);
        assert!(other <= 1e-3 && depth <= most && psnr >= 42.0, "{what}: {other:.5} {depth:e} {psnr:.1}");
    }
    // a few large triangles, which a bent lens bends
    let (other, depth, psnr) = differences(&ball(1), &bent);
    assert!(other <= 1e-3 && depth <= most && psnr >= 42.0, "large: {other:.5} {depth:e} {psnr:.1}");
}

#[test]
fn layers_are_blended_as_the_ray_caster_blends_them() {
    let mut mesh = ball(24);
    mesh.normals = mesh.angle_weighted_normals();
    let layer = |k: usize| ShellLayer {
        offsets: mesh.positions.iter().map(|p| 0.04 * k as f32 * (1.0 + 0.3 * (5.0 * p.x).sin())).collect(),
        // none at all below
        alphas: mesh.positions.iter().map(|p| (0.6 * p.y + 0.1 * k as f32).clamp(0.0, 0.9)).collect(),
    };
    let shells = Shells { layers: [1, 2, 3].map(layer).to_vec(), ..Shells::default() };
    let camera = camera(140);
    let color = |hits: &RayHits| -> Vec<[f32; 3]> {
        hits.points.iter().map(|p| [0.5 + 0.4 * (5.0 * p.x).sin(), 0.5 + 0.4 * p.y, 0.6]).collect()
    };
    let (layers, caster) = (RasterLayers::new(&mesh, &shells), ShellCaster::new(&mesh, &shells));
    let options = RasterOptions::default();
    let bare = raster(&mesh, None, &camera, &options, color);
    let seen = raster(&mesh, Some(&layers), &camera, &options, color);
    let bvh = Bvh::new(&mesh);
    // fine rays: a layer's outline is no edge of the mesh, where the caster adds some
    let fine = RaycastOptions { samples: 4, ..RaycastOptions::default() };
    let cast = raycast(&bvh, &mesh, Some(&caster), &camera, &fine, color);
    let psnr = |a: &Image, b: &Image| {
        let error: f64 = a.data.iter().zip(&b.data).map(|(a, b)| f64::from(a - b).powi(2)).sum();
        -10.0 * (error / a.data.len() as f64).log10()
    };
    let (with, without) = (psnr(&seen.view.color, &cast.color), psnr(&bare.view.color, &cast.color));
    assert!(with > 40.0 && without < with - 10.0, "{with:.1} {without:.1}");
    // depth, normals and triangles are the mesh's, and no sample has more than all of its light
    assert!(seen.view.depth == bare.view.depth && seen.triangles == bare.triangles);
    assert!(seen.view.color.channel(3).iter().all(|a| *a <= 1.0 + 1e-5));
    // in memory of another view nothing is left of that
    let mut again = raster(&mesh, Some(&layers), &Camera { cx: 40.0, ..camera.clone() }, &options, color);
    raster_into(&mut again, &mesh, Some(&layers), &camera, &options, color);
    assert_eq!(again, seen);
    // and who needs neither points nor normals gets none
    let flat = |hits: &RayHits| {
        assert!(hits.points.is_empty() && hits.normals.is_empty());
        vec![[1.0; 3]; hits.hits.len()]
    };
    let bare = raster(&mesh, None, &camera, &RasterOptions { bare_hits: true, ..options }, flat);
    assert_eq!(bare.view.color, raster(&mesh, None, &camera, &options, white).view.color);
}

#[test]
fn what_reaches_behind_the_camera_is_cut() {
    // a floor one below the camera, from far before it to far behind it
    let at = [(-1e4, -1e4), (1e4, -1e4), (1e4, 1e4), (-1e4, 1e4)];
    let mesh = Mesh {
        positions: at.map(|(x, z)| Vec3::new(x, -1.0, z)).to_vec(),
        triangles: vec![[0, 2, 1], [0, 3, 2]],
        ..Mesh::default()
    };
    for distortion in [Distortion::default(), Distortion { k1: -0.1, ..Distortion::default() }] {
        let camera = Camera { distortion, ..Camera::above(64, 64, 64.0, 0.0) };
        let seen = raster(&mesh, None, &camera, &RasterOptions::default(), white);
        // below the horizon, in the middle of the picture, all; above it nothing
        let alpha = |x, y| seen.view.color.pixel(x, y)[3];
        assert!((0..64).all(|x| (0..31).all(|y| alpha(x, y) == 0.0) && (33..64).all(|y| alpha(x, y) == 1.0)));
        // 32 pixels below the middle of a focal length of 64 the floor is two away
        let depth = seen.view.depth.pixel(32, 63)[0];
        assert!(distortion.is_none() || depth > 1.9);
        assert!(!distortion.is_none() || (depth - 64.0 / 31.5).abs() < 1e-3, "{depth}");
    }
}

#[test]
fn the_nearer_surface_hides_the_other_and_backs_can_be_left_out() {
    // two squares over each other, the near one seen from behind
    let square =
        |z: f32| [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)].map(|(x, y)| Vec3::new(x, y, z));
    let mesh = Mesh {
        positions: [square(0.0), square(1.0)].concat(),
        triangles: vec![[0, 1, 2], [0, 2, 3], [4, 6, 5], [4, 7, 6]],
        ..Mesh::default()
    };
    let camera = Camera::above(40, 40, 40.0, 4.0);
    let at = |cull| {
        raster(&mesh, None, &camera, &RasterOptions { cull, ..RasterOptions::default() }, white).triangles
    };
    let middle = 20 * 40 + 22;
    assert!(at(false)[middle] >= 2 && at(true)[middle] < 2);
    // coverage: the near square spans 40 / 3 pixels each way: a border pixel is covered in part
    let view = raster(&mesh, None, &camera, &RasterOptions::default(), white).view;
    let alpha: f32 = view.color.channel(3).iter().sum();
    assert!((alpha - (80.0f32 / 3.0).powi(2)).abs() < 20.0, "{alpha}");
}

#[test]
fn threads_leave_no_trace() {
    let (mesh, camera) = (ball(30), camera(200));
    let view = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| raster(&mesh, None, &camera, &RasterOptions::default(), white))
    };
    assert_eq!(view(1), view(3));
    // slivers, points and nothing at all are no triangles
    let mut flat = mesh.clone();
    flat.triangles = vec![[0, 0, 1], [2, 2, 2]];
    for mesh in [flat, Mesh::default()] {
        let seen = raster(&mesh, None, &camera, &RasterOptions::default(), white);
        assert!(
            seen.triangles.iter().all(|&t| t == NOTHING) && seen.view.color.data.iter().all(|v| *v == 0.0)
        );
    }
}
