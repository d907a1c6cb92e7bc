//! Extraction against hard volumes, an independent count of the trilinear surface's topology,
//! another marching cubes, and the cost of asking a field.

use crate::command::said;
use crate::fields::{self, Noise};
use glam::Vec3;
use proptest::prelude::*;
use proptest::test_runner::RngSeed;
use rayon::prelude::*;
use std::ops::Range;
use std::process::Command;
use tiface::geom::{Aabb, Mesh, Topology, topology};
use tiface::mesh::{ExtractOptions, NodeGrid, Sparse, Volume, extract, marching, sparse};

fn surface(dims: [usize; 3], values: &[f32], closed: bool) -> Mesh {
    marching(&Volume { dims, values, origin: Vec3::ZERO, spacing: Vec3::ONE }, closed).unwrap().mesh
}

fn analyzed(s: &Mesh) -> Topology {
    topology(&s.positions, &s.triangles)
}

/// Values surrounded by one layer of `outside`.
fn padded(n: usize, outside: f32, mut value: impl FnMut() -> f32) -> ([usize; 3], Vec<f32>) {
    let m = n + 2;
    let mut v = vec![outside; m * m * m];
    for z in 1..=n {
        for y in 1..=n {
            for x in 1..=n {
                v[(z * m + y) * m + x] = value();
            }
        }
    }
    ([m; 3], v)
}

/// Sound as a surface: closed, manifold, finite, no face without area. Nothing at all is sound too.
fn assert_sound(name: &str, dims: [usize; 3], values: &[f32], closed: bool) -> Topology {
    let s = surface(dims, values, closed);
    let t = analyzed(&s);
    assert!(s.triangles.is_empty() || t.is_solid(), "{name}: {t:?}\n{values:?}");
    assert_eq!(t.unused_vertices, 0, "{name}");
    let top = Vec3::from(dims.map(|d| (d - 1) as f32));
    assert!(s.positions.iter().all(|p| p.min_element() >= 0.0 && (top - *p).min_element() >= 0.0));
    t
}

// ---- hard volumes: two hundred of each kind ----

#[test]
fn hard_volumes_are_closed_manifold_and_finite() {
    let kinds: [(&str, fn(&mut Noise) -> f32); 8] = [
        ("random", |n| n.next()),
        ("ties", |n| if n.bits() & 1 == 0 { 1.0 } else { -1.0 }),
        ("zeros", |n| (n.bits() % 3) as f32 - 1.0),
        ("denormals", |n| n.next() * 1e-44),
        ("huge", |n| n.next() * f32::MAX),
        ("mixed sizes", |n| n.next() * 10f32.powi((n.bits() % 70) as i32 - 38)),
        ("NaN nodes", |n| if n.bits() % 8 == 0 { f32::NAN } else { n.next() }),
        ("infinite nodes", |n| match n.bits() % 10 {
            0 => f32::INFINITY,
            1 => f32::NEG_INFINITY,
            _ => n.next(),
        }),
    ];
    for (name, value) in kinds {
        (0..200u64).into_par_iter().for_each(|seed| {
            let mut noise = Noise(seed);
            let (dims, v) = padded(4, 1.0, || value(&mut noise));
            assert_sound(name, dims, &v, false);
            // Uneven sizes, run off the box on all sides, across word borders for some.
            let dims = [[3, 7, 5], [5, 2, 4], [66, 3, 4], [2, 2, 2]][seed as usize % 4];
            let v: Vec<f32> = (0..dims.iter().product()).map(|_| value(&mut noise)).collect();
            assert_sound(name, dims, &v, true);
        });
    }
}

#[test]
fn every_sign_pattern_near_face_and_body_saddles_is_sound() {
    // All 256 patterns; sizes drawn near values that make face determinants and body saddles
    // vanish.
    (0..256u32).into_par_iter().for_each(|case| {
        let mut noise = Noise(u64::from(case));
        for round in 0..60 {
            let sizes = [1.0, 1.0 + f32::EPSILON, 1.0 - f32::EPSILON, 0.5, 2.0, 1.0 / 3.0];
            let mut corner = 0;
            let (dims, v) = padded(2, 1.0, || {
                let size = if round < 30 {
                    sizes[noise.bits() as usize % sizes.len()]
                } else {
                    noise.next().abs().powi(1 + round % 5)
                };
                let inside = case >> corner & 1 == 1;
                corner += 1;
                if inside { -size.max(1e-6) } else { size }
            });
            assert_sound("saddle", dims, &v, false);
        }
    });
}

#[test]
fn a_six_cubed_board_of_ties_is_sound() {
    let mut noise = Noise(3);
    for _ in 0..50 {
        let (dims, v) = padded(6, 1.0, || if noise.bits() & 1 == 0 { 1.0 } else { -1.0 });
        assert_sound("ties", dims, &v, false);
    }
    // The checkerboard: every face of every cell ambiguous and tied, so every inside node stands
    // alone.
    let mut i = 0;
    let (dims, v) = padded(6, 1.0, || {
        let (x, y, z) = (i % 6, i / 6 % 6, i / 36);
        i += 1;
        if (x + y + z) % 2 == 0 { 1.0 } else { -1.0 }
    });
    let t = assert_sound("checkerboard", dims, &v, false);
    assert_eq!((t.pieces, t.euler), (108, 216));
}

#[test]
fn a_sphere_with_zeros_at_nodes_is_one_sphere() {
    // x² + y² + z² − 25 on integers: zero at (3, 4, 0), (5, 0, 0) and their like.
    let n = 15i32;
    let v: Vec<f32> = (0..n * n * n)
        .map(|i| {
            let (x, y, z) = (i % n - 7, i / n % n - 7, i / n / n - 7);
            (x * x + y * y + z * z - 25) as f32
        })
        .collect();
    let t = assert_sound("sphere", [15; 3], &v, false);
    assert_eq!((t.pieces, t.euler), (1, 2));
}

#[test]
fn empty_full_and_thin_volumes_do_not_crash() {
    for value in [f32::NAN, f32::INFINITY, 1.0, 0.0, -0.0] {
        assert!(surface([4; 3], &[value; 64], true).triangles.is_empty(), "{value}");
    }
    for value in [-1.0, f32::NEG_INFINITY, -1e-45] {
        let t = assert_sound("full", [4; 3], &[value; 64], true);
        assert_eq!((t.pieces, t.euler), (1, 2));
    }
    // One cell thick, closed: no node is off the border, so nothing is inside.
    assert!(surface([9, 9, 2], &[-1.0; 162], true).triangles.is_empty());
    // Open: the slab's surface ends at the border.
    let v: Vec<f32> = (0..162).map(|i| if i % 9 < 4 { -1.0 } else { 1.0 }).collect();
    let s = surface([9, 9, 2], &v, false);
    assert_eq!(s.triangles.len(), 16);
    assert!(s.positions.iter().all(|p| p.x == 3.5));
}

#[test]
fn a_surface_that_leaves_the_box_anywhere_is_capped() {
    // Balls about the middles of six faces, twelve edges and eight corners of the box.
    for i in 0..27 {
        let c = Vec3::new((i % 3) as f32, (i / 3 % 3) as f32, (i / 9) as f32) * 7.5;
        let v: Vec<f32> = (0..16 * 16 * 16)
            .map(|i| {
                let p = Vec3::new((i % 16) as f32, (i / 16 % 16) as f32, (i / 256) as f32);
                p.distance(c) - 5.3
            })
            .collect();
        let t = assert_sound("off the box", [16; 3], &v, true);
        assert_eq!((t.pieces, t.euler), (1, 2));
        let volume = Volume { dims: [16; 3], values: &v, origin: Vec3::ZERO, spacing: Vec3::ONE };
        assert_eq!(marching(&volume, true).unwrap().capped > 0, i != 13);
    }
}

#[test]
fn sheets_thinner_or_closer_than_a_voxel_are_sound() {
    let (v, _) = fields::grid(fields::gyroid, 48);
    assert_sound("gyroid", [48; 3], &v, true);
    let (v, _) = fields::grid(|p| (p.x + 0.3 * p.y + 0.1 * p.z).abs() - 0.012, 48);
    assert_sound("sheet", [48; 3], &v, true);
    let (v, _) = fields::grid(|p| ((p.x + 0.3 * p.y + 0.1 * p.z).abs() - 0.03).abs() - 0.02, 48);
    assert_sound("two sheets", [48; 3], &v, true);
}

#[test]
fn the_bytes_do_not_depend_on_the_number_of_threads() {
    let (values, _) = fields::grid(|p| fields::head(p) + 0.02 * (40.0 * p).sin().element_sum(), 70);
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| surface([70; 3], &values, true))
    };
    assert_eq!(on(1), on(3));
    let grid = NodeGrid::fit(Aabb::SCENE, 70).unwrap();
    let few = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| extracted(fields::gyroid, &grid).surface)
    };
    assert_eq!(few(1), few(3));
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 300,
        failure_persistence: None,
        rng_seed: RngSeed::Fixed(1),
        ..ProptestConfig::default()
    })]

    #[test]
    fn any_volume_is_closed_and_manifold(
        dims in (2usize..6, 2usize..6, 2usize..6),
        values in prop::collection::vec(prop::num::f32::ANY, 125),
    ) {
        let dims = [dims.0, dims.1, dims.2];
        let values = &values[..dims.iter().product()];
        assert_sound("any bits", dims, values, true);
    }

    #[test]
    fn small_integers_make_many_ties_and_still_close(
        values in prop::collection::vec(-2i8..=2, 64),
    ) {
        let mut v = values.iter();
        let (dims, v) = padded(4, 1.0, || f32::from(*v.next().unwrap()));
        assert_sound("small integers", dims, &v, false);
    }
}

// ---- the right topology ----

/// Pieces and Euler number of the trilinear surface, counted on a finer grid without any triangles.
///
/// The inside samples span a cubical complex. Its Euler number is half that of its surface; the
/// surface has one piece for each piece of the inside and of the outside (where samples touch
/// diagonally), less one, by Alexander duality.
fn sampled_topology(dims: [usize; 3], values: &[f32], fine: usize) -> (usize, i64) {
    let size = dims.map(|d| (d - 1) * fine + 1);
    let at = |x: usize, y: usize, z: usize| f64::from(values[(z * dims[1] + y) * dims[0] + x]);
    let mut inside = vec![false; size.iter().product()];
    for z in 0..size[2] {
        for y in 0..size[1] {
            for x in 0..size[0] {
                let split = |i: usize, n: usize| {
                    let c = (i / fine).min(n - 2);
                    (c, (i - c * fine) as f64 / fine as f64)
                };
                let ((i, u), (j, v), (k, w)) = (split(x, dims[0]), split(y, dims[1]), split(z, dims[2]));
                let mix = |a: f64, b: f64, t: f64| a * (1.0 - t) + b * t;
                let edge = |j: usize, k: usize| mix(at(i, j, k), at(i + 1, j, k), u);
                let f =
                    mix(mix(edge(j, k), edge(j + 1, k), v), mix(edge(j, k + 1), edge(j + 1, k + 1), v), w);
                inside[(z * size[1] + y) * size[0] + x] = f < 0.0;
            }
        }
    }
    let step = [1, size[0], size[0] * size[1]];
    let mut euler = 0i64;
    let mut parent: Vec<u32> = (0..inside.len() as u32).collect();
    fn find(parent: &mut [u32], mut i: u32) -> u32 {
        while parent[i as usize] != i {
            parent[i as usize] = parent[parent[i as usize] as usize];
            i = parent[i as usize];
        }
        i
    }
    for z in 0..size[2] {
        for y in 0..size[1] {
            for x in 0..size[0] {
                let p = [x, y, z];
                let here = x + y * step[1] + z * step[2];
                // Cells of the complex whose lowest corner this is: one for each set of axes.
                for axes in 0..8usize {
                    if (0..3).any(|a| axes >> a & 1 == 1 && p[a] + 1 == size[a]) {
                        continue;
                    }
                    let reach = |c: usize| (0..3).map(|a| (c >> a & 1) * step[a]).sum::<usize>();
                    if (0..8).filter(|c| c & !axes == 0).all(|c| inside[here + reach(c)]) {
                        euler += if axes.count_ones() % 2 == 0 { 1 } else { -1 };
                    }
                }
                // Outside: all 26 neighbors, inside: 6. Half of each, the other half sees us.
                for dz in 0..=1isize {
                    for dy in -1..=1isize {
                        for dx in -1..=1isize {
                            let d = [dx, dy, dz];
                            if (dz, dy, dx) <= (0, 0, 0) {
                                continue;
                            }
                            let q: [isize; 3] = std::array::from_fn(|a| p[a] as isize + d[a]);
                            if (0..3).any(|a| q[a] < 0 || q[a] >= size[a] as isize) {
                                continue;
                            }
                            let there = q[0] as usize + q[1] as usize * step[1] + q[2] as usize * step[2];
                            let straight = d.iter().filter(|d| **d != 0).count() == 1;
                            if inside[here] == inside[there] && (straight || !inside[here]) {
                                let (a, b) =
                                    (find(&mut parent, here as u32), find(&mut parent, there as u32));
                                parent[a.max(b) as usize] = a.min(b);
                            }
                        }
                    }
                }
            }
        }
    }
    let pieces = (0..parent.len()).filter(|&i| parent[i] == i as u32).count();
    (pieces - 1, 2 * euler)
}

/// The first of these resolutions, samples a cell, that agrees with the one before it.
fn settled(dims: [usize; 3], values: &[f32], fine: &[usize]) -> Option<(usize, i64)> {
    let mut last = None;
    for &fine in fine {
        let next = Some(sampled_topology(dims, values, fine));
        if next == last {
            return next;
        }
        last = next;
    }
    None
}

/// Right, compared, of all.
fn right_topology(volumes: u64, volume: impl Fn(u64) -> ([usize; 3], Vec<f32>) + Sync) -> (usize, usize) {
    (0..volumes)
        .into_par_iter()
        .map(|seed| {
            let (dims, v) = volume(seed);
            let t = analyzed(&surface(dims, &v, false));
            let found = Some((t.pieces, t.euler));
            // Coarse samples miss necks and gaps; where we differ, finer ones decide.
            if [[8, 13], [16, 25]].iter().any(|fine| settled(dims, &v, fine) == found) {
                return (1, 1);
            }
            let fine = settled(dims, &v, &[60, 90, 120]);
            println!("seed {seed}: {found:?}, sampled {fine:?}");
            (usize::from(found == fine), usize::from(fine.is_some()))
        })
        .reduce(|| (0, 0), |a, b| (a.0 + b.0, a.1 + b.1))
}

/// Compares volumes of `n`³ random nodes, one for each of these seeds. Of a hundred and more, one
/// may be right only beyond the finest samples, and two may not settle; of fewer, none.
fn random_volumes_are_right(seeds: Range<u64>, n: usize) {
    let volumes = (seeds.end - seeds.start) as usize;
    let (right, compared) = right_topology(volumes as u64, |i| {
        let mut noise = Noise(seeds.start + i);
        padded(n, 1.0, || noise.next())
    });
    println!("random {n}³: {right} right of {compared} compared");
    let spared = usize::from(volumes >= 100);
    assert!(compared + 2 * spared >= volumes && right + spared >= compared, "{right} of {compared}");
}

#[test]
fn random_volumes_have_the_pieces_and_euler_number_of_the_trilinear_surface() {
    // without 1000 and 1005, which settle only at a hundred samples a cell
    random_volumes_are_right(1001..1005, 4);
    random_volumes_are_right(1006..1008, 4);
}

#[test]
fn single_cells_have_the_pieces_and_euler_number_of_the_trilinear_surface() {
    random_volumes_are_right(50_000..50_120, 2);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; hundreds of volumes, some of them counted on two hundred million samples"]
fn hundreds_of_random_volumes_have_the_topology_of_the_trilinear_surface() {
    random_volumes_are_right(1000..1200, 4);
    random_volumes_are_right(50_000..50_600, 2);
}

// ---- against another marching cubes ----

#[test]
fn the_head_has_the_area_and_volume_of_another_marching_cubes() {
    use isosurface::MarchingCubes;
    use isosurface::distance::Signed;
    use isosurface::extractor::IndexedVertices;
    use isosurface::math::Vec3 as IsoVec3;
    use isosurface::sampler::Sampler;
    use isosurface::source::ScalarSource;

    struct Head;
    impl ScalarSource for Head {
        fn sample_scalar(&self, p: IsoVec3) -> Signed {
            Signed(fields::head(2.0 * Vec3::new(p.x, p.y, p.z) - 1.0))
        }
    }
    let n = 96;
    let (mut vertices, mut indices) = (Vec::new(), Vec::new());
    let mut extractor = IndexedVertices::new(&mut vertices, &mut indices);
    MarchingCubes::<Signed>::new(n).extract(&Sampler::new(&Head), &mut extractor);
    let theirs = Mesh {
        positions: vertices.chunks(3).map(|p| 2.0 * Vec3::new(p[0], p[1], p[2]) - 1.0).collect(),
        triangles: indices.chunks(3).map(|t| [t[0], t[2], t[1]]).collect(),
        ..Mesh::default()
    };
    let (values, h) = fields::grid(fields::head, n);
    let s = marching(
        &Volume { dims: [n; 3], values: &values, origin: Vec3::NEG_ONE, spacing: Vec3::splat(h) },
        false,
    )
    .unwrap();
    let ours = s.mesh;
    let area = |m: &Mesh| -> f64 {
        (0..m.triangles.len() as u32)
            .map(|t| {
                let [a, b, c] = m.corners(t);
                0.5 * f64::from((b - a).cross(c - a).length())
            })
            .sum()
    };
    let (v, w) = (ours.signed_volume(), theirs.signed_volume().abs());
    println!("area {} {}, volume {v} {w}", area(&ours), area(&theirs));
    assert!(ours.is_closed() && v > 0.0);
    assert!((area(&ours) / area(&theirs) - 1.0).abs() < 0.005);
    assert!((v / w - 1.0).abs() < 0.001);
}

// ---- few evaluations ----

fn extracted(field: fn(Vec3) -> f32, grid: &NodeGrid) -> Sparse {
    sparse(&field, grid, 8, &tiface::Quiet).unwrap()
}

/// Share of nodes evaluated and triangles the sparse surface lacks, against the dense one.
fn cost(field: fn(Vec3) -> f32, cells: usize) -> (f64, i64) {
    let grid = NodeGrid::fit(Aabb::SCENE, cells).unwrap();
    let start = std::time::Instant::now();
    let few = extracted(field, &grid);
    let seconds = start.elapsed().as_secs_f64();
    let (values, h) = fields::grid(field, cells + 1);
    let volume =
        Volume { dims: [cells + 1; 3], values: &values, origin: Vec3::NEG_ONE, spacing: Vec3::splat(h) };
    let dense = marching(&volume, true).unwrap().mesh;
    let n = cells + 1;
    // The least any scheme can do: nodes of crossed cells.
    let mut needed = vec![false; n * n * n];
    for i in 0..n * n * n {
        if i % n == cells || i / n % n == cells || i / n / n == cells {
            continue;
        }
        let corners: [usize; 8] = std::array::from_fn(|c| i + (c & 1) + (c >> 1 & 1) * n + (c >> 2) * n * n);
        let inside = corners.iter().filter(|&&c| values[c] < 0.0).count();
        if inside % 8 != 0 {
            corners.iter().for_each(|&c| needed[c] = true);
        }
    }
    let least = needed.iter().filter(|&&n| n).count() as f64 / grid.nodes() as f64;
    let share = few.evaluated as f64 / grid.nodes() as f64;
    let lost = dense.triangles.len() as i64 - few.surface.mesh.triangles.len() as i64;
    println!(
        "{cells}³: {:.3} % evaluated, {:.3} % at least, {lost} of {} triangles lost, {seconds:.2} s",
        100.0 * share,
        100.0 * least,
        dense.triangles.len()
    );
    assert_eq!(few.surface.mesh.positions.len(), dense.positions.len());
    (share, lost)
}

#[test]
fn a_head_needs_two_percent_of_the_nodes_and_loses_no_triangle() {
    let (share, lost) = cost(fields::head, 256);
    assert!(share <= 0.020 && lost == 0, "{share}, {lost}");
    let (_, lost) = cost(fields::bent_head, 96);
    assert_eq!(lost, 0);
    let (_, lost) = cost(fields::gyroid, 64);
    assert_eq!(lost, 0);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; the dense volume of a bent field to compare with"]
fn a_field_of_any_gradient_needs_little_more() {
    let (share, lost) = cost(fields::bent_head, 256);
    assert!(share <= 0.025 && lost == 0, "{share}, {lost}");
    let (_, lost) = cost(fields::gyroid, 128);
    assert_eq!(lost, 0);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; half a gigabyte of dense volume to compare with"]
fn a_head_at_512_needs_a_hundredth_of_the_nodes() {
    let (share, lost) = cost(fields::head, 512);
    assert!(share <= 0.013 && lost == 0, "{share}, {lost}");
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; a 1024³ grid, of which time and peak memory are printed"]
fn a_head_at_1024_fits_in_half_a_gigabyte() {
    // the peak is that of a process, so that it takes one without other tests
    if std::env::var_os("TIFACE_ALONE").is_none() {
        let mut alone = Command::new(std::env::current_exe().unwrap());
        alone.args([
            "--exact",
            "extraction::a_head_at_1024_fits_in_half_a_gigabyte",
            "--ignored",
            "--nocapture",
        ]);
        let output = alone.env("TIFACE_ALONE", "1").output().unwrap();
        let text = said(&output);
        print!("{text}");
        assert!(output.status.success() && text.contains("1 passed"), "{text}");
        return;
    }
    let grid = NodeGrid::fit(Aabb::SCENE, 1024).unwrap();
    let start = std::time::Instant::now();
    let few = extracted(fields::head, &grid);
    println!(
        "1024³: {:.3} % evaluated, {} triangles, {:.2} s",
        100.0 * few.evaluated as f64 / grid.nodes() as f64,
        few.surface.mesh.triangles.len(),
        start.elapsed().as_secs_f64()
    );
    // Linux only; elsewhere there is nothing to read and nothing is claimed.
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    if let Some(line) = status.lines().find(|l| l.starts_with("VmHWM")) {
        println!("{line}");
        let kilobytes: u64 = line.split_whitespace().nth(1).and_then(|w| w.parse().ok()).unwrap();
        assert!(kilobytes < 500_000, "{line}");
    }
}

#[test]
fn fields_of_any_slope_and_offset_lose_nothing() {
    // Gradient norm 0.3 and 3; a field whose values are not centered on zero; a constant one.
    let ball = |p: Vec3| p.distance(Vec3::new(0.1, 0.0, 0.0)) - 0.55;
    let soft: fn(Vec3) -> f32 = |p| 0.3 * (p.distance(Vec3::new(0.1, 0.0, 0.0)) - 0.55);
    let steep: fn(Vec3) -> f32 = |p| 3.0 * (p.distance(Vec3::new(0.1, 0.0, 0.0)) - 0.55);
    let saturated: fn(Vec3) -> f32 = |p| (5.0 * (p.length() - 0.5)).tanh() + 0.3;
    assert_eq!(cost(soft, 64).1, 0);
    assert_eq!(cost(steep, 64).1, 0);
    assert_eq!(cost(saturated, 64).1, 0);
    let grid = NodeGrid::fit(Aabb::SCENE, 32).unwrap();
    assert!(extracted(|_| 0.5, &grid).surface.mesh.triangles.is_empty());
    assert!(ball(Vec3::ZERO) < 0.0);
}

// ---- the stage ----

#[test]
fn a_head_becomes_one_closed_piece_on_the_surface_with_unit_normals() {
    let config = ExtractOptions { resolution: 128, ..ExtractOptions::default() };
    for field in [fields::head as fn(Vec3) -> f32, fields::bent_head] {
        let (mesh, report) = extract(&field, Aabb::SCENE, &config, &tiface::Quiet).unwrap();
        println!("{}", serde_json::to_string(&report).unwrap());
        assert!(report.topology.is_solid());
        assert_eq!((report.topology.pieces, report.topology.euler), (1, 2));
        assert!(report.off_surface_after < 0.002, "{}", report.off_surface_after);
        assert!(report.off_surface_after < 0.2 * report.off_surface_before);
        assert!(report.held_back * 200 < mesh.positions.len(), "{}", report.held_back);
        assert!(mesh.normals.iter().all(|n| (n.length() - 1.0).abs() < 1e-4));
        // Faces agree with the field's normals at their corners.
        let mut turned = 0;
        for (t, tri) in mesh.triangles.iter().enumerate() {
            let [a, b, c] = mesh.corners(t as u32);
            let n: Vec3 = tri.iter().map(|&v| mesh.normals[v as usize]).sum();
            turned += usize::from((b - a).cross(c - a).dot(n) <= 0.0);
        }
        assert!(turned * 2000 < mesh.triangles.len(), "{turned} of {}", mesh.triangles.len());
    }
}

#[test]
fn noise_through_the_whole_stage_stays_a_closed_manifold() {
    // Value noise at three cells a wave: tunnels, ties of pieces, caps on all sides.
    let field = |p: Vec3| {
        let q = 9.0 * p;
        (q.x + 2.0 * q.y.sin()).sin() + (q.y + 2.0 * q.z.sin()).sin() + (q.z + 2.0 * q.x.sin()).sin()
    };
    let bounds = Aabb { min: Vec3::new(-1.0, -0.7, -0.9), max: Vec3::new(0.8, 0.9, 1.0) };
    let config = ExtractOptions { resolution: 24, ..ExtractOptions::default() };
    let (_, report) = extract(&field, bounds, &config, &tiface::Quiet).unwrap();
    assert!(report.topology.is_solid(), "{report:?}");
    // and every piece of it, before the largest is kept
    let grid = NodeGrid::fit(bounds, 24).unwrap();
    let all = sparse(&field, &grid, 8, &tiface::Quiet).unwrap().surface.mesh;
    let found = topology(&all.positions, &all.triangles);
    assert!(found.is_solid() && found.pieces == report.clean.pieces, "{found:?}");
}
