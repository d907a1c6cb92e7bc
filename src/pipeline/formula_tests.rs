//! The stages after learning, on the demo head's formula in place of trained fields.

use super::tests::{NoFields, demo_head, draft, head_run, masked, quiet};
use super::*;
use crate::config::{ColorSource, Config, Genus, Hair, MeshFormat, Method, ViewBackground};
use crate::metrics::compare;
use crate::run::{Run, read_record};
use glam::Vec3;
use serde_json::json;
use tempfile::TempDir;
use tiface_base::geom::{SdfField, Similarity};
use tiface_base::io::{self, Limits};
use tiface_base::{Quiet, Result};
use tiface_capture::synthetic::SyntheticHead;

/// The demo head itself, as a perfectly learned field would be; painted in soft stripes, a little
/// brighter seen from one side.
struct Exact {
    world_from_scene: Similarity,
}

impl SdfField for Exact {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        let scale = self.world_from_scene.scale as f32;
        points.iter().map(|&p| SyntheticHead.sdf(self.world_from_scene.point(p)) / scale).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        // the scene is scaled and moved, never turned: slopes are the same
        let gradient = |&p: &Vec3| SyntheticHead.gradient(self.world_from_scene.point(p));
        (self.sdf(points), points.iter().map(gradient).collect())
    }

    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        vec![1e4; points.len()]
    }

    fn colors(&self, points: &[Vec3], _: &[Vec3], counts: &[u32], directions: &[Vec3]) -> Vec<[f32; 3]> {
        let paint = |(p, d): (&Vec3, &Vec3)| {
            let stripes = (9.0 * *p).to_array().map(f32::sin);
            [0.6 + 0.1 * stripes[0] - 0.05 * d.x, 0.5 + 0.1 * stripes[1], 0.4 + 0.1 * stripes[2]]
        };
        let each = points.iter().zip(counts).flat_map(|(p, &n)| std::iter::repeat_n(p, n as usize));
        each.zip(directions).map(paint).collect()
    }
}

impl Surface for Exact {}

/// The demo head's formula in the place of all learned fields.
struct Formula(Exact);

impl Fields for Formula {
    fn surface(&self) -> Result<&dyn Surface> {
        Ok(&self.0)
    }

    fn radiance(&self, _: Stage) -> Result<&dyn Radiance> {
        panic!("no radiance field is asked for")
    }

    fn warnings(&self) -> Vec<&str> {
        vec!["the GPU failed"]
    }
}

/// Photographs whose silhouettes are sharp enough to hold a mesh against them.
const SHARP: ((u32, u32), (usize, usize)) = ((96, 120), (12, 2));

fn sharp_run() -> (TempDir, Config, Run) {
    head_run(SHARP.0, SHARP.1)
}

/// The pipeline with the head's formula in place of a trained field: any error is then not one of
/// the training.
#[test]
fn the_stages_after_learning_keep_the_exact_head_exact() {
    let dir = tempfile::tempdir().unwrap();
    let root = dir.path().join("run/capture");
    demo_head(&root, SHARP.0, SHARP.1);
    let mut config = draft(&root);
    config.mesh.resolution = 96;
    config.mesh.triangles = 5000;
    config.mesh.texture_px = 128;
    config.mesh.format = vec![MeshFormat::Glb];
    config.metrics.surface_points = 4000;
    config.render.background = ViewBackground::None;
    config.render.method = vec![Method::Raycast, Method::Volume];
    config.ensemble.members = vec![Method::Raycast];
    config.ensemble.weights = vec![1.0];
    // with them, views that are shown are filtered, and those that are blended are not
    config.render.residuals = false;
    let run = quiet(dir.path());
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Metrics).unwrap();
    assert_eq!(masked(&session).summary["masks"], 14);
    let scene = session.scene().unwrap();
    let exact = Formula(Exact { world_from_scene: scene.scene_from_world.inverse() });
    let mesh = complete(&session, Stage::Mesh, &exact).unwrap();
    assert_eq!(mesh.summary["closed"], true);
    let record = read_record(&run.path(Stage::Mesh)).unwrap().unwrap();
    assert!(record.warnings.iter().any(|w| w == "the GPU failed"), "{:?}", record.warnings);
    complete(&session, Stage::Render, &exact).unwrap();
    complete(&session, Stage::Ensemble, &NoFields).unwrap();
    let metrics = complete(&session, Stage::Metrics, &NoFields).unwrap();

    // a cell is 0.35 m / 96 = 3.6 mm = 1.5 % of the head; vertices lie on the surface, and the
    // chords between them err by a small part of a cell
    let truth = &metrics.summary["truth_percent_of_head"];
    assert!(truth["accuracy_mean"].as_f64().unwrap() < 0.15, "{truth}");
    assert!(truth["completeness_mean"].as_f64().unwrap() < 0.25, "{truth}");
    // silhouettes agree with the masks: a flat brown head over black is no photograph, but its
    // outline is in the right place, and next to nothing of it is outside
    let file = run.path("render/raycast/012.png");
    let render = pictures::read(&file).unwrap();
    let view = session.capture().views.iter().find(|v| v.name == "012").unwrap();
    let mask = view.load_mask(&Limits::default()).unwrap().unwrap();
    let off = |(p, m): (&[f32; 4], &u8)| (p[3] - *m as f32 / 255.0).abs() as f64;
    let mean = render.data.as_chunks::<4>().0.iter().zip(&mask.values).map(off).sum::<f64>()
        / mask.values.len() as f64;
    assert!(mean < 0.01, "{mean}");
    let outside = metrics.summary["raycast"]["mean_square_opacity_outside"].as_f64().unwrap();
    assert!(outside < 0.005, "{outside}");
    // a blend of one member is that member, to the byte
    let bytes = |file: &str| io::read_bytes(&run.path(file), &Limits::default()).unwrap();
    assert_eq!(bytes("ensemble/012.png"), bytes("render/raycast/012.png"));
    assert_eq!(metrics.summary["ensemble"]["head"], metrics.summary["raycast"]["head"]);

    // a file of it, cut below the chin, has the height that is asked for from chin to crown
    let asked = ExportRequest {
        size: Size::Head(0.24),
        cut: Cut::Chin,
        texture_px: Some(0),
        ..ExportRequest::default()
    };
    let kept = KeptHead::read(run.dir(), &config).unwrap().changed(&asked, &Quiet).unwrap();
    let height = f64::from(kept.size_m().unwrap()[1]);
    assert!((kept.head_height_m().unwrap() - 0.24).abs() < 1e-6);
    // a little is left below the chin, and less at the nape
    assert!((0.24..0.26).contains(&height), "{height}");
    assert!(kept.triangles(0) < 5000 && kept.triangles(0) > 2500, "{}", kept.triangles(0));
    let cut = kept.cut_m().unwrap();
    assert!(cut.loops == 1 && cut.face_triangles > 20 && cut.moved.abs() < 1e-3, "{cut:?}");

    // all of it again: nothing is loaded, nothing is done
    for stage in [Stage::Mask, Stage::Mesh, Stage::Render, Stage::Ensemble, Stage::Metrics] {
        assert!(complete(&session, stage, &NoFields).unwrap().skipped);
    }
    page::write_report(&session, false).unwrap();
    let page = String::from_utf8(bytes("report.html")).unwrap();
    assert!(page.contains("alt=\"012 by blend (ensemble)\"") && run.path("cameras.json").is_file());
    // the head to turn, and where the held-out photograph was taken from
    assert!(page.contains("class=\"viewer-glb\">Z2xURg") && page.contains("\"name\":\"012\""));
    assert!(page.len() < 8_000_000, "{}", page.len());
    assert!(bytes("mesh/head.glb").starts_with(b"glTF"));

    // one that was cut is named wherever the head is shown
    assert!(Preview::of_run(run.dir()).unwrap().warnings.is_empty());
    std::fs::write(run.path("mesh/head.glb"), b"glTF").unwrap();
    let warnings = Preview::of_run(run.dir()).unwrap().warnings;
    let error = head_page(&session).unwrap_err();
    assert!(error.to_string().contains("mesh/head.glb` has 4 bytes") && warnings.len() == 1, "{error}");
    assert!(warnings[0].contains("head.glb` has 4 bytes") && warnings[0].contains("`--fresh mesh`"));
}

/// The blend is fitted with the residuals of the views, whether they are still known or not.
#[test]
fn a_blend_has_the_same_bytes_with_the_residuals_of_its_views_and_with_its_own() {
    let (_dir, mut config, run) = sharp_run();
    config.mesh.resolution = 64;
    config.mesh.triangles = 3000;
    config.mesh.texture_px = 128;
    config.mesh.color = ColorSource::Photographs;
    config.render.method = vec![Method::Raycast, Method::Plain];
    config.ensemble.members = config.render.method.clone();
    assert!(config.render.residuals && config.ensemble.weights.is_empty());
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Ensemble).unwrap();
    masked(&session);
    let exact = Formula(Exact { world_from_scene: session.scene().unwrap().scene_from_world.inverse() });
    complete(&session, Stage::Mesh, &exact).unwrap();
    complete(&session, Stage::Render, &exact).unwrap();
    let kept = session.take_residuals();
    assert!(kept.is_some());
    session.keep_residuals(kept);
    let blend = |session: &Session| {
        assert!(!complete(session, Stage::Ensemble, &exact).unwrap().skipped);
        assert!(session.take_residuals().is_none());
        ["weights.json", "012.png"].map(|file| std::fs::read(run.path("ensemble").join(file)).unwrap())
    };
    let with_those_of_views = blend(&session);
    std::fs::remove_dir_all(run.path("ensemble")).unwrap();
    assert_eq!(blend(&Session::open(&config, &run).unwrap()), with_those_of_views);
}

/// Makes heads with colors from a source and lobes each. By the photographs, a head must
/// look as rays show it and like the photograph; for every other one the difference between what
/// rays and what a viewer shows is returned.
fn textured_heads(heads: &[(ColorSource, u32)]) -> Vec<f64> {
    let (dir, mut config, _) = sharp_run();
    config.mesh.resolution = 64;
    config.mesh.triangles = 4000;
    config.mesh.texture_px = 256;
    config.mesh.format = vec![MeshFormat::Glb, MeshFormat::Obj, MeshFormat::Ply];
    config.render.background = ViewBackground::None;
    config.render.method = vec![Method::Raycast, Method::Textured];
    config.render.residuals = false; // they are in no file
    config.ensemble.members = Vec::new();
    let mut errors = Vec::new();
    for (number, &(color, lobes)) in heads.iter().enumerate() {
        config.mesh.color = color;
        config.mesh.lobes = lobes;
        config.mesh.normal_map = lobes > 0;
        let run = quiet(&dir.path().join(number.to_string()));
        let session = Session::open(&config, &run).unwrap();
        session.remember(Stage::Render).unwrap();
        masked(&session);
        let exact = Formula(Exact { world_from_scene: session.scene().unwrap().scene_from_world.inverse() });
        let mesh = complete(&session, Stage::Mesh, &exact).unwrap().summary;
        assert_eq!((&mesh["closed"], &mesh["triangles"]), (&json!(true), &json!(4000)));
        // texels are small against the stripes: the step across a seam is below a byte
        assert!(mesh["steps"]["seam_step_255"].as_f64().unwrap() < 1.0, "{mesh}");
        complete(&session, Stage::Render, &exact).unwrap();
        for ending in ["glb", "obj", "mtl", "png", "ply"] {
            assert!(run.path(format!("mesh/head.{ending}")).is_file(), "{ending}");
        }
        let picture = |method: &str| pictures::read(&run.path(format!("render/{method}/012.png"))).unwrap();
        // by the photographs: what rays show is what a viewer shows, and near the photograph
        if color == ColorSource::Photographs {
            let view = session.capture.views.iter().find(|v| v.name == "012").unwrap();
            let photo = view.load(&Limits::default()).unwrap();
            let figures = |method: &str| {
                compare("012", &picture(method), &photo.photo, photo.mask.as_ref(), None).unwrap()
            };
            let [raycast, textured] = ["raycast", "textured"].map(|m| figures(m).psnr_masked.unwrap());
            // lobes have a quarter of the texture's few texels
            assert!(raycast > 28.0 && (raycast - textured).abs() < 0.3, "{raycast} {textured}");
            assert!(mesh["steps"]["appearance"]["psnr"][1].as_f64().unwrap() > 30.0, "{mesh}");
            continue;
        }
        let (whole, textured) = (picture("raycast"), picture("textured"));
        let (mut sum, mut n) = (0.0, 0);
        for (a, b) in whole.data.as_chunks::<4>().0.iter().zip(textured.data.as_chunks::<4>().0) {
            if a[3] == 1.0 && b[3] == 1.0 {
                sum += (0..3).map(|k| f64::from((a[k] - b[k]).powi(2))).sum::<f64>();
                n += 3;
            }
        }
        assert!(n > 3000);
        errors.push((sum / f64::from(n)).sqrt());
    }
    errors
}

/// The product looks like the whole surface, from cameras it was not baked for; what depends on the
/// view is in its lobes.
#[test]
fn the_textured_head_looks_like_the_field_it_was_baked_from() {
    let heads = [(ColorSource::Network, 0), (ColorSource::Network, 1), (ColorSource::Photographs, 1)];
    let errors = textured_heads(&heads);
    // the stripes swing by 0.1, the view's part by 0.05
    assert!(errors[0] < 0.025 && errors[1] < 0.6 * errors[0], "{errors:?}");
}

#[test]
fn a_surface_may_stay_open_and_without_a_texture() {
    let (_dir, mut config, run) = sharp_run();
    config.mesh.resolution = 64;
    config.mesh.triangles = 3000;
    config.mesh.texture_px = 0;
    config.mesh.cap = false;
    // the photographs' colors, which nothing is asked about, take longest
    (config.mesh.color, config.mesh.hair) = (ColorSource::Network, Hair::None);
    config.render.method = vec![Method::Textured];
    config.ensemble.members = Vec::new();
    let session = Session::open(&config, &run).unwrap();
    session.remember(Stage::Render).unwrap();
    masked(&session);
    let exact = Formula(Exact { world_from_scene: session.scene().unwrap().scene_from_world.inverse() });
    let mesh = complete(&session, Stage::Mesh, &exact).unwrap().summary;
    // the demo's neck runs out of the box
    assert_eq!(mesh["closed"], json!(mesh["report"]["capped"] == 0), "{mesh}");
    assert_eq!(mesh["texture_px"], 0);
    // a viewer shows the colors of its vertices
    complete(&session, Stage::Render, &exact).unwrap();
    let seen = pictures::read(&run.path("render/textured/012.png")).unwrap();
    let colors: Vec<&[f32; 4]> = seen.data.as_chunks::<4>().0.iter().filter(|p| p[3] == 1.0).collect();
    let range = |k: usize| {
        let of = colors.iter().map(|p| p[k]);
        of.clone().fold(0.0, f32::max) - of.fold(1.0, f32::min)
    };
    assert!(colors.len() > 1000 && range(0) > 0.1 && range(0) != range(2), "{} {}", colors.len(), range(0));
    config.mesh.normal_map = true;
    let error = Session::open(&config, &run).err().unwrap();
    assert!(error.to_string().contains("mesh.normal_map") && error.hint().contains("texture_px"), "{error}");
}

/// The demo head with a tunnel from ear to ear, 0.06 wide in a scene of 2.
struct Drilled(Exact);

impl Drilled {
    const RADIUS: f32 = 0.03;

    fn tunnel(p: &Vec3) -> (f32, Vec3) {
        let across = Vec3::new(0.0, p.y - 0.2, p.z);
        (Self::RADIUS - across.length(), -across.normalize_or_zero())
    }
}

impl SdfField for Drilled {
    fn sdf(&self, points: &[Vec3]) -> Vec<f32> {
        let drilled = |(f, p): (f32, &Vec3)| f.max(Self::tunnel(p).0);
        self.0.sdf(points).into_iter().zip(points).map(drilled).collect()
    }

    fn sdf_gradient(&self, points: &[Vec3]) -> (Vec<f32>, Vec<Vec3>) {
        let (values, gradients) = self.0.sdf_gradient(points);
        let drilled = |((f, g), p): ((f32, Vec3), &Vec3)| {
            let (tunnel, slope) = Self::tunnel(p);
            if tunnel > f { (tunnel, slope) } else { (f, g) }
        };
        values.into_iter().zip(gradients).zip(points).map(drilled).unzip()
    }

    fn sharpness(&self, points: &[Vec3]) -> Vec<f32> {
        self.0.sharpness(points)
    }

    fn colors(&self, points: &[Vec3], normals: &[Vec3], counts: &[u32], d: &[Vec3]) -> Vec<[f32; 3]> {
        self.0.colors(points, normals, counts, d)
    }
}

impl Surface for Drilled {}

impl Fields for Drilled {
    fn surface(&self) -> Result<&dyn Surface> {
        Ok(self)
    }

    fn radiance(&self, _: Stage) -> Result<&dyn Radiance> {
        panic!("no radiance field is asked for")
    }
}

#[test]
fn a_handle_of_the_field_is_gone_from_the_head_unless_it_is_to_be_kept() {
    let (dir, mut config, _) = sharp_run();
    let (mut digests, mut counts) = (Vec::new(), Vec::new());
    for genus in [Genus::Simple, Genus::Keep] {
        config.mesh.resolution = 64;
        config.mesh.triangles = 3000;
        config.mesh.texture_px = 0;
        (config.mesh.color, config.mesh.hair) = (ColorSource::Network, Hair::None);
        config.mesh.genus = genus;
        let run = Run::quiet(&dir.path().join(format!("{genus:?}")));
        let session = Session::open(&config, &run).unwrap();
        session.remember(Stage::Mesh).unwrap();
        masked(&session);
        let world_from_scene = session.scene().unwrap().scene_from_world.inverse();
        let mm = world_from_scene.scale * config.capture.unit_m * 1000.0;
        let summary = complete(&session, Stage::Mesh, &Drilled(Exact { world_from_scene })).unwrap().summary;
        digests.push(session.plan(Stage::Mesh).fingerprint.digest());
        let (handles, product) = (&summary["handles"], super::mesh::head_mesh(&run).unwrap().mesh);
        let left = handles["left"].as_u64().unwrap() as usize;
        let lengths = |key: &str| handles[key].as_array().unwrap().len();
        counts.push((lengths("cut_mm") + lengths("filled_mm"), left));
        let topology = tiface_base::geom::topology(&product.positions, &product.triangles);
        assert_eq!(topology.genus, Some(left as i64));
        if genus == Genus::Simple {
            let around = handles["filled_mm"][0].as_f64().unwrap();
            let expected = std::f64::consts::TAU * f64::from(Drilled::RADIUS) * mm;
            assert!((0.7..1.4).contains(&(around / expected)), "{handles}");
        }
    }
    // the tunnel goes through the ears as well
    let [(removed, 0), (0, kept)] = counts[..] else { panic!("{counts:?}") };
    assert!(removed == kept && removed > 0, "{counts:?}");
    assert_ne!(digests[0], digests[1]);
}
