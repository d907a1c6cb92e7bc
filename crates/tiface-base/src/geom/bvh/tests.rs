use super::*;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

/// A closed ball with wrinkles: a cube's six grids, blown up. Shared vertices are equal bits.
fn head(n: usize) -> Mesh {
    let mut mesh = Mesh::default();
    let mut index = std::collections::HashMap::new();
    let axes = [[0, 1, 2], [1, 2, 0], [2, 0, 1]];
    for (side, [x, y, z]) in
        [(1i32, axes[0]), (1, axes[1]), (1, axes[2]), (-1, axes[0]), (-1, axes[1]), (-1, axes[2])]
    {
        let mut at = |i: usize, j: usize| {
            let mut key = [0i32; 3];
            key[x] = 2 * i as i32 - n as i32;
            key[y] = 2 * j as i32 - n as i32;
            key[z] = side * n as i32;
            *index.entry(key).or_insert_with(|| {
                let d = Vec3::from_array(key.map(|k| k as f32)).normalize();
                let r = 0.7 + 0.02 * (9.0 * d.x).sin() * (7.0 * d.y).cos() + 0.01 * (31.0 * d.z).sin();
                mesh.positions.push(r * d);
                mesh.positions.len() as u32 - 1
            })
        };
        let mut faces = Vec::new();
        for i in 0..n {
            for j in 0..n {
                let [a, b, c, d] = [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)];
                faces.extend([[a, b, c], [a, c, d]]);
            }
        }
        for f in faces {
            mesh.triangles.push(if side > 0 { f } else { [f[0], f[2], f[1]] });
        }
    }
    mesh
}

fn ray(origin: Vec3, direction: Vec3) -> Ray {
    Ray::new(origin, direction)
}

/// Numbers in 0..1, the same every time.
fn noise(seed: u32) -> f32 {
    let h = seed.wrapping_mul(0x9e37_79b9) ^ 0x85eb_ca6b;
    let h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    (h ^ (h >> 12)) as f32 / u32::MAX as f32
}

#[test]
fn no_ray_aimed_from_inside_at_vertices_or_edges_leaks_out() {
    let mesh = head(48); // 27 648 triangles
    assert!(mesh.is_closed() && mesh.signed_volume() > 0.0);
    let bvh = Bvh::new(&mesh);
    let leaks: usize = (0..400_000u32)
        .into_par_iter()
        .filter(|&i| {
            let t = (noise(i) * mesh.triangles.len() as f32) as usize % mesh.triangles.len();
            let [a, b, c] = mesh.corners(t as u32);
            let target = match i % 4 {
                0 => a,
                1 => 0.5 * (b + c),
                2 => a + (c - a) * noise(i ^ 0x55aa),
                _ => b,
            };
            // within ±0.35, whose corners are 0.61 from the middle: inside, since r > 0.66
            let origin = 0.7 * (Vec3::new(noise(3 * i + 1), noise(3 * i + 2), noise(3 * i + 3)) - 0.5);
            let direction = if i % 8 == 3 {
                // along an axis through a vertex: from a point inside on that line
                let axis = [Vec3::X, Vec3::Y, Vec3::Z][i as usize / 8 % 3];
                let origin = target - axis * target.dot(axis);
                if origin.length() > 0.6 {
                    return false; // that line has no point well inside
                }
                return bvh.closest_hit(&ray(origin, axis)).is_none() || !bvh.any_hit(&ray(origin, -axis));
            } else {
                (target - origin).normalize()
            };
            bvh.closest_hit(&ray(origin, direction)).is_none()
        })
        .count();
    assert_eq!(leaks, 0, "of 400000");
}

fn brute(mesh: &Mesh, r: &Ray) -> Option<Hit> {
    // Möller–Trumbore in f64, as a different test
    let mut best: Option<Hit> = None;
    for t in 0..mesh.triangles.len() as u32 {
        let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
        let (e1, e2, d) = (b - a, c - a, r.direction.as_dvec3());
        let det = e1.dot(d.cross(e2));
        let s = r.origin.as_dvec3() - a;
        let u = s.dot(d.cross(e2)) / det;
        let v = d.dot(s.cross(e1)) / det;
        let w = e2.dot(s.cross(e1)) / det;
        if u >= 0.0 && v >= 0.0 && u + v <= 1.0 && w >= 0.0 && best.is_none_or(|h| (w as f32) < h.t) {
            best = Some(Hit { t: w as f32, triangle: t, u: u as f32, v: v as f32 });
        }
    }
    best
}

proptest! {
    #![proptest_config(ProptestConfig { rng_seed: RngSeed::Fixed(1), ..ProptestConfig::with_cases(400) })]
    #[test]
    fn the_tree_finds_what_trying_every_triangle_finds(
        corners in prop::collection::vec(prop::array::uniform3(-1f32..1.0), 3..90),
        origin in prop::array::uniform3(-2f32..2.0),
        toward in prop::array::uniform3(-1f32..1.0),
    ) {
        let positions: Vec<Vec3> = corners.into_iter().map(Vec3::from).collect();
        let triangles = (0..positions.len() as u32 / 3).map(|t| [3 * t, 3 * t + 1, 3 * t + 2]).collect();
        let mesh = Mesh { positions, triangles, ..Mesh::default() };
        let bvh = Bvh::new(&mesh);
        let (o, to) = (Vec3::from(origin), Vec3::from(toward));
        prop_assume!(o.distance(to) > 1e-3);
        let r = ray(o, (to - o).normalize());
        let (ours, theirs) = (bvh.closest_hit(&r), brute(&mesh, &r));
        prop_assert_eq!(ours.is_some(), bvh.any_hit(&r));
        match (ours, theirs) {
            (Some(a), Some(b)) => {
                prop_assert!((a.t - b.t).abs() < 1e-4 * (1.0 + b.t), "{:?} {:?}", a, b);
                let [p, q, s] = mesh.corners(a.triangle);
                let at = (1.0 - a.u - a.v) * p + a.u * q + a.v * s;
                prop_assert!(at.distance(r.at(a.t)) < 1e-4);
            }
            (None, None) => {}
            // only at a border may two tests of different rounding disagree
            (Some(h), None) | (None, Some(h)) => {
                prop_assert!(h.u.min(h.v).min(1.0 - h.u - h.v) < 1e-5, "{:?}", h);
            }
        }
        let all = bvh.all_hits(&r);
        prop_assert_eq!(all.first().copied(), ours);
        prop_assert!(all.is_sorted_by(|a, b| (a.t, a.triangle) < (b.t, b.triangle)), "{:?}", all);
        for (t, &corners) in mesh.triangles.iter().enumerate() {
            let alone = Bvh::new(&Mesh { triangles: vec![corners], ..mesh.clone() }).closest_hit(&r);
            match (alone, all.iter().find(|hit| hit.triangle == t as u32)) {
                (Some(a), Some(b)) => prop_assert!((a.t - b.t).abs() < 1e-4 * (1.0 + b.t), "{:?} {:?}", a, b),
                (None, None) => {}
                (Some(h), None) | (None, Some(&h)) => {
                    prop_assert!(h.u.min(h.v).min(1.0 - h.u - h.v) < 1e-5, "{:?}", h);
                }
            }
        }
        if let [first, .., last] = all[..] {
            let within = bvh.all_hits(&Ray { t_min: first.t, t_max: last.t, ..r });
            prop_assert_eq!(&within, &all);
            let middle = 0.5 * (first.t + last.t);
            let before = bvh.all_hits(&Ray { t_max: middle, ..r });
            prop_assert_eq!(&before[..], &all[..all.partition_point(|hit| hit.t <= middle)]);
        }
        // a ray that is moved to the mesh first
        let far = ray(r.at(-100.0), r.direction);
        prop_assert_eq!(bvh.all_hits(&far).first().copied(), bvh.closest_hit(&far));
        prop_assert!(bvh.all_hits(&far).is_sorted_by(|a, b| a.t <= b.t));
        let near = bvh.closest_point(o).unwrap();
        let least = (0..mesh.triangles.len() as u32)
            .map(|t| {
                let [a, b, c] = mesh.corners(t).map(|p| p.as_dvec3());
                closest_on_triangle(o.as_dvec3(), a, b, c).distance(o.as_dvec3())
            })
            .fold(f64::INFINITY, f64::min);
        prop_assert!((near.distance as f64 - least).abs() < 1e-6);
        prop_assert!((near.point.distance(o) - near.distance).abs() < 1e-6);
    }

    #[test]
    fn no_point_of_a_triangle_is_nearer_than_the_closest(
        c in prop::array::uniform9(-1f64..1.0), p in prop::array::uniform3(-2f64..2.0),
        s in 0f64..1.0, t in 0f64..1.0,
    ) {
        let [a, b, d] = [0, 3, 6].map(|k| DVec3::new(c[k], c[k + 1], c[k + 2]));
        let p = DVec3::from(p);
        let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
        let other = a + s * (b - a) + t * (d - a);
        prop_assert!(closest_on_triangle(p, a, b, d).distance(p) <= other.distance(p) + 1e-12);
    }
}

fn square() -> Mesh {
    // [0, 1]² in the plane z = 0, split along its diagonal x = y
    Mesh {
        positions: vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        ..Mesh::default()
    }
}

#[test]
fn a_hit_carries_parameter_triangle_and_weights() {
    let bvh = Bvh::new(&square());
    // (0.75, 0.25) = 0.25·a + 0.5·b + 0.25·c of triangle (0,0) (1,0) (1,1)
    let hit = bvh.closest_hit(&ray(Vec3::new(0.75, 0.25, 2.0), -Vec3::Z)).unwrap();
    assert_eq!(hit, Hit { t: 2.0, triangle: 0, u: 0.5, v: 0.25 });
    // the other side counts too, and a direction of length 2 halves t
    let hit = bvh.closest_hit(&ray(Vec3::new(0.75, 0.25, -2.0), 2.0 * Vec3::Z)).unwrap();
    assert_eq!((hit.t, hit.triangle), (1.0, 0));
}

#[test]
fn of_two_triangles_on_a_shared_edge_the_first_is_named() {
    let hit = Bvh::new(&square()).closest_hit(&ray(Vec3::new(0.5, 0.5, 1.0), -Vec3::Z)).unwrap();
    assert_eq!((hit.t, hit.triangle), (1.0, 0));
    let mut turned = square();
    turned.triangles.reverse();
    let hit = Bvh::new(&turned).closest_hit(&ray(Vec3::new(0.5, 0.5, 1.0), -Vec3::Z)).unwrap();
    assert_eq!(hit.triangle, 0);
}

#[test]
fn the_range_of_a_ray_is_kept() {
    let bvh = Bvh::new(&square());
    let at = |t_min, t_max| bvh.closest_hit(&Ray { t_min, t_max, ..ray(Vec3::new(0.7, 0.2, 1.0), -Vec3::Z) });
    assert!(at(0.0, 0.99).is_none() && at(1.01, 5.0).is_none());
    assert!(at(0.5, 1.0).is_some() && at(1.0, 2.0).is_some());
}

#[test]
fn a_ray_that_starts_on_the_surface_meets_it_at_zero_or_skips_it() {
    let bvh = Bvh::new(&square());
    let r = ray(Vec3::new(0.6, 0.3, 0.0), Vec3::Z);
    assert_eq!(bvh.closest_hit(&r).unwrap().t, 0.0);
    assert!(bvh.closest_hit(&Ray { t_min: 1e-6, ..r }).is_none());
}

#[test]
fn a_ray_within_the_plane_of_a_triangle_meets_nothing_and_a_grazing_one_does() {
    let bvh = Bvh::new(&square());
    assert!(bvh.closest_hit(&ray(Vec3::new(-1.0, 0.3, 0.0), Vec3::X)).is_none());
    // falls 1e-4 over 1.5: reaches z = 0 at x = 0.5
    let hit = bvh.closest_hit(&ray(Vec3::new(-1.0, 0.25, 1e-4), Vec3::new(1.5, 0.0, -1e-4))).unwrap();
    assert!((hit.t - 1.0).abs() < 1e-4, "{hit:?}");
}

#[test]
fn a_ray_from_a_million_away_hits_where_it_is_aimed() {
    let mesh = head(24);
    let bvh = Bvh::new(&mesh);
    let mut lost = 0;
    for i in 0..3000 {
        let axis = [Vec3::X, Vec3::Y, Vec3::Z][i % 3] * if i % 2 == 0 { 1.0 } else { -1.0 };
        let side = [Vec3::Y, Vec3::Z, Vec3::X][i % 3];
        let origin = axis * 1e6 + side * (noise(i as u32) - 0.5);
        let hit = bvh.closest_hit(&ray(origin, -axis));
        lost += hit.is_none() as usize;
        if let Some(h) = hit {
            assert!((h.t - (1e6 - 0.6)).abs() < 0.3, "{h:?}");
            let [a, b, c] = mesh.corners(h.triangle);
            let p = (1.0 - h.u - h.v) * a + h.u * b + h.v * c;
            assert!((p - origin).reject_from(axis).length() < 1e-5, "{p} {origin}");
        }
    }
    assert_eq!(lost, 0);
    // aslant: single precision places the origin to 0.06 only, but the hit lies on that very ray
    let mut met = 0;
    for i in 0..3000u32 {
        let d = (Vec3::new(noise(7 * i), noise(7 * i + 1), noise(7 * i + 2)) - 0.5).normalize();
        let r = ray(-1e6 * d, d);
        let on_line = |p: DVec3| {
            let (o, d) = (r.origin.as_dvec3(), r.direction.as_dvec3().normalize());
            (p - o).reject_from(d).length()
        };
        let hit = bvh.closest_hit(&r);
        assert!(hit.is_some() || on_line(DVec3::ZERO) > 0.6, "{r:?}");
        if let Some(h) = hit {
            met += 1;
            let [a, b, c] = mesh.corners(h.triangle);
            let p = (1.0 - h.u - h.v) * a + h.u * b + h.v * c;
            assert!(on_line(p.as_dvec3()) < 1e-5, "{r:?} {p}");
        }
    }
    assert!(met > 2500, "{met}");
    assert!(!bvh.any_hit(&ray(Vec3::new(1e6, 3.0, 0.0), -Vec3::X)));
    assert!(!bvh.any_hit(&ray(Vec3::new(1e6, 0.0, 0.0), Vec3::X)));
}

#[test]
fn degenerate_infinite_and_missing_triangles_do_no_harm() {
    let mut mesh = square();
    mesh.positions.extend([Vec3::splat(f32::NAN), Vec3::splat(0.5)]);
    mesh.triangles.extend([[0, 0, 1], [5, 5, 5], [0, 2, 5], [0, 1, 4], [0, 1, 99]]);
    let bvh = Bvh::new(&mesh);
    let hit = bvh.closest_hit(&ray(Vec3::new(0.75, 0.25, 2.0), -Vec3::Z)).unwrap();
    assert_eq!(hit.triangle, 0);
    // the point triangle at (0.5, 0.5, 0.5) is nearest to what is above it
    let near = bvh.closest_point(Vec3::new(0.5, 0.5, 2.0)).unwrap();
    assert_eq!((near.distance, near.triangle), (1.5, 3));
    assert_eq!(near.point, Vec3::splat(0.5));
    for bad in [Vec3::NAN, Vec3::ZERO, Vec3::INFINITY] {
        assert!(bvh.closest_hit(&ray(Vec3::ONE, bad)).is_none());
    }
    assert!(bvh.closest_point(Vec3::NAN).is_none());
}

#[test]
fn an_empty_mesh_is_met_by_nothing() {
    let bvh = Bvh::new(&Mesh::default());
    assert!(bvh.is_empty());
    assert!(bvh.closest_hit(&ray(Vec3::ZERO, Vec3::X)).is_none());
    assert!(!bvh.any_hit(&ray(Vec3::ZERO, Vec3::X)));
    assert!(bvh.closest_point(Vec3::ZERO).is_none());
}

#[test]
fn huge_tiny_and_distant_meshes_work_like_any_other() {
    for (scale, offset) in [(1e20f32, 0.0), (1e-22, 0.0), (1.0, 10_000.0), (1e-3, 1.0)] {
        let mut mesh = head(12);
        for p in &mut mesh.positions {
            *p = *p * scale + offset;
        }
        let bvh = Bvh::new(&mesh);
        let inside = Vec3::splat(offset);
        let near = bvh.closest_point(inside).unwrap().distance / scale;
        assert!((0.65..0.74).contains(&near), "{scale} {offset} {near}");
        for i in 0..2000u32 {
            let target = mesh.positions[i as usize % mesh.positions.len()];
            let direction = (target - inside) / scale;
            assert!(bvh.any_hit(&ray(inside, direction.normalize())), "{scale} {offset} {target}");
        }
    }
}

#[test]
fn many_copies_of_one_triangle_make_a_tree_that_still_answers() {
    let mut mesh = square();
    mesh.triangles = vec![[0, 1, 2]; 1000];
    let bvh = Bvh::new(&mesh);
    let hit = bvh.closest_hit(&ray(Vec3::new(0.75, 0.25, 2.0), -Vec3::Z)).unwrap();
    assert_eq!(hit.triangle, 0);
}
