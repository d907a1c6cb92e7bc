//! Handles of known fields, through the whole extraction.

use super::{ExtractOptions, MeshReport, extract};
use crate::files::check;
use crate::{MeshDistance, SimplifyConfig, simplify};
use glam::Vec3;
use tiface_base::Quiet;
use tiface_base::geom::{Aabb, Mesh, SdfField, topology};

/// The surface of a field with 64 cells along the box; loops up to a share of its longest side go.
fn mesh_of(f: impl Fn(Vec3) -> f32 + Sync, longest_handle: f32) -> (Mesh, MeshReport) {
    mesh_at(64, f, longest_handle)
}

fn mesh_at(resolution: usize, f: impl Fn(Vec3) -> f32 + Sync, longest_handle: f32) -> (Mesh, MeshReport) {
    let config = ExtractOptions { resolution, longest_handle, ..ExtractOptions::default() };
    extract(&f, Aabb::SCENE, &config, &Quiet).unwrap()
}

/// Meshes twice, with handles and without; checks that the first has `genus` and the second none,
/// and is as sound.
fn simple(f: impl Fn(Vec3) -> f32 + Sync, longest_handle: f32, genus: i64) -> (Mesh, MeshReport) {
    let (kept, before) = mesh_of(&f, 0.0);
    assert_eq!((before.topology.genus, before.handles.left as i64), (Some(genus), genus));
    assert_eq!(before.handles.cut.len() + before.handles.filled.len() + before.handles.triangles, 0);
    let (mesh, report) = mesh_of(&f, longest_handle);
    assert!(report.topology.is_solid(), "{report:?}");
    assert_eq!((report.topology.genus, report.topology.pieces), (Some(0), 1), "{:?}", report.handles);
    assert_eq!((report.handles.cut.len() + report.handles.filled.len()) as i64, genus);
    assert_eq!((report.handles.left, report.handles.left_length), (0, None));
    let crossing = check(&kept, 1.0).self_intersections;
    assert!(check(&mesh, 1.0).self_intersections <= crossing, "{:?}", report.handles);
    (mesh, report)
}

fn ring(p: Vec3, at: Vec3, major: f32, minor: f32) -> f32 {
    let q = p - at;
    (q.x.hypot(q.y) - major).hypot(q.z) - minor
}

fn ball(p: Vec3) -> f32 {
    p.length() - 0.6
}

fn rod(p: Vec3, along: Vec3, at: Vec3, radius: f32) -> f32 {
    (p - at).reject_from_normalized(along).length() - radius
}

/// A strand 0.1 thick that leaves a ball and comes back to it 0.4 farther on.
fn lock(p: Vec3) -> f32 {
    ball(p).min(ring(p, 0.6 * Vec3::X, 0.2, 0.05))
}

#[test]
fn a_surface_without_handles_is_the_same_with_and_without_the_search() {
    for f in [|p: Vec3| ball(p), |p: Vec3| (p.x.hypot(p.z) - 0.3).max(p.y - 0.5)] {
        let (kept, _) = mesh_of(f, 0.0);
        let (simple, report) = mesh_of(f, 1.0);
        assert_eq!(kept, simple);
        assert_eq!(report.handles, Default::default());
    }
}

#[test]
fn a_loop_of_hair_is_cut_once() {
    let (_, report) = simple(lock, 0.5, 1);
    // 2 π 0.05 = 0.314 around the strand, along edges a little more or less; through the loop it is
    // 0.8
    let [around] = report.handles.cut[..] else { panic!("{:?}", report.handles) };
    assert!((0.25..0.4).contains(&around), "{around}");
    let heard = report.handles.warning(250.0).unwrap().to_string();
    assert!(heard.contains("1 cut (") && heard.contains("0 holes filled,"), "{heard}");
}

#[test]
fn a_tunnel_through_a_head_is_filled_once() {
    let drilled = |p: Vec3| ball(p).max(-rod(p, Vec3::Y, Vec3::new(0.1, 0.0, 0.05), 0.06));
    let (mesh, report) = simple(drilled, 0.5, 1);
    assert!(report.handles.cut.is_empty());
    // 2 π 0.06 = 0.377
    assert!((0.3..0.45).contains(&report.handles.filled[0]), "{:?}", report.handles);
    assert!(mesh.signed_volume() > mesh_of(drilled, 0.0).0.signed_volume());
}

#[test]
fn a_narrow_hole_beside_a_thick_strand_is_filled_although_both_loops_are_short_enough() {
    // 0.08 of air and 0.24 of matter
    let thick = |p: Vec3| ball(p).min(ring(p, 0.72 * Vec3::X, 0.16, 0.12));
    let (_, report) = simple(thick, 0.9, 1);
    assert_eq!((report.handles.cut.len(), report.handles.filled.len()), (0, 1), "{:?}", report.handles);
}

#[test]
fn a_long_slit_is_filled_before_the_rounder_strand_beside_it_is_cut() {
    // a slit 0.06 × 0.4, 0.9 around; the strand beside it is 0.2 × 0.25, 0.9 around as well but
    // with more to cut
    let slit = |p: Vec3| {
        let q = (p - Vec3::new(0.37, 0.0, 0.0)).abs();
        let cut = (q.x - 0.03).max(q.y - 0.2);
        let slab = p.z.abs() - 0.125;
        ball(p).max(slab).max(-cut)
    };
    let (_, report) = simple(slit, 1.0, 1);
    assert_eq!((report.handles.cut.len(), report.handles.filled.len()), (0, 1), "{:?}", report.handles);
}

#[test]
fn a_ring_too_large_for_the_bound_stays_and_is_told() {
    // 2 π 0.2 = 1.257 around the ring, and the bound is 0.15 · 1.4 = 0.21
    let large = |p: Vec3| ring(p, Vec3::ZERO, 0.5, 0.2);
    let (mesh, report) = mesh_of(large, super::MAX_HANDLE);
    assert_eq!(mesh, mesh_of(large, 0.0).0);
    assert_eq!((report.handles.left, report.handles.triangles), (1, 0));
    let length = report.handles.left_length.unwrap();
    assert!((1.2..2.2).contains(&length), "{length}");
    assert_eq!(report.handles.warning(1.0), None);
    simple(large, 1.0, 1);
}

#[test]
fn two_rings_in_one_are_both_cut() {
    let eight = |p: Vec3| {
        ring(p, Vec3::new(-0.4, 0.0, 0.0), 0.4, 0.12).min(ring(p, Vec3::new(0.4, 0.0, 0.0), 0.4, 0.12))
    };
    let (_, report) = simple(eight, 0.6, 2);
    assert_eq!(report.handles.cut.len(), 2);
}

#[test]
fn strands_and_tunnels_close_to_each_other_all_go() {
    // three strands side by side, and two tunnels that cross in the middle: 3 + 3
    let crowded = |p: Vec3| {
        let strands = [-0.15, 0.0, 0.15]
            .map(|z| ring(p, Vec3::new(0.6, 0.0, z), 0.2, 0.05))
            .into_iter()
            .fold(f32::INFINITY, f32::min);
        let tunnels = rod(p, Vec3::Y, Vec3::ZERO, 0.07).min(rod(p, Vec3::Z, Vec3::ZERO, 0.07));
        ball(p).min(strands).max(-tunnels)
    };
    let (_, report) = simple(crowded, 0.5, 6);
    assert_eq!((report.handles.cut.len(), report.handles.filled.len()), (3, 3), "{:?}", report.handles);
}

#[test]
fn a_strand_through_the_loop_of_another_leaves_both_to_be_cut() {
    // a ring through the hole of a lock: no disc through the hole is free
    let linked = |p: Vec3| {
        let q = p - Vec3::new(0.72, 0.0, 0.0);
        let other = (q.x.hypot(q.z) - 0.2).hypot(q.y) - 0.05;
        lock(p).min(other)
    };
    let (_, before) = mesh_of(linked, 0.0);
    let genus = before.topology.genus.unwrap();
    assert!(genus >= 2);
    simple(linked, 0.9, genus);
}

#[test]
fn handles_where_the_surface_is_capped_go_too() {
    // a column that leaves through the floor, pierced just above it, with a lock half way up
    let column = |p: Vec3| {
        let body = p.x.hypot(p.z) - 0.35;
        let pierced = body.max(-rod(p, Vec3::X, Vec3::new(0.0, -0.88, 0.0), 0.06)).max(p.y - 0.5);
        pierced.min(ring(p, Vec3::new(0.35, -0.2, 0.0), 0.2, 0.05))
    };
    let (mesh, report) = simple(column, 0.4, 2);
    assert!(report.capped > 0);
    let cap = super::Cap::find(&mesh, report.bounds(), report.cell_size);
    assert!(cap.is_some());
}

#[test]
fn noise_full_of_handles_comes_out_sound_with_fewer() {
    let field = |p: Vec3| {
        let q = 7.0 * p;
        (q.x + 2.0 * q.y.sin()).sin() + (q.y + 2.0 * q.z.sin()).sin() + (q.z + 2.0 * q.x.sin()).sin()
    };
    let (kept, before) = mesh_at(24, field, 0.0);
    let (mesh, report) = mesh_at(24, field, 0.7);
    assert!(before.topology.genus > Some(20), "{:?}", before.topology);
    assert!(report.topology.is_solid() && report.topology.pieces == 1);
    assert!(report.topology.genus < before.topology.genus, "{:?}", report.topology);
    let removed = report.handles.cut.len() + report.handles.filled.len();
    assert_eq!(Some((removed + report.handles.left) as i64), before.topology.genus);
    assert!(check(&mesh, 1.0).self_intersections <= check(&kept, 1.0).self_intersections);
}

#[test]
fn what_was_cut_stays_where_it_is_when_triangles_are_held_against_the_mesh() {
    let (surface, report) = simple(lock, 0.5, 1);
    let mut mesh = surface.clone();
    let closed = MeshDistance::new(&surface, lock);
    let first = mesh.triangles.len() - report.handles.triangles;
    let middles: Vec<Vec3> =
        (first..mesh.triangles.len()).map(|t| mesh.corners(t as u32).iter().sum::<Vec3>() / 3.0).collect();
    // The field is down to -0.05 at these points.
    assert!(middles.iter().any(|&p| lock(p) < -0.02));
    let (values, slopes) = closed.sdf_gradient(&middles);
    assert!(values.iter().all(|f| f.abs() < 1e-6));
    assert!(slopes.iter().all(|g| (g.length() - 1.0).abs() < 1e-3));
    // elsewhere it is the field, but for the chords of triangles
    let elsewhere = Vec3::new(-0.6, 0.0, 0.05);
    assert!((closed.sdf(&[elsewhere])[0] - lock(elsewhere)).abs() < 0.1 * report.cell_size);

    let config = SimplifyConfig { triangles: mesh.triangles.len() / 4, ..SimplifyConfig::default() };
    let done = simplify(&mut mesh, Some(&closed), &config, &Quiet).unwrap();
    let t = topology(&mesh.positions, &mesh.triangles);
    assert!(t.is_solid() && t.genus == Some(0), "{t:?}");
    assert_eq!(done.self_intersections, 0);
    let lowest = mesh.positions.iter().map(|&p| closed.sdf(&[p])[0].abs()).fold(0.0, f32::max);
    assert!(lowest < 0.5 * report.cell_size, "{lowest}");
}
