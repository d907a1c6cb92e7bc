//! Busts with a face, smooth hair and curls: charts, texels and seams where they are promised.

use super::*;
use crate::{ExtractOptions, extract};
use std::sync::OnceLock;
use tiface_base::Quiet;
use tiface_base::geom::Aabb;

fn ellipsoid(p: Vec3, center: [f32; 3], radii: [f32; 3]) -> f32 {
    let (q, r) = (p - Vec3::from(center), Vec3::from(radii));
    let k = (q / r).length();
    if k > 0.0 { k * (k - 1.0) / (q / (r * r)).length() } else { -r.min_element() }
}

/// A bust that looks along +z, +y up: nose, ears, shoulders that the box cuts, and a fringe and
/// curls in the hair, as high as `curls`.
fn bust(p: Vec3, curls: f32) -> f32 {
    let mirrored = Vec3::new(p.x.abs(), p.y, p.z);
    let skull = ellipsoid(p, [0.0, 0.38, -0.04], [0.32, 0.42, 0.40]);
    let jaw = ellipsoid(p, [0.0, 0.12, 0.10], [0.23, 0.28, 0.25]);
    let along = ((0.1 - p.y) / 0.6).clamp(0.0, 1.0);
    let neck = p.distance(Vec3::new(0.0, 0.1 - 0.6 * along, -0.06)) - 0.16;
    let trunk = ellipsoid(p, [0.0, -0.85, -0.06], [0.85, 0.38, 0.34]);
    let nose = ellipsoid(p, [0.0, 0.24, 0.36], [0.05, 0.09, 0.09]);
    let ear = ellipsoid(mirrored, [0.33, 0.26, -0.04], [0.04, 0.10, 0.06]);
    let hair = ((0.15 - p.z + 0.8 * (p.y - 0.4)).clamp(0.0, 0.3) / 0.3) * ((p.y + 0.1) / 0.2).clamp(0.0, 1.0);
    let curl = (31.0 * p.x + 3.0 * p.y).sin() * (29.0 * p.y - 4.0 * p.z).sin() * (33.0 * p.z + 1.0).sin();
    skull.min(jaw).min(neck).min(trunk).min(nose).min(ear) - curls * hair * curl
}

/// Returns the bust as a mesh and its atlas of 1024 texels.
fn laid(curls: f32) -> (Mesh, Atlas, AtlasReport) {
    let field = move |p: Vec3| bust(p, curls);
    let options = ExtractOptions { resolution: 56, ..ExtractOptions::default() };
    let mesh = extract(&field, Aabb::SCENE, &options, &Quiet).unwrap().0;
    let (atlas, report) = atlas(&mesh, &config(), &Quiet).unwrap();
    (mesh, atlas, report)
}

fn config() -> AtlasConfig {
    AtlasConfig { size_px: 1024, gutter_px: 4, front: Some(Vec3::Z), up: Some(Vec3::Y), resolved: None }
}

/// Smooth, and with curls as high as a tenth of the head.
fn busts() -> &'static [(Mesh, Atlas, AtlasReport); 2] {
    static BUSTS: OnceLock<[(Mesh, Atlas, AtlasReport); 2]> = OnceLock::new();
    BUSTS.get_or_init(|| [0.0, 0.04].map(laid))
}

/// Returns the triangle that a ray from the front meets first at (x, y), roughly.
fn seen_at(mesh: &Mesh, x: f32, y: f32) -> usize {
    let near = |t: &usize| {
        let p = mesh.corners(*t as u32).iter().sum::<Vec3>() / 3.0;
        // two triangles' size sideways count as much as lying behind
        (p.truncate().distance(Vec2::new(x, y)) / 0.04).floor() * 10.0 - p.z
    };
    (0..mesh.triangles.len()).min_by(|a, b| near(a).total_cmp(&near(b))).unwrap()
}

/// Returns a number of each triangle's chart.
fn charts(atlas: &Atlas) -> Vec<u32> {
    let mut pieces = tiface_base::geom::Sets::of_pieces(atlas.uvs.len(), &atlas.triangles);
    atlas.triangles.iter().map(|t| pieces.find(t[0])).collect()
}

fn of(report: &AtlasReport, part: &str) -> PartReport {
    report.parts.iter().find(|p| p.part == part).cloned().unwrap_or_default()
}

/// Eyes, tip of the nose and mouth of the bust.
const FACE: [[f32; 2]; 4] = [[-0.13, 0.36], [0.13, 0.36], [0.0, 0.24], [0.0, 0.05]];

#[test]
fn a_head_has_at_most_twelve_charts_whatever_its_hair() {
    for (mesh, atlas, report) in busts() {
        assert!(report.fallback.is_none() && report.repaired == 0, "{report:?}");
        assert!((5..=head::MAX_CHARTS).contains(&report.uv.charts), "{}", report.uv);
        assert!(report.uv.is_sound() && report.uv.mirrored_charts == 0, "{}", report.uv);
        assert!(report.uv.chart_distance_px.unwrap() > 8.0 - 1e-3, "{}", report.uv);
        assert_eq!(atlas.triangles.len(), mesh.triangles.len());
    }
}

#[test]
fn eyes_nose_and_mouth_share_a_chart_that_stands_upright() {
    for (mesh, atlas, _) in busts() {
        let chart = charts(atlas);
        let [left, right, nose, mouth] = FACE.map(|[x, y]| seen_at(mesh, x, y));
        assert!([left, right, nose, mouth].iter().all(|&t| chart[t] == chart[nose]));
        let at = |t: usize| atlas.triangles[t].map(|i| atlas.uvs[i as usize]).iter().sum::<Vec2>() / 3.0;
        // v runs down
        let up = 0.5 * (at(left) + at(right)) - at(mouth);
        assert!(up.y < 0.0 && up.x.abs() < 5f32.to_radians().tan() * -up.y, "{up}");
        // as seen from the front, +x is on the right
        assert!(at(right).x > at(left).x);
    }
}

#[test]
fn seams_run_behind_the_ears_and_along_the_collar() {
    for (mesh, atlas, _) in busts() {
        let chart = charts(atlas);
        let face = chart[seen_at(mesh, 0.0, 0.24)];
        let is_face = |p: Vec3| {
            let distance = |t: &usize| (mesh.corners(*t as u32).iter().sum::<Vec3>() / 3.0).distance(p);
            let all = 0..mesh.triangles.len();
            chart[all.min_by(|a, b| distance(a).total_cmp(&distance(b))).unwrap()] == face
        };
        let cheek = [Vec3::new(0.26, 0.2, 0.2), Vec3::new(-0.26, 0.2, 0.2)];
        let behind = [Vec3::new(0.25, 0.26, -0.3), Vec3::new(-0.25, 0.26, -0.3), Vec3::new(0.0, -0.1, -0.23)];
        let trunk = [Vec3::new(0.0, -0.7, 0.3), Vec3::new(0.5, -0.6, 0.0), Vec3::new(0.0, 0.6, -0.4)];
        assert!(cheek.iter().all(|&p| is_face(p)));
        assert!(behind.iter().chain(&trunk).all(|&p| !is_face(p)));
    }
}

#[test]
fn the_face_has_a_third_of_the_texels_and_the_cap_next_to_none() {
    for (_, _, report) in busts() {
        let [face, chest, cap] = ["face", "chest", "cap"].map(|part| of(report, part));
        assert!(face.texels >= 0.35 && face.texels > 1.3 * face.surface, "{face:?}");
        assert!(cap.surface > 0.05 && cap.texels <= 0.02, "{cap:?}");
        assert!(face.density >= 2.0 * chest.density && chest.density > 0.0, "{face:?} {chest:?}");
        assert!((report.parts.iter().map(|p| p.texels).sum::<f64>() - 1.0).abs() < 1e-9);
    }
}

#[test]
fn no_chart_is_finer_than_the_photographs_and_a_larger_texture_is_said_to_be_of_no_use() {
    let (mesh, _, free) = &busts()[0];
    let texel = 2.0 / of(free, "face").density;
    let resolved = Some(vec![texel as f32; mesh.triangles.len()]);
    let (atlas, report) = atlas(mesh, &AtlasConfig { resolved, ..config() }, &Quiet).unwrap();
    assert!(report.parts.iter().all(|p| p.density <= 1.001 / texel), "{:?}", report.parts);
    // twice as many texels as there is something to show on them, so half the size does
    assert!((448..=640).contains(&report.sufficient_px.unwrap()), "{report:?}");
    assert!(matches!(report.warnings()[..], [Warning::FinerThanPhotographs { .. }, ..]));
    assert!(report.uv.is_sound() && atlas.width == 1024);
    assert!(free.sufficient_px.is_none() && free.warnings().is_empty());
    // photographs that resolve more change nothing
    let resolved = Some(vec![0.2 * texel as f32; mesh.triangles.len()]);
    let (_, fine) = super::atlas(mesh, &AtlasConfig { resolved, ..config() }, &Quiet).unwrap();
    assert!(fine.warnings().is_empty() && of(&fine, "face").density > 0.95 * of(free, "face").density);
}

#[test]
fn the_same_head_turned_and_leaning_is_divided_alike() {
    let (mesh, _, straight) = &busts()[0];
    let turn = glam::Quat::from_euler(glam::EulerRot::XYZ, 1.2, -0.7, 0.4);
    let mut turned = mesh.clone();
    turned.positions.iter_mut().for_each(|p| *p = turn * *p * 3.0);
    let config = AtlasConfig { front: Some(turn * Vec3::Z), up: Some(turn * Vec3::Y), ..config() };
    let (_, report) = atlas(&turned, &config, &Quiet).unwrap();
    assert_eq!(report.uv.charts, straight.uv.charts);
    for (a, b) in report.parts.iter().zip(&straight.parts) {
        assert!(a.part == b.part && (a.surface - b.surface).abs() < 0.01, "{a:?} {b:?}");
    }
}

#[test]
fn cameras_that_stand_to_one_side_do_not_turn_the_face() {
    let (mesh, _, straight) = &busts()[0];
    let aside = glam::Quat::from_rotation_y(0.6) * Vec3::Z;
    let (atlas, report) = atlas(mesh, &AtlasConfig { front: Some(aside), ..config() }, &Quiet).unwrap();
    assert!((of(&report, "face").surface - of(straight, "face").surface).abs() < 0.02);
    let chart = charts(&atlas);
    let cheeks = [-0.25, 0.25].map(|x| chart[seen_at(mesh, x, 0.25)]);
    assert_eq!(cheeks[0], cheeks[1]);
}
