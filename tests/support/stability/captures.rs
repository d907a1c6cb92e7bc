//! Hard captures: both fields learned for a short while from photographs of the demo head whose
//! cameras or world are odd, beside the same of plain ones; or the error that names what is wrong.

use super::Breadth;
use super::case::{Cases, StabilityCase};
use glam::{DMat3, DVec3, Vec2, Vec3};
use std::path::Path;
use tiface::Result;
use tiface::capture::Split;
use tiface::capture::synthetic::{SyntheticHead, SyntheticOptions, cameras, write_photographs};
use tiface::config::{Config, Preset, Stage, iface::Start};
use tiface::geom::{Camera, Ray, SdfField, Similarity};
use tiface::iface::IFace;
use tiface::io::Limits;
use tiface::pipeline::{Session, reconstruct};
use tiface::run::Run;
use tiface::tface::FieldMean;

/// A capture and what may come of it.
struct Hard {
    name: &'static str,
    cameras: Vec<(Camera, bool)>,
    world: Similarity,
    /// How much worse than the plain capture at most: dB of the radiance field, mm of the distance
    /// field. Else what the error says, of which a part is here.
    expected: Result<[f64; 2], &'static str>,
}

/// Learns from the captures, the plain one first.
pub(super) fn cases(scratch: &Path, breadth: Breadth) -> Result<Vec<StabilityCase>> {
    let mut cases = Cases::new("captures");
    let mut plain = None;
    let wanted = |hard: &Hard| breadth == Breadth::All || FEW.contains(&hard.name);
    for (i, hard) in captures().into_iter().filter(wanted).enumerate() {
        let folder = scratch.join(format!("{i}"));
        write_photographs(&folder, &hard.cameras, &hard.world, 1, hard.name)?;
        let learned = learn(&folder, &hard.world, config(&folder));
        match (hard.expected, learned) {
            (Err(words), learned) => {
                let named =
                    learned.err().is_some_and(|e| e.to_string().contains(words) && !e.hint().is_empty());
                cases.add(format!("{}: named in an error", hard.name), f64::from(!named), 0.0, "missing");
            }
            (Ok(worse), learned) => {
                let [db, mm] = learned.unwrap_or([f64::NAN; 2]);
                // the plain one beside a perfect one of 40 dB
                let [plain_db, plain_mm] = plain.unwrap_or([40.0, 0.0]);
                plain.get_or_insert([db, mm]);
                let of = |what: &str| format!("{}: {what}", hard.name);
                cases.add(of("radiance, below what a plain capture gives"), plain_db - db, worse[0], "dB");
                cases.add(of("surface, farther off than a plain one"), mm - plain_mm, worse[1], "mm");
            }
        }
    }
    variances(&mut cases, scratch)?;
    Ok(cases.done)
}

/// One capture of each kind.
const FEW: [&str; 6] = [
    "plain",
    "a world 1e6 from its origin",
    "a field of view of 0.1 degrees",
    "three views",
    "one view",
    "one pose for all",
];

/// Photographs of 40 × 50 pixels.
const SIZE: (u32, u32) = (40, 50);

/// The captures, the plain one first.
fn captures() -> Vec<Hard> {
    let options = SyntheticOptions { width: SIZE.0, height: SIZE.1, train: 10, test: 1, seed: 3 };
    let plain = cameras(&options);
    let train: Vec<_> = plain.iter().filter(|(_, train)| *train).cloned().collect();
    let test: Vec<_> = plain.iter().filter(|(_, train)| !train).cloned().collect();
    let of = |some: Vec<(Camera, bool)>| [some, test.clone()].concat();
    let first = |n: usize| of(train.iter().skip(3).step_by(2).take(n).cloned().collect());
    let center = SyntheticHead.bounds().center().as_dvec3();
    let aimed = |position: DVec3, like: &Camera| {
        let back = (position - center).normalize();
        let right = DVec3::Z.cross(back).normalize();
        Camera { rotation: DMat3::from_cols(right, back.cross(right), back), position, ..like.clone() }
    };
    let in_line = (0..10).map(|i| {
        let position = center + DVec3::new(-1.1 + 2.2 * i as f64 / 9.0, -0.9, 0.1);
        (aimed(position, &plain[0].0), true)
    });
    // a frame of 0.1 degrees from so far that it holds the same
    let far = |(camera, train): &(Camera, bool)| {
        let focal = 0.5 * SIZE.1 as f64 / 0.05f64.to_radians().tan();
        let position = center + (camera.position - center) * (focal / camera.fx);
        (Camera { fx: focal, fy: focal, position, ..camera.clone() }, *train)
    };
    // before the nose: it sees nothing but head, so that its mask is white and it is left out
    let near = aimed(center + DVec3::new(0.02, -0.16, 0.02), &plain[0].0);
    let moved = |scale: f64, by: f64| Similarity::scale_translate(scale, DVec3::new(by, -by, 0.3 * by));
    let still = Similarity::IDENTITY;
    let hard = |name, cameras, world, expected| Hard { name, cameras, world, expected };
    let twice = train.iter().flat_map(|c| [c.clone(), c.clone()]).collect();
    vec![
        hard("plain", plain.clone(), still, Ok([30.0, 30.0])),
        hard("a world 1e6 from its origin", plain.clone(), moved(1.0, 1e6), Ok([0.1, 0.1])),
        hard("a world in kilometers", plain.clone(), moved(1e-3, 0.0), Ok([0.1, 0.1])),
        hard("a world in millimeters", plain.clone(), moved(1e3, 0.0), Ok([0.1, 0.1])),
        hard("a field of view of 0.1 degrees", plain.iter().map(far).collect(), still, Ok([1.5, 3.0])),
        hard(
            "a camera that sees nothing but head",
            of([train.clone(), vec![(near, true)]].concat()),
            still,
            Ok([0.5, 0.5]),
        ),
        hard("every pose twice", of(twice), still, Ok([0.5, 0.5])),
        hard("all poses in a line", of(in_line.collect()), still, Ok([2.0, 2.0])),
        hard("three views", first(3), still, Ok([3.0, 4.0])),
        hard("two views", first(2), still, Ok([4.0, 12.0])),
        hard("one view", first(1), still, Err("1 cameras cannot place a head")),
        hard("one pose for all", of(vec![train[4].clone(); 6]), still, Err("stand at one place")),
    ]
}

/// Settings of a training of a second or two.
fn config(folder: &Path) -> Config {
    let mut config = Config::preset(Preset::Draft);
    config.capture.path = folder.into();
    let f = &mut config.iface;
    (f.steps, f.rays, f.max_rays, f.samples, f.start, f.stereo) = (100, 256, 512, 4096, Start::Sphere, 0.0);
    (f.levels, f.log2_table, f.occupancy_resolution) = (6, 12, 32);
    (f.anneal_end, f.warmup, f.min_step) = (0.5, 0.2, 0.02);
    let f = &mut config.tface;
    (f.steps, f.rays, f.voxels_start, f.voxels_final, f.hidden) = (100, 512, 16 * 16 * 16, 32 * 32 * 32, 32);
    (f.density_rank, f.color_rank) = (vec![4; 3], vec![8; 3]);
    config
}

/// Learns both fields. Returns the PSNR of the held-out view inside its mask, dB, and the mean
/// distance of the learned zero from the head's surface, millimeters.
fn learn(folder: &Path, world: &Similarity, config: Config) -> Result<[f64; 2]> {
    let run = Run::quiet(&folder.join("run"));
    let session = Session::open(&config, &run)?;
    reconstruct(&session, Stage::Tface)?;
    reconstruct(&session, Stage::Iface)?;
    let scene = session.scene()?;
    let radiance = FieldMean::load("tface", &run.path(Stage::Tface), config.tface.learned())?;
    let surface = IFace::load(&run.path(Stage::Iface), &config.iface, scene.hull.as_ref())?;
    let (mut error, mut count) = (0.0, 0.0);
    for view in session.capture().split(Split::Test) {
        let loaded = view.load(&Limits::default())?;
        let camera = view.camera.transformed(&scene.scene_from_world);
        let mask = loaded.mask.map(|m| m.values).unwrap_or_default();
        let pixel =
            |i: usize| Vec2::new((i % SIZE.0 as usize) as f32 + 0.5, (i / SIZE.0 as usize) as f32 + 0.5);
        let (at, rays): (Vec<usize>, Vec<Ray>) = (0..mask.len())
            .filter(|&i| mask[i] == 255)
            .filter_map(|i| Some((i, Ray { t_min: 0.0, t_max: f32::INFINITY, ..camera.ray(pixel(i))? })))
            .unzip();
        for (i, seen) in at.iter().zip(radiance.render(&rays, camera.forward())) {
            let off = |k: usize| (seen.color[k] - loaded.photo.rgb[*i][k] as f32 / 255.0) as f64;
            error += (0..3).map(|k| off(k).powi(2)).sum::<f64>();
            count += 3.0;
        }
    }
    let scene_from_head = scene.scene_from_world.after(world);
    let points: Vec<Vec3> = SyntheticHead
        .surface_points(400, 1)
        .into_iter()
        .filter(|&p| SyntheticHead.is_head(p))
        .map(|p| scene_from_head.point(p))
        .collect();
    let (values, slopes) = surface.sdf_gradient(&points);
    let off = |(f, g): (&f32, &Vec3)| (f.abs() / g.length().max(0.1)) as f64;
    let mean = values.iter().zip(&slopes).map(off).sum::<f64>() / points.len() as f64;
    Ok([-10.0 * (error / count).log10(), 1e3 * mean / scene_from_head.scale])
}

/// Trainings that start as sharp, and as soft, as a surface may be, and change that as fast as can
/// be.
fn variances(cases: &mut Cases, scratch: &Path) -> Result<()> {
    let folder = scratch.join("0");
    // the run of the plain capture, whose masks need no second check
    let run = Run::quiet(&folder.join("run"));
    for (name, start) in [("sharpest", 1.38), ("softest", -1.38)] {
        let mut config = config(&folder);
        (config.iface.variance, config.iface.lr_variance) = (start, 1.0);
        // at such a rate it swings from one end to the other: it is stuck only if it is never seen
        // elsewhere
        let (mut outside, mut stays) = (0f64, 1f64);
        for steps in (1..=8).rev().map(|k| 5 * k) {
            config.iface.steps = steps;
            run.fresh(&[Stage::Iface.to_string()])?;
            let session = Session::open(&config, &run)?;
            let done = reconstruct(&session, Stage::Iface).ok();
            let inv_s = done.and_then(|done| done.last()?.1.summary["inv_s"].as_f64());
            outside += inv_s.map_or(f64::NAN, |s| f64::from(!(1e-6..=1e6).contains(&s)));
            stays *= inv_s.map_or(f64::NAN, |s| f64::from((s.ln() - 10.0 * start).abs() < 1e-3));
            if stays == 0.0 {
                break;
            }
        }
        cases.add(format!("{name} surface, rate 1: sharpness leaves its range"), outside, 0.0, "times");
        cases.add(format!("{name} surface, rate 1: it stays as it was"), stays, 0.0, "times");
    }
    Ok(())
}
