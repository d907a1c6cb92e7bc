use super::*;
use crate::bake::testing::{ball, shown};
use crate::files::{LOBE_TEXEL, check, uv_check};
use crate::fixtures;
use tiface_base::geom::{Bvh, Similarity};
use tiface_base::image::Photo;

fn plane(height: f32) -> Plane {
    Plane { point: height * Vec3::Z, normal: 2.0 * Vec3::Z }
}

/// Returns what [`cut`] makes of a ball, and asserts that it is sound.
fn cut_ball(plane: &Plane) -> (HeadMesh, CutReport) {
    let (out, report) = cut(&ball(), plane, 4).unwrap();
    let found = check(&out.mesh, 1.0);
    assert!(found.require(&["watertight", "one-piece", "no-self-intersections"]).is_ok(), "{found}");
    assert_eq!(found.degenerate, 0);
    let vertices = out.mesh.positions.len();
    let layer = &out.shells.as_ref().unwrap().layers[0];
    for count in [out.mesh.normals.len(), out.mesh.colors.len(), layer.alphas.len(), layer.offsets.len()] {
        assert_eq!(count, vertices);
    }
    // what is opaque under the layers is closed by the same face
    let core = out.clone().as_drawn().mesh;
    let found = check(&core, 1.0);
    assert!(found.require(&["watertight", "no-self-intersections"]).is_ok(), "{found}");
    let depths = &out.shells.as_ref().unwrap().depths;
    assert!(depths.contains(&0.0) && depths.iter().any(|depth| *depth > 0.1));
    let uv = uv_check(&out.mesh, &out.texture.as_ref().unwrap().atlas);
    assert!(uv.is_sound() && uv.overlapping == 0 && uv.outside == 0, "{uv:?}");
    assert!(uv.chart_distance_px.unwrap() >= 4.0, "{uv:?}");
    (out, report)
}

#[test]
fn a_cut_ball_is_a_cap_of_the_ball_with_a_flat_face_of_the_color_of_its_rim() {
    let (out, report) = cut_ball(&plane(6.3));
    assert_eq!((report.dropped, report.loops), (0, 1));
    assert!(report.moved.abs() < 0.05 && report.face_triangles > 50, "{report:?}");
    // a cap of height h of a ball: π h² (3 r − h) / 3
    let h = 12.0 - 6.3 - report.moved;
    let volume = std::f64::consts::PI * h * h * (36.0 - h) / 3.0;
    assert!((out.mesh.signed_volume() / volume - 1.0).abs() < 0.02, "{}", out.mesh.signed_volume());
    let bottom = 6.3 + report.moved as f32;
    assert!((out.mesh.bounds().min.z - bottom).abs() < 1e-5);
    // within the face the vertices' normals point down, and every color lies between those of the
    // rim
    let shown_at = |p: Vec3| Vec3::from(shown(p));
    let texture = out.texture.as_ref().unwrap();
    let mut inner = 0;
    for (t, triangle) in out.mesh.triangles.iter().enumerate() {
        let corners = out.mesh.corners(t as u32);
        let flat = corners.iter().all(|p| (p.z - bottom).abs() < 1e-5);
        let center = (corners[0] + corners[1] + corners[2]) / 3.0;
        let [a, b, c] = texture.atlas.triangles[t].map(|k| texture.atlas.uvs[k as usize]);
        let byte = |byte: u8| f32::from(byte) / 255.0;
        let color = crate::bake::bilinear(&texture.color, (a + b + c) / 3.0, &byte);
        if flat {
            assert!((color.z - shown_at(center).z).abs() < 0.02, "{center}: {color}");
            // the middle is gray, between red to the one side and less to the other
            let off = (color - shown_at(center)).abs().max_element();
            assert!(off < 0.35, "{center}: {color} {off}");
            for &v in triangle {
                let radius = out.mesh.positions[v as usize].truncate().length();
                if radius < 0.97 * (144.0 - bottom * bottom).sqrt() {
                    inner += 1;
                    assert_eq!(out.mesh.normals[v as usize], -Vec3::Z);
                }
            }
        }
    }
    assert!(inner > 20, "{inner}");
    // no layer is over the face, and above it the layer is as before
    let layer = &out.shells.as_ref().unwrap().layers[0];
    for triangle in &out.mesh.triangles {
        let is_flat = triangle.iter().all(|&v| (out.mesh.positions[v as usize].z - bottom).abs() < 1e-5);
        assert!(!(is_flat && layer.has(triangle)));
    }
}

#[test]
fn a_face_has_neither_lobes_nor_bumps_and_the_skin_keeps_its_own() {
    const GUTTER: u32 = 8;
    let mut head = ball();
    let texture = head.texture.as_mut().unwrap();
    // lobes in their usual size, a texel for 4 × 4 of the color, and bumps that lean everywhere
    texture.lobes = texture.lobes.take().map(|lobes| lobes.reduced(512 / LOBE_TEXEL));
    texture.normal = Some(Photo { rgb: vec![[200, 90, 220]; 512 * 512], ..texture.color.clone() });
    let (out, report) = cut(&head, &plane(6.3), GUTTER).unwrap();
    let bottom = 6.3 + report.moved as f32;
    let texture = out.texture.as_ref().unwrap();
    let (normal, lobe) = (texture.normal.as_ref().unwrap(), &texture.lobes.as_ref().unwrap().pictures[0]);
    let at = |picture: &Photo, uv: Vec2| crate::bake::bilinear(picture, uv, &f32::from);
    let is = |found: Vec3, expected: [f32; 3]| (found - Vec3::from(expected)).abs().max_element() < 0.01;
    let (mut face, mut skin) = (0, 0);
    for (t, corners) in texture.atlas.triangles.iter().enumerate() {
        let is_face = out.mesh.corners(t as u32).iter().all(|p| (p.z - bottom).abs() < 1e-5);
        let uvs = corners.map(|k| texture.atlas.uvs[k as usize]);
        let center = uvs.iter().sum::<Vec2>() / 3.0;
        if is_face {
            // up to its rim, where a look-up takes texels around it
            for uv in uvs.into_iter().chain([center]) {
                assert!(is(at(normal, uv), [128.0, 128.0, 255.0]), "{uv} {}", at(normal, uv));
                assert!(is(at(lobe, uv), [128.0; 3]), "{uv} {}", at(lobe, uv));
            }
            face += 1;
        } else {
            assert!(is(at(normal, center), [200.0, 90.0, 220.0]), "{center}");
            let before = &head.texture.as_ref().unwrap().lobes.as_ref().unwrap().pictures[0];
            assert_eq!(at(lobe, center), at(before, center));
            skin += 1;
        }
    }
    assert!(face == report.face_triangles && skin > 500, "{face} {skin}");
}

#[test]
fn what_is_above_shows_what_it_showed() {
    let (before, (after, report)) = (ball(), cut_ball(&plane(-3.2)));
    let bvh = Bvh::new(&before.mesh);
    let at = |head: &HeadMesh, t: u32| {
        let texture = head.texture.as_ref().unwrap();
        let [a, b, c] = texture.atlas.triangles[t as usize].map(|k| texture.atlas.uvs[k as usize]);
        let byte = |byte: u8| f32::from(byte) / 255.0;
        crate::bake::bilinear(&texture.color, (a + b + c) / 3.0, &byte)
    };
    let bottom = -3.2 + report.moved as f32;
    for t in 0..after.mesh.triangles.len() as u32 {
        let corners = after.mesh.corners(t);
        if corners.iter().all(|p| (p.z - bottom).abs() < 1e-5) {
            continue;
        }
        let center = (corners[0] + corners[1] + corners[2]) / 3.0;
        assert!(bvh.closest_point(center).unwrap().distance < 1e-5);
        assert!((at(&after, t) - Vec3::from(shown(center))).abs().max_element() < 0.03, "{center}");
    }
}

#[test]
fn a_plane_through_vertices_moves_between_them() {
    // the ball's vertices lie on a grid of unit cells: dozens are at 0.5 exactly
    let head = ball();
    let on = head.mesh.positions.iter().filter(|p| p.z == 0.5).count();
    assert!(on > 20, "{on}");
    let (_, report) = cut_ball(&plane(0.5));
    assert!(report.moved != 0.0 && report.moved.abs() < 0.042, "{report:?}");
    // between heights of -0.3, 0.1 and 0.2 the widest gap is from -0.3 to 0.1; without any there is
    // none to avoid
    assert!((clearance(&[-0.3, 0.1, 0.2, 5.0], 0.4) + 0.1).abs() < 1e-12);
    assert_eq!(clearance(&[2.0], 1.0), 0.0);
}

/// Returns a mesh as a head that shows nothing.
fn bare(mesh: Mesh) -> HeadMesh {
    HeadMesh { mesh, world_from_scene: Similarity::IDENTITY, texture: None, harmonics: None, shells: None }
}

/// Returns two meshes as one.
fn both(mut a: Mesh, b: &Mesh, shift: Vec3, inside_out: bool) -> Mesh {
    let first = a.positions.len() as u32;
    a.positions.extend(b.positions.iter().map(|p| *p + shift));
    a.normals.extend(&b.normals);
    a.triangles.extend(b.triangles.iter().map(|t| {
        let [a, b, c] = t.map(|v| v + first);
        if inside_out { [a, c, b] } else { [a, b, c] }
    }));
    a
}

#[test]
fn of_several_pieces_the_largest_is_left() {
    let small = fixtures::ball(0.3);
    let mesh = both(fixtures::ball(0.6), &small, 2.0 * Vec3::X, false);
    let (out, report) = cut(&bare(mesh), &plane(0.1), 4).unwrap();
    assert_eq!((report.dropped, report.loops), (1, 1));
    assert!(out.mesh.is_closed() && out.mesh.bounds().max.x < 0.7);
}

#[test]
fn a_face_has_a_hole_where_the_mesh_is_hollow() {
    // a torus around y, cut above its hole into an arch with two faces, and lying into a ring
    let torus = |p: Vec3| (p.x.hypot(p.z) - 0.6).hypot(p.y) - 0.2;
    let options = crate::ExtractOptions { resolution: 48, ..crate::ExtractOptions::default() };
    let mesh =
        crate::extract(&torus, tiface_base::geom::Aabb::SCENE, &options, &tiface_base::Quiet).unwrap().0;
    for (normal, area) in [
        // two discs of radius 0.2
        (Vec3::Z, 2.0 * 0.04),
        // a ring from 0.4 to 0.8
        (Vec3::Y, 0.64 - 0.16),
    ] {
        let (out, report) = cut(&bare(mesh.clone()), &Plane { point: Vec3::ZERO, normal }, 4).unwrap();
        assert_eq!(report.loops, 2);
        let found = check(&out.mesh, 1.0);
        assert!(found.require(&["watertight", "one-piece", "no-self-intersections"]).is_ok(), "{found}");
        let low = out.mesh.positions.iter().map(|p| p.dot(normal)).fold(f32::MAX, f32::min);
        let is_flat = |t: &u32| out.mesh.corners(*t).iter().all(|p| p.dot(normal) < low + 1e-5);
        let triangles = (0..out.mesh.triangles.len() as u32).filter(is_flat);
        let found: f64 = triangles.map(|t| out.mesh.area(t)).sum();
        let expected = std::f64::consts::PI * area;
        assert!((found / expected - 1.0).abs() < 0.03, "{found} {expected}");
    }
}

#[test]
fn a_plane_beside_the_mesh_and_an_open_mesh_are_refused_by_name() {
    let head = ball();
    for (height, side) in [(13.0, "below"), (-13.0, "above")] {
        let e = cut(&head, &plane(height), 4).unwrap_err();
        assert!(e.to_string().contains(&format!("lies {side} it")), "{e}");
    }
    let none = Plane { point: Vec3::ZERO, normal: Vec3::ZERO };
    assert!(cut(&head, &none, 4).unwrap_err().to_string().contains("no plane"));
    let mut open = bare(head.mesh.clone());
    open.mesh.triangles.pop();
    assert!(cut(&open, &plane(0.0), 4).unwrap_err().to_string().contains("not watertight"));
}
