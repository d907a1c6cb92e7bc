use super::*;
use glam::{DMat3, DVec3, Vec2, Vec3};
use tiface_base::Quiet;
use tiface_base::geom::{Camera, ShellLayer, Shells};
use tiface_base::image::{Gray, Photo};
use tiface_base::math::rng;

/// Cells along a side of the square.
const N: u32 = 16;

/// The vertex in its middle.
const MIDDLE: u32 = N / 2 * (N + 1) + N / 2;

/// Pixels along a side of a photograph.
const SIDE: u32 = 64;

/// A square of cells from −1 to 1 at z = 0 that faces +z, and an atlas of 2 × 2 texels for each.
fn square() -> (Mesh, Atlas) {
    let mut mesh = Mesh::default();
    let mut atlas = Atlas { width: 2 * N, height: 2 * N, ..Atlas::default() };
    for j in 0..=N {
        for i in 0..=N {
            let at = Vec2::new(i as f32, j as f32) / N as f32;
            mesh.positions.push(Vec3::new(2.0 * at.x - 1.0, 1.0 - 2.0 * at.y, 0.0));
            mesh.colors.push([0.3; 3]);
            atlas.uvs.push(at);
        }
    }
    for j in 0..N {
        for i in 0..N {
            let at = |i: u32, j: u32| j * (N + 1) + i;
            mesh.triangles.push([at(i, j + 1), at(i + 1, j + 1), at(i + 1, j)]);
            mesh.triangles.push([at(i, j + 1), at(i + 1, j), at(i, j)]);
        }
    }
    atlas.triangles = mesh.triangles.clone();
    (mesh, atlas)
}

/// Paint of the square: a smooth pattern.
fn paint(p: Vec3) -> [f32; 3] {
    [0.5 + 0.2 * (4.0 * p.x).sin(), 0.4 + 0.2 * (3.0 * p.y).cos(), 0.3 + 0.1 * p.x * p.y]
}

/// Cameras on an arc around +y, three units away, that look at the middle.
fn cameras(count: usize) -> Vec<Camera> {
    let camera = |k: usize| {
        let angle = (k as f64 + 0.5) / count as f64 - 0.5;
        let rotation = DMat3::from_rotation_y(1.6 * angle) * DMat3::from_rotation_x(0.4 * angle);
        let position = rotation * DVec3::new(0.0, 0.0, 3.0);
        Camera { rotation, position, ..Camera::above(SIDE, SIDE, 1.04 * f64::from(SIDE), 3.0) }
    };
    (0..count).map(camera).collect()
}

/// What the cameras see of the square: `look` of a point and the unit direction to the viewer;
/// white beside it.
fn photos(cameras: &[Camera], look: impl Fn(usize, Vec3, Vec3) -> [f32; 3]) -> Vec<(Photo, Gray)> {
    let view = |(v, camera): (usize, &Camera)| {
        let (width, height) = (camera.width, camera.height);
        let (mut rgb, mut values) = (Vec::new(), Vec::new());
        for i in 0..width * height {
            let (mut sum, mut inside) = ([0f32; 3], 0);
            for k in 0..16 {
                let sub = Vec2::new((k % 4) as f32 + 0.5, (k / 4) as f32 + 0.5) / 4.0;
                let ray = camera.ray(Vec2::new((i % width) as f32, (i / width) as f32) + sub).unwrap();
                let p = ray.at(-ray.origin.z / ray.direction.z);
                let on = p.x.abs() <= 1.0 && p.y.abs() <= 1.0;
                inside += u32::from(on);
                let c = if on { look(v, p, -ray.direction) } else { [1.0; 3] };
                (0..3).for_each(|k| sum[k] += c[k] / 16.0);
            }
            rgb.push(sum.map(|c| (c * 255.0 + 0.5) as u8));
            values.push((255 * inside / 16) as u8);
        }
        (Photo { width, height, rgb, alpha: None }, Gray { width, height, values })
    };
    cameras.iter().enumerate().map(view).collect()
}

fn photographs<'a>(cameras: &'a [Camera], photos: &'a [(Photo, Gray)]) -> Vec<Photograph<'a>> {
    let of = |(camera, (photo, mask)): (&'a Camera, &'a (Photo, Gray))| Photograph {
        camera,
        photo,
        mask: Some(mask),
        valid: None,
        rendered: false,
    };
    cameras.iter().zip(photos).map(of).collect()
}

/// The largest error of vertices' colors whose point `of` names.
fn worst(mesh: &Mesh, colors: &[[f32; 3]], of: impl Fn(Vec3) -> bool) -> f32 {
    let each = mesh.positions.iter().zip(colors).filter(|(p, _)| of(**p));
    let error = |(p, c): (&Vec3, &[f32; 3])| (0..3).map(|k| (c[k] - paint(*p)[k]).abs()).fold(0.0, f32::max);
    each.map(error).fold(0.0, f32::max)
}

fn gray(atlas: &Atlas) -> Image {
    let mut image = Image::new(atlas.width, atlas.height, 3);
    image.data.fill(0.3);
    image
}

#[test]
fn matt_paint_comes_back_and_nothing_depends_on_the_view() {
    let (mesh, atlas) = square();
    let cameras = cameras(12);
    let photos = photos(&cameras, |_, p, _| paint(p));
    let photographs = photographs(&cameras, &photos);
    let image = gray(&atlas);
    for colors in [Colors::Texels(&atlas, &image), Colors::Vertices] {
        let fitted = fit(&mesh, None, colors, &photographs, 2, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
        assert!(worst(&mesh, &fitted.vertices, |p| p.abs().max_element() < 0.95) < 0.02);
        // the borders are looked at by fewer pixels; the white beside the square must not bleed in
        assert!(worst(&mesh, &fitted.vertices, |_| true) < 0.06, "{:?}", fitted.report);
        let report = fitted.report;
        assert!(report.psnr[1] > 40.0 && report.psnr[0] < 20.0 && report.seen > 0.9, "{report:?}");
        assert!((report.gains[0] - 1.0).abs() < 0.01 && (report.gains[1] - 1.0).abs() < 0.01);
    }
}

#[test]
fn gloss_is_found_in_the_degree_that_it_has() {
    let (mesh, atlas) = square();
    let cameras = cameras(12);
    let gloss = |d: Vec3| 0.3 * d.x;
    let photos = photos(&cameras, |_, p, d| paint(p).map(|c| c + gloss(d)));
    let image = gray(&atlas);
    let turned = Mat3::from_rotation_z(0.7);
    let photographs = photographs(&cameras, &photos);
    let fitted =
        fit(&mesh, None, Colors::Texels(&atlas, &image), &photographs, 2, turned, &Quiet).unwrap().unwrap();
    let harmonics = fitted.harmonics.expect("photographs that were left out want it");
    assert!(fitted.report.psnr[2] > fitted.report.psnr[1] + 6.0, "{:?}", fitted.report);
    // in the middle, from the left and from the right of what the cameras saw
    let middle = mesh.triangles.iter().position(|t| t.contains(&MIDDLE)).unwrap();
    let hit = tiface_base::geom::Hit { t: 1.0, triangle: middle as u32, u: 0.3, v: 0.3 };
    let at = |d: Vec3| harmonics.seen_along(-d, &hit, mesh.triangles[middle])[0];
    let (left, right) = (Vec3::new(-0.5, 0.0, 0.866), Vec3::new(0.5, 0.0, 0.866));
    assert!((at(right) - at(left) - (gloss(right) - gloss(left))).abs() < 0.06, "{} {}", at(left), at(right));
}

#[test]
fn from_where_no_photograph_looks_the_diffuse_color_is_seen() {
    let (mesh, atlas) = square();
    // cameras stand from 46° to the left to 46° to the right: z is 0.69 to 1, and the mean of the
    // gloss 0.04
    let gloss = |d: Vec3| 0.6 * d.z - 0.5;
    let cameras = cameras(12);
    let photos = photos(&cameras, |_, p, d| paint(p).map(|c| c + gloss(d)));
    let image = gray(&atlas);
    let photographs = photographs(&cameras, &photos);
    let colors = Colors::Texels(&atlas, &image);
    let fitted = fit(&mesh, None, colors, &photographs, 2, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
    let harmonics = fitted.harmonics.unwrap();
    let middle = mesh.triangles.iter().position(|t| t.contains(&MIDDLE)).unwrap();
    let hit = tiface_base::geom::Hit { t: 1.0, triangle: middle as u32, u: 0.3, v: 0.3 };
    let at = |d: Vec3| harmonics.seen_along(-d, &hit, mesh.triangles[middle])[0];
    // 0.08 brighter from the front than from the side
    let (front, side) = (at(Vec3::Z), at(Vec3::new(0.5, 0.0, 0.866)));
    assert!((0.03..0.12).contains(&(front - side)), "{front} {side}");
    // nobody looks from above or below, where the gloss, continued, is 0.35 darker than its mean
    for d in [Vec3::new(0.0, 0.95, 0.312), Vec3::new(0.0, -0.95, 0.312)] {
        assert!(at(d).abs() < 0.15, "{}", at(d));
    }
}

#[test]
fn the_exposure_of_photographs_is_not_painted_onto_the_head() {
    let (mesh, atlas) = square();
    let cameras = cameras(12);
    let gain = |v: usize| 1.0 + 0.08 * rng::normal(3, 0, v as u64).clamp(-1.0, 1.0);
    let photos = photos(&cameras, |v, p, _| paint(p).map(|c| gain(v) * c));
    let image = gray(&atlas);
    let photographs = photographs(&cameras, &photos);
    let colors = Colors::Texels(&atlas, &image);
    let fitted = fit(&mesh, None, colors, &photographs, 1, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
    assert!(fitted.report.psnr[2] > 38.0, "{:?}", fitted.report);
    let [low, high] = fitted.report.gains;
    let all: Vec<f32> = (0..12).map(|v| 1.0 / gain(v)).collect();
    let range = all.iter().fold(0f32, |a, b| a.max(*b)) / all.iter().fold(9f32, |a, b| a.min(*b));
    assert!((high / low / range - 1.0).abs() < 0.02, "{low} {high} {range}");
}

#[test]
fn what_nobody_sees_keeps_its_color_and_no_photograph_fits_nothing() {
    let (mut mesh, atlas) = square();
    // a second square far away behind the cameras
    let n = mesh.positions.len() as u32;
    mesh.positions.extend_from_within(..);
    mesh.positions[n as usize..].iter_mut().for_each(|p| p.z = 9.0);
    mesh.colors.extend_from_within(..);
    mesh.triangles.extend_from_within(..);
    let half = mesh.triangles.len() / 2;
    mesh.triangles[half..].iter_mut().flatten().for_each(|i| *i += n);
    let cameras = cameras(3);
    let photos = photos(&cameras, |_, p, _| paint(p));
    let photographs = photographs(&cameras, &photos);
    let fitted =
        fit(&mesh, None, Colors::Vertices, &photographs, 1, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
    assert!(fitted.vertices[n as usize..].iter().all(|c| *c == [0.3; 3]));
    let blind = [Photograph {
        mask: Some(&Gray { values: vec![249; (SIDE * SIDE) as usize], ..photos[0].1.clone() }),
        ..photographs[0]
    }];
    assert!(fit(&mesh, None, Colors::Vertices, &blind, 1, Mat3::IDENTITY, &Quiet).unwrap().is_none());
    let image = gray(&atlas);
    let (square, _) = square();
    assert!(
        fit(&square, None, Colors::Texels(&atlas, &image), &[], 1, Mat3::IDENTITY, &Quiet).unwrap().is_none()
    );
}

#[test]
fn fits_do_not_depend_on_the_threads() {
    let (mesh, atlas) = square();
    let cameras = cameras(7);
    let photos = photos(&cameras, |_, p, d| paint(p).map(|c| c + 0.1 * d.y));
    let photographs = photographs(&cameras, &photos);
    let image = gray(&atlas);
    let look = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let colors = Colors::Texels(&atlas, &image);
            let fitted = fit(&mesh, None, colors, &photographs, 2, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
            (fitted.texels, fitted.harmonics)
        })
    };
    assert_eq!(look(1), look(3));
}

#[test]
fn layers_in_front_take_part_in_the_colors() {
    // one layer of half opacity, a fifth before the square: what it shows beside the square's own
    // color is that of another place, and the fit unmixes the two
    let (mut mesh, atlas) = square();
    mesh.normals = vec![Vec3::Z; mesh.positions.len()];
    let n = mesh.positions.len();
    let shells = Shells {
        layers: vec![ShellLayer { offsets: vec![0.2; n], alphas: vec![0.5; n] }],
        ..Shells::default()
    };
    let cameras = cameras(12);
    let stripes = |p: Vec3| [0.5 + 0.2 * (12.0 * p.x).sin(); 3];
    let photos = photos(&cameras, |_, p, d| {
        // where the ray met the layer, whose color is that of the square under it
        let (own, before) = (stripes(p), stripes(p + 0.2 / d.z * d));
        std::array::from_fn(|k| 0.5 * (own[k] + before[k]))
    });
    let photographs = photographs(&cameras, &photos);
    let image = gray(&atlas);
    let error = |shells: Option<&Shells>| {
        let colors = Colors::Texels(&atlas, &image);
        let fitted = fit(&mesh, shells, colors, &photographs, 0, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
        // beside the border, where rays miss the layer
        let each = mesh.positions.iter().zip(&fitted.vertices).filter(|(p, _)| p.abs().max_element() < 0.6);
        each.map(|(p, c)| (c[0] - stripes(*p)[0]).abs()).fold(0f32, f32::max)
    };
    let (with, without) = (error(Some(&shells)), error(None));
    assert!(with < 0.04 && without > 2.0 * with, "{with} {without}");
}

#[test]
fn nothing_is_judged_by_rendered_views() {
    // gloss, which photographs that are left out would find
    let (mesh, atlas) = square();
    let cameras = cameras(12);
    let photos = photos(&cameras, |_, p, d| paint(p).map(|c| c + 0.3 * d.x));
    let image = gray(&atlas);
    let taken = photographs(&cameras, &photos);
    let degree = |pictures: &[Photograph]| {
        let colors = Colors::Texels(&atlas, &image);
        let fitted = fit(&mesh, None, colors, pictures, 2, Mat3::IDENTITY, &Quiet).unwrap().unwrap();
        // both degrees with the first smoothness, the better one with the second
        let tried: Vec<u32> = fitted.report.left_out.iter().map(|c| c.0).collect();
        let better = if fitted.report.left_out[2].2 > fitted.report.left_out[1].2 { 2 } else { 1 };
        assert_eq!(tried, [0, 1, 2, better]);
        assert_eq!(fitted.report.left_out.iter().filter(|c| c.1 == VERTICES[1].others).count(), 2);
        (fitted.report.degree, fitted.report.pixels)
    };
    let rendered: Vec<Photograph> = taken.iter().map(|p| Photograph { rendered: true, ..*p }).collect();
    assert_eq!(degree(&taken).0, 1);
    assert_eq!(degree(&rendered).0, 0);
    // but colors are fitted to them, too
    let both: Vec<Photograph> = taken.iter().chain(&rendered).copied().collect();
    let (degree, pixels) = degree(&both);
    assert!(degree == 1 && pixels > taken.iter().map(Photograph::head_pixels).sum::<usize>());
}
