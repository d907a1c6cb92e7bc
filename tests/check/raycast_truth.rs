//! The ray caster against depth and normals that other software rendered from the same scans.

use crate::clicked::folder;
use exr::prelude::*;
use glam::{DMat3, DVec3};
use std::path::Path;
use tiface::capture::path::from_json;
use tiface::geom::{Bvh, Camera, Distortion};
use tiface::mesh::files::read;
use tiface::render::{RaycastOptions, raycast};

/// Channels of a flat EXR by name, each row-major from the top.
fn channels(path: &Path, names: &[&str]) -> Vec<Vec<f32>> {
    let image = exr::image::read::read()
        .no_deep_data()
        .largest_resolution_level()
        .all_channels()
        .first_valid_layer()
        .all_attributes()
        .from_file(path)
        .unwrap();
    let list = image.layer_data.channel_data.list;
    let find = |name: &&str| list.iter().find(|c| c.name == **name).unwrap();
    names.iter().map(|n| find(n).sample_data.values_as_f32().collect()).collect()
}

#[test]
fn depth_and_normals_of_the_scans_are_those_of_the_captures() {
    for capture in ["lps", "nefertiti"] {
        let Some(folder) = folder(capture) else { continue };
        let ply = std::fs::read(folder.join("gt.ply")).unwrap();
        let json = std::fs::read_to_string(folder.join("transforms_test.json")).unwrap();
        let mesh = read(&ply, Path::new("gt.ply")).unwrap();
        let bvh = Bvh::new(&mesh);
        // every frame states its own lens; this one only fills gaps
        let like = Camera {
            width: 1,
            height: 1,
            fx: 1.0,
            fy: 1.0,
            cx: 0.5,
            cy: 0.5,
            distortion: Distortion::default(),
            rotation: DMat3::IDENTITY,
            position: DVec3::ZERO,
        };
        for view in from_json(&json, &like).unwrap().iter().take(3) {
            let hard = RaycastOptions { samples: 1, ..RaycastOptions::default() };
            let ours =
                raycast(&bvh, &mesh, None, &view.camera, &hard, |hits| vec![[1.0; 3]; hits.points.len()]);
            let depth = channels(&folder.join("depth").join(format!("{}.exr", view.name)), &["Z"]);
            let normal =
                channels(&folder.join("normals").join(format!("{}.exr", view.name)), &["R", "G", "B"]);
            let (mut both, mut one, mut far, mut turned) = (0, 0, 0, 0);
            for i in 0..depth[0].len() {
                let (a, b) = (ours.depth.data[i], depth[0][i]);
                if (a > 0.0) != (b > 0.0) {
                    one += 1;
                } else if a > 0.0 {
                    both += 1;
                    far += ((a - b).abs() > 1e-4) as usize;
                    let n = &ours.normal.data[3 * i..3 * i + 3];
                    let dot: f32 = (0..3).map(|k| n[k] * normal[k][i]).sum();
                    turned += (dot < 0.999) as usize;
                }
            }
            eprintln!(
                "{capture} {}: {both} pixels, {one} in one only, {far} off by 0.1 mm, {turned} normals by 2.6°",
                view.name
            );
            assert!(both > 30_000, "the head fills the picture");
            // silhouette pixels may fall either way where rays graze
            assert!([one, far, turned].iter().all(|n| n * 10_000 < both));
        }
    }
}
