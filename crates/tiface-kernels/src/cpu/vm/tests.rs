use super::fixture::{color, decoder, density, field, grid, network};
use super::mask::{BoxMask, Lattice, Walk};
use super::penalty::tv_factors;
use super::render::assign_colors;
use super::*;
use crate::cpu::march::COLORLESS;
use crate::cpu::reference;
use tiface_base::geom::Ray;
use tiface_base::math::rng;

/// Returns the position of a point with coordinates -1..=1 along each axis of the fixture's box.
fn at(u: [f32; 3]) -> [f32; 3] {
    [u[0] * 1.5, u[1] * 1.67, u[2]]
}

/// Returns the sum of TV over the three planes.
fn total_variation(grid: &Grid, values: &[f32]) -> f64 {
    (0..3)
        .map(|i| {
            let f = grid.plane(i);
            let x = &values[f.range()];
            let (pitch, n) = (f.width * f.channels, f.channels);
            let square = |a: f32, b: f32| (a as f64 - b as f64).powi(2);
            let mut sums = [0f64; 2];
            for y in 0..f.height {
                for k in 0..pitch {
                    let at = y * pitch + k;
                    if y > 0 {
                        sums[0] += square(x[at], x[at - pitch]);
                    }
                    if k >= n {
                        sums[1] += square(x[at], x[at - n]);
                    }
                }
            }
            let [kh, kw] = tv_factors(&f);
            sums[0] * kh + sums[1] * kw
        })
        .sum()
}

#[test]
fn density_features_have_the_published_values() {
    let points = [[0.0; 3], [0.25, -0.5, 0.75], [-0.9, 0.3, -0.1], [1.0; 3]].map(at);
    let want = [0.1918000, 0.1737500, 0.2303020, 0.1112000];
    for (got, want) in density_at(&field(), &density(), &points).iter().zip(want) {
        assert!((got - want).abs() < 2e-7, "{got} {want}");
    }
}

#[test]
fn rendered_rays_have_the_published_values() {
    let f = field();
    assert!((f.lattice.step - 0.2918889).abs() < 1e-7);
    let weights = DecoderWeights::new(decoder(), &network());
    let rays =
        [Ray::new([0.1, -0.2, 4.5], [0.02, 0.05, -1.0]), Ray::new([0.3, 0.4, 4.2], [-0.1, 0.02, -1.0])];
    let out = render(&f, &density(), &color(), &weights, &rays, &[]).out;
    assert_eq!(composited(&f, &density(), &color(), &weights, &rays), out);
    // rgb over black, over white, depth with the published code's extra (1 − opacity) d_z
    let golden = [
        ([0.5031043, 0.5020230, 0.4993656], [0.5031812, 0.5020999, 0.4994425], 3.6129913),
        ([0.5033032, 0.5021623, 0.4993564], [0.5034794, 0.5023384, 0.4995325], 3.6014051),
    ];
    for (got, (black, white, depth)) in out.chunks_exact(RAY_WIDTH).zip(golden) {
        for c in 0..3 {
            assert!((got[c] - black[c]).abs() < 3e-7, "{got:?}");
            assert!((got[c] + 1.0 - got[3] - white[c]).abs() < 3e-7, "{got:?}");
        }
        assert!((got[4] - (1.0 - got[3]) - depth).abs() < 1e-6, "{got:?}");
    }
}

#[test]
fn dense_alpha_has_the_published_values() {
    let f = field();
    let vertex = |v: [usize; 3]| -> [f32; 3] {
        std::array::from_fn(|a| {
            let (l, h) = (f.lattice.min[a], f.lattice.max[a]);
            l + (h - l) * v[a] as f32 / (f.density.size[a] - 1) as f32
        })
    };
    let points = [[0, 0, 0], [4, 5, 6], [2, 3, 4]].map(vertex);
    for (sigma, want) in density_at(&f, &density(), &points).iter().zip([0.0567065f32, 0.0319369, 0.0532861])
    {
        let alpha = 1.0 - (-sigma * f.lattice.step).exp();
        assert!((alpha - want).abs() < 2e-7, "{alpha} {want}");
    }
}

#[test]
fn penalties_have_the_published_values() {
    assert!((total_variation(&grid(), &density()) * 1e-2 - 6.0e-5).abs() < 1e-9);
    // arange(24) as [1, 2, 3, 4]: TV 34.0, here channel last in a plane of its own
    let one = Grid { size: [4, 3, 2], rank: [2, 0, 0] };
    let mut values = vec![0.0; one.len()];
    for c in 0..2 {
        for h in 0..3 {
            for w in 0..4 {
                values[(h * 4 + w) * 2 + c] = (c * 12 + h * 4 + w) as f32;
            }
        }
    }
    assert!((total_variation(&one, &values) - 34.0).abs() < 1e-9);
}

#[test]
fn voxel_counts_and_sizes_are_the_published_ones() {
    let counts = voxel_schedule(2_097_156, 27_000_000, 5);
    assert_eq!(counts, [3_496_047, 5_828_060, 9_715_614, 16_196_343, 26_999_994]);
    let extent = [3.0, 3.34, 2.0];
    assert_eq!(size_for(extent, 2_097_156), [141, 157, 94]);
    let want = [[167, 186, 111], [198, 221, 132], [235, 262, 157], [279, 311, 186], [331, 368, 220]];
    for (count, want) in counts.into_iter().zip(want) {
        assert_eq!(size_for(extent, count), want);
    }
    assert!((step_size(extent, [141, 157, 94], 0.5) - 0.010724).abs() < 1e-6);
    assert!((step_size(extent, [331, 368, 220], 0.5) - 0.004554).abs() < 1e-6);
}

fn check_gradients(softplus: bool, encodings: usize, group_weight: f32, seed: u64) -> Vec<f64> {
    let mut f = field();
    let size = [6, 5, 7];
    f.density = Grid { size, rank: [5, 4, 1] };
    f.color = Grid { size, rank: [9, 0, 6] };
    f.decoder = DecoderShape {
        channels: 15,
        features: 7,
        hidden: 16,
        view_frequencies: encodings,
        feature_frequencies: encodings,
    };
    f.shading.softplus = softplus;
    f.shading.shift = -1.0;
    f.shading.distance_scale = 3.0;
    f.shading.weight_threshold = 0.0;
    f.shading.group_weight = group_weight;
    f.lattice.step = 0.11;
    f.lattice.samples = 60;
    let normal = |stream: u64, n: usize, scale: f32| -> Vec<f32> {
        (0..n).map(|i| scale * rng::normal(seed, stream, i as u64)).collect()
    };
    let density: Vec<f32> = normal(1, f.density.len(), 0.4).iter().map(|v| v + 0.2).collect();
    let color = normal(2, f.color.len(), 0.7);
    let network = normal(3, f.decoder.len(), 0.5);
    let (rays, jitter): (Vec<Ray>, Vec<f32>) = (0..24)
        .map(|i| {
            let u = |k: u64| rng::uniform(seed, 4, 8 * i + k) - 0.5;
            (Ray::new([2.0 * u(0), 2.0 * u(1), 4.6], [0.3 * u(2), 0.3 * u(3), -1.0]), u(4) + 0.5)
        })
        .unzip();
    let g = normal(5, rays.len() * RAY_WIDTH, 1.0);
    let weights = DecoderWeights::new(f.decoder, &network);
    let rendered = render(&f, &density, &color, &weights, &rays, &jitter);
    let least = if group_weight == 0.0 { 200 } else { 100 };
    assert!(rendered.color_samples > least, "{}", rendered.color_samples);
    let (mut gd, mut gc) = (vec![0.0; density.len()], vec![0.0; color.len()]);
    let gn = backward(&f, &density, &weights, rendered, &g, &mut gd, &mut gc);
    let analytic: Vec<f32> = [gd, gc, gn].concat();
    let x = reference::wide(&[density, color, network].concat());
    let want = reference::vm::gradient(&f, &x, (&rays, &jitter), &g);
    let largest = analytic.iter().fold(0f32, |m, g| m.max(g.abs())) as f64;
    let error = |(got, want): (&f32, f64)| (f64::from(*got) - want).abs() / want.abs().max(1e-2 * largest);
    analytic.iter().zip(want).map(error).collect()
}

#[test]
fn gradients_are_those_of_the_plain_formulas() {
    let mut errors = Vec::new();
    for (softplus, encodings, group_weight, seed) in
        [(false, 0, 0.0, 1), (false, 2, 0.1, 2), (true, 0, 0.1, 3), (true, 2, 0.0, 4)]
    {
        errors.extend(check_gradients(softplus, encodings, group_weight, seed));
    }
    errors.sort_by(f64::total_cmp);
    let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!("{} gradients: worst {worst:.2e}, median {median:.2e}", errors.len());
    assert!(worst <= 1e-3 && median <= 1e-4, "worst {worst:.2e}, median {median:.2e}");
}

#[test]
fn penalty_gradients_agree_with_finite_differences() {
    let grid = Grid { size: [5, 4, 6], rank: [3, 2, 1] };
    let x: Vec<f32> = (0..grid.len()).map(|i| rng::normal(7, 1, i as u64)).collect();
    let mut g = vec![0.0; grid.len()];
    penalize(&grid, 0.7, &x, &mut g);
    let value = |x: &[f32]| 0.7 * total_variation(&grid, x);
    for i in (0..grid.len()).step_by(3) {
        let h = 1e-3f32;
        let (mut up, mut down) = (x.clone(), x.clone());
        up[i] += h;
        down[i] -= h;
        let want = (value(&up) - value(&down)) / (up[i] - down[i]) as f64;
        assert!((g[i] as f64 - want).abs() < 1e-4 * want.abs().max(0.1), "{i}: {} {want}", g[i]);
    }
}

#[test]
fn a_mask_removes_samples_and_moves_none() {
    let lattice = Lattice {
        min: [-1.0, -0.8, -1.2],
        max: [1.0, 0.8, 1.2],
        step: 0.013,
        samples: 400,
        near: 0.0,
        far: 9.0,
    };
    // the mask's box is smaller than the field's, as after an update before the box shrinks again
    let masked = |one_in: usize| {
        let hit = |c: [usize; 3]| (c[0] * 7 + c[1] * 3 + c[2]).is_multiple_of(one_in) && c[0] < 30;
        BoxMask::new([-0.9, -0.8, -1.2], [1.0, 0.7, 1.1], [37, 20, 29], hit)
    };
    // hardly an empty brick, and hardly one that is not
    let masks = [masked(11), masked(97)];
    let (mut hit_rays, mut left) = (0, [0; 2]);
    for (mask, i) in (0..50).flat_map(|i| [(0, i), (1, i)]) {
        let masks_left = &mut left[mask];
        let mask = &masks[mask];
        let u = |k: u64| rng::uniform(9, 1, 8 * i + k) - 0.5;
        // down and up
        let sign = if i % 2 == 0 { 1.0 } else { -1.0 };
        let direction = if i == 0 { [0.0, 0.0, -1.0] } else { [0.8 * u(0), 0.8 * u(1), -sign] };
        let ray = Ray::new([u(2), u(3), 3.0 * sign], direction);
        let points = |mask: Option<&BoxMask>| {
            let mut walk = Walk::new(&lattice, mask, &ray, u(4) + 0.5);
            std::iter::from_fn(|| walk.advance()).collect::<Vec<f32>>()
        };
        let (all, some) = (points(None), points(Some(mask)));
        *masks_left += some.len();
        let want: Vec<f32> = all
            .iter()
            .copied()
            .filter(|t| mask.contains(std::array::from_fn(|a| ray.origin[a] + t * ray.direction[a])))
            .collect();
        hit_rays += usize::from(!all.is_empty());
        // a sample on the very border of a cell may fall on either side
        let differing = want.iter().filter(|t| !some.contains(t)).count()
            + some.iter().filter(|t| !want.contains(t)).count();
        assert!(differing <= 1, "ray {i}: {differing} of {}", want.len());
    }
    assert!(hit_rays > 60 && left[0] > 5 * left[1] && left[1] > 10, "{hit_rays} {left:?}");
}

#[test]
fn a_ray_that_is_not_finite_has_no_points() {
    let lattice = Lattice { min: [-1.0; 3], max: [1.0; 3], step: 0.1, samples: 40, near: 0.0, far: 9.0 };
    let mask = BoxMask::new([-1.0; 3], [1.0; 3], [8; 3], |_| true);
    let points = |ray: Ray| {
        let mut walk = Walk::new(&lattice, Some(&mask), &ray, 0.5);
        std::iter::from_fn(|| walk.advance()).count()
    };
    let (from, along) = ([0.1, 0.2, 3.0], [0.0, 0.1, -1.0]);
    assert!(points(Ray::new(from, along)) > 10);
    for wrong in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for axis in 0..3 {
            let with = |mut v: [f32; 3]| {
                v[axis] = wrong;
                v
            };
            assert_eq!(points(Ray::new(with(from), along)) + points(Ray::new(from, with(along))), 0);
        }
    }
}

#[test]
fn bits_after_the_last_cell_are_cleared() {
    let mask = BoxMask::from_bits([0.0; 3], [1.0; 3], [4, 3, 5], vec![u64::MAX]).unwrap();
    assert_eq!((mask.bits(), mask.share()), (&[(1 << 60) - 1][..], 1.0));
    assert!(BoxMask::from_bits([0.0; 3], [1.0; 3], [4, 3, 5], vec![0; 2]).is_none());
}

#[test]
fn vertices_occupy_the_cells_around_them() {
    let mut vertices = vec![false; 4 * 5 * 6];
    vertices[(2 * 5 + 1) * 6 + 5] = true;
    let mask = BoxMask::from_vertices([0.0; 3], [3.0, 4.0, 5.0], [4, 5, 6], &vertices);
    // vertex (2, 1, 5) occupies all cells less than one away along every axis, also outside the
    // border
    for (p, inside) in
        [([1.5, 0.5, 4.5], true), ([2.9, 1.9, 5.9], true), ([0.9, 1.0, 5.0], false), ([2.0, 1.0, 3.9], false)]
    {
        assert_eq!(mask.contains(p), inside, "{p:?}");
    }
    assert_eq!(mask.size(), [5, 6, 7]);
}

#[test]
fn finer_grids_keep_corners_and_straight_lines() {
    let a = grid();
    let b = Grid { size: [9, 11, 13], rank: a.rank };
    let (x, fine) = (density(), resized(&grid(), &density(), &b));
    // the fixture is linear in the vertex indices, so interpolation is exact: halves in between
    let (p, q) = (a.plane(0), b.plane(0));
    let at =
        |f: &Factor, x: &[f32], h: usize, w: usize, c: usize| x[f.start + (h * f.width + w) * f.channels + c];
    for c in 0..2 {
        for (h, w) in [(0, 0), (3, 2), (5, 4)] {
            assert!((at(&q, &fine, 2 * h, 2 * w, c) - at(&p, &x, h, w, c)).abs() < 1e-6);
        }
        let mid = 0.5 * (at(&p, &x, 1, 1, c) + at(&p, &x, 2, 2, c));
        assert!((at(&q, &fine, 3, 3, c) - mid).abs() < 1e-6);
    }
    let (small, kept) = cropped(&a, &x, [1, 0, 2], [4, 6, 7]);
    assert_eq!((small.size, kept.len()), ([3, 6, 5], small.len()));
    // plane 1 is x × z: its corner was at x = 1, z = 2
    let (f, o) = (small.plane(1), a.plane(1));
    assert_eq!(at(&f, &kept, 0, 0, 0), at(&o, &x, 2, 1, 0));
    assert_eq!(kept[small.line(0).start], x[a.line(0).start + 2 * 2]);
}

#[test]
fn early_termination_changes_a_ray_by_less_than_its_transmittance() {
    let mut f = field();
    f.lattice.step = 0.02;
    f.lattice.samples = 300;
    let weights = DecoderWeights::new(decoder(), &network());
    let ray = [Ray::new([0.1, -0.2, 4.5], [0.02, 0.05, -1.0])];
    let all = render(&f, &density(), &color(), &weights, &ray, &[]);
    f.shading.stop = 1e-3;
    let some = render(&f, &density(), &color(), &weights, &ray, &[]);
    assert!(some.density_samples < all.density_samples);
    for (a, b) in all.out.iter().zip(&some.out).take(4) {
        assert!((a - b).abs() < 1e-3, "{:?} {:?}", all.out, some.out);
    }
}

#[test]
fn samples_share_a_color_until_their_weights_sum_to_that_of_a_group() {
    let mut shading = field().shading;
    (shading.weight_threshold, shading.group_weight) = (0.01, 0.25);
    let colors = |shading: &Shading, weights: &[f32]| {
        let (mut color_of, mut colored) = (vec![7; weights.len()], Vec::new());
        assign_colors(shading, weights.iter().copied(), 10, &mut color_of, &mut colored);
        (color_of, colored)
    };
    const NONE: u32 = COLORLESS;
    // one group of three, a sample that is heavy enough alone, a light rest, and what has no color
    let weights = [0.125, 0.005, 0.0625, 0.0625, 0.3, 0.1];
    assert_eq!(colors(&shading, &weights), (vec![0, NONE, 0, 0, 1, 1], vec![13, 14]));
    assert_eq!(colors(&shading, &[0.005, 0.02, 0.03, 0.0]), (vec![NONE, 0, 0, NONE], vec![12]));
    assert_eq!(colors(&shading, &[0.005, 0.0]), (vec![NONE, NONE], vec![]));
    shading.group_weight = 0.0;
    assert_eq!(colors(&shading, &[0.02, 0.01, 0.5]), (vec![0, NONE, 1], vec![10, 12]));
}
