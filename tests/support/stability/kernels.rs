//! The kernels in f32 against the same formulas in f64, with ordinary and extreme numbers.

use super::case::{Cases, StabilityCase, relative, worst};
use super::reference::{self, wide};
use glam::{DMat3, DVec3, Vec2};
use std::array::from_fn;
use tiface::geom::sphharm::sh16;
use tiface::geom::{Camera, Distortion, Ray};
use tiface::image::{Image, linear_from_srgb, srgb_from_linear};
use tiface::kernel::cpu::adam::{AdamStep, adam};
use tiface::kernel::cpu::hash::{self, Level};
use tiface::kernel::cpu::mlp::Weights;
use tiface::kernel::cpu::sdf::{self, FieldShape};
use tiface::kernel::cpu::simd;
use tiface::kernel::cpu::vm::mask::Lattice;
use tiface::kernel::cpu::vm::{self, DecoderShape, DecoderWeights, Grid, Shading, VmField};
use tiface::math::rng;
use tiface::metrics::{ssim_reflect_map, ssim_valid};

pub(super) fn cases() -> Vec<StabilityCase> {
    let mut cases = Cases::new("kernels");
    functions(&mut cases);
    grids(&mut cases);
    networks(&mut cases);
    radiance(&mut cases);
    cameras(&mut cases);
    pictures(&mut cases);
    cases.done
}

fn normals(stream: u64, n: usize, scale: f32) -> Vec<f32> {
    (0..n).map(|i| scale * rng::normal(51, stream, i as u64)).collect()
}

fn unit(stream: u64, i: usize) -> [f32; 3] {
    let d: [f32; 3] = from_fn(|a| rng::normal(52, 4 * stream + a as u64, i as u64));
    let length = d.iter().map(|c| c * c).sum::<f32>().sqrt();
    d.map(|c| c / length)
}

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// exp, ln(1 + e), the logistic function, spherical harmonics, sRGB, AdamW.
fn functions(cases: &mut Cases) {
    let along = |low: f32, high: f32| (0..20_000).map(move |i| low + (high - low) * i as f32 / 19_999.0);
    let mut of = |name: &str,
                  low: f32,
                  high: f32,
                  got: fn(f32) -> f32,
                  want: fn(f64) -> f64,
                  least: f64,
                  bound: f64| {
        let want: Vec<f64> = along(low, high).map(|x| want(x as f64)).collect();
        cases.add(name, relative(along(low, high).map(got), &want, least), bound, "relative");
    };
    of("exp on -87..88", -87.0, 88.0, simd::exp::<false>, f64::exp, 0.0, 5e-7);
    of("ln(1 + e) on 0..1", 0.0, 1.0, simd::ln_1p::<false>, f64::ln_1p, 1e-30, 5e-7);
    of("logistic on -80..80", -80.0, 80.0, simd::sigmoid::<false>, logistic, 0.0, 1e-6);
    let complement = |x| simd::sigmoid_and_complement::<false>(x)[1];
    of("logistic's complement on -80..80", -80.0, 80.0, complement, |x| logistic(-x), 0.0, 1e-6);
    let coded = |c: f64| if c <= 0.0031308 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 };
    let linear = |s: f64| if s <= 0.04045 { s / 12.92 } else { ((s + 0.055) / 1.055).powf(2.4) };
    of("sRGB from linear", 0.0, 1.0, srgb_from_linear, coded, 1e-3, 1e-6);
    of("linear from sRGB", 0.0, 1.0, linear_from_srgb, linear, 1e-3, 1e-6);
    of("sRGB there and back", 0.0, 1.0, |c| srgb_from_linear(linear_from_srgb(c)), |c| c, 1e-3, 2e-6);

    let harmonics = (0..5000).map(|i| {
        let d = if i < 6 {
            from_fn(|a| if a == i / 2 { 1.0 - 2.0 * (i % 2) as f32 } else { 0.0 })
        } else {
            unit(0, i)
        };
        relative(sh16(d), &reference::harmonics(d.map(f64::from)), 1.0)
    });
    cases.add("spherical harmonics", worst(harmonics), 1e-6, "absolute");

    let (mut p, mut m, mut v) = (normals(1, 512, 1.0), vec![0f32; 512], vec![0f32; 512]);
    let (mut wp, mut wm, mut wv) = (wide(&p), vec![0f64; 512], vec![0f64; 512]);
    for step in 1..=200u64 {
        // gradients from 1e-12 to 1e6, the same size for each weight; some are zero
        let g: Vec<f32> = (0..512)
            .map(|i| {
                if i % 7 == 0 {
                    0.0
                } else {
                    10f32.powf(18.0 * i as f32 / 511.0 - 12.0) * rng::normal(53, step, i as u64)
                }
            })
            .collect();
        let (lr, beta1, beta2, epsilon, weight_decay) = (0.01f32, 0.9f32, 0.99f32, 1e-15f32, 0.01f32);
        for i in 0..512 {
            let (b1, b2, g) = (beta1 as f64, beta2 as f64, g[i] as f64);
            (wm[i], wv[i]) = (b1 * wm[i] + (1.0 - b1) * g, b2 * wv[i] + (1.0 - b2) * g * g);
            let (m, v) = (wm[i] / (1.0 - b1.powf(step as f64)), wv[i] / (1.0 - b2.powf(step as f64)));
            wp[i] -= lr as f64 * (weight_decay as f64 * wp[i] + m / (v.sqrt() + epsilon as f64));
        }
        let s = AdamStep { lr, beta1, beta2, epsilon, weight_decay, step, skip_zero: false };
        adam(&mut p, &mut m, &mut v, &mut g.clone(), &s);
    }
    cases.add("AdamW, 200 steps, gradients of 1e-12 to 1e6", relative(p, &wp, 1.0), 1e-4, "absolute");
}

/// Points of [-radius, radius]³: drawn, on its borders, in its corners and middle.
fn points(n: usize, radius: f32) -> Vec<[f32; 3]> {
    let at = |i: usize, a: usize| match rng::below(54, a as u64, i as u64, 12) {
        0 => -radius,
        1 => radius,
        2 => 0.0,
        _ => radius * (2.0 * rng::uniform(55, a as u64, i as u64) - 1.0),
    };
    (0..n).map(|i| from_fn(|a| at(i, a))).collect()
}

fn table(levels: &[Level], scale: f32) -> Vec<[f32; 2]> {
    let values = normals(2, 2 * hash::entries(levels), scale);
    values.as_chunks::<2>().0.to_vec()
}

fn wide_table(table: &[[f32; 2]]) -> Vec<[f64; 2]> {
    table.iter().map(|e| e.map(f64::from)).collect()
}

/// The hash grid, level by level: features and their derivatives, relative to what its table holds.
fn grids(cases: &mut Cases) {
    for (name, count, base, growth) in [("draft", 14, 16, 1.4), ("paper", 16, 32, 1.319_507_910_772_894_2)] {
        let levels = hash::levels(count, base, growth, 14);
        let shape = FieldShape { levels, radius: 1.0, active: count, color_skip: false, soften: 0.0 };
        let table = table(&shape.levels, 1.0);
        let (wide, x) = (wide_table(&table), points(1500, 1.0));
        let x01: Vec<[f32; 3]> = x.iter().map(|p| p.map(|c| c * 0.5 + 0.5)).collect();
        let n = x.len();
        let blocks = n.div_ceil(hash::LANES);
        let (mut value, mut jacobian) =
            (vec![[0f32; 2]; count * n], vec![[[0f32; hash::LANES]; 6]; count * blocks]);
        hash::gather(&shape.levels, &table, &x01, 0.5, &mut value, Some(&mut jacobian));
        let (mut values, mut slopes) = (Vec::new(), Vec::new());
        for (i, p) in x.iter().enumerate() {
            let (u, du) = reference::sdf::features(&shape, &wide, *p);
            for (l, level) in shape.levels.iter().enumerate() {
                let at = 3 + 2 * l;
                values.push(relative(value[l * n + i], &u[at..at + 2], 1.0));
                let want: Vec<f64> =
                    du[at..at + 2].iter().flatten().map(|d| d / (0.5 * level.scale as f64)).collect();
                let got =
                    jacobian[l * blocks + i / hash::LANES].map(|d| d[i % hash::LANES] / (0.5 * level.scale));
                slopes.push(relative(got, &want, 1.0));
            }
        }
        // positions of f32 in the finest of some thousand cells: 2048 · 6e-8, times the slopes of
        // the table
        cases.add(format!("hash grid of {name}: features"), worst(values), 1e-3, "of the table");
        cases.add(format!("hash grid of {name}: derivatives"), worst(slopes), 1e-3, "of the table");
    }
}

/// The networks of the distance field, from nothing to weights of ten times their usual size;
/// forward, and backward along one drawn direction of all weights.
fn networks(cases: &mut Cases) {
    for (name, weight, feature, bound) in [
        ("nothing", 0.0, 0.0, 1e-5),
        ("small", 1e-3, 1e-4, 1e-5),
        ("usual", 0.2, 0.1, 2e-5),
        ("large", 0.7, 1.0, 1e-3),
    ] {
        let levels = hash::levels(6, 4, 1.7, 9);
        let shape = FieldShape { levels, radius: 1.0, active: 6, color_skip: true, soften: 2.0 };
        let (table, flat) = (table(&shape.levels, feature), normals(3, shape.layout().len(), weight));
        let x = points(400, 1.0);
        let d: Vec<[f32; 3]> = (0..x.len()).map(|i| unit(1, i)).collect();
        let weights = Weights::new(shape.layout(), &flat);
        let done = sdf::forward(&shape, &table, &weights, &x, &d);
        let all = |table: &[[f64; 2]], flat: &[f64]| -> Vec<f64> {
            x.iter().zip(&d).flat_map(|(x, d)| reference::sdf::field(&shape, table, flat, *x, *d)).collect()
        };
        let (wide_table, wide_flat) = (wide_table(&table), wide(&flat));
        let want = all(&wide_table, &wide_flat);
        // each output on the scale of its own largest
        let of = |k: usize| {
            let own: Vec<f64> = want.iter().skip(k).step_by(sdf::WIDTH).copied().collect();
            let size = worst(own.iter().map(|v| v.abs())).max(1e-6);
            relative(done.output().iter().skip(k).step_by(sdf::WIDTH).copied(), &own, size)
        };
        cases.add(format!("networks, weights {name}: distance"), of(0), bound, "relative");
        cases.add(format!("networks, weights {name}: gradient"), worst((1..4).map(of)), bound, "relative");
        cases.add(
            format!("networks, weights {name}: color"),
            worst((4..7).map(of)),
            20.0 * bound,
            "relative",
        );
        let alone = sdf::values(&shape, &table, &weights, &x);
        let own: Vec<f64> = want.iter().step_by(sdf::WIDTH).copied().collect();
        let size = worst(own.iter().map(|v| v.abs())).max(1e-6);
        cases.add(
            format!("networks, weights {name}: distance alone"),
            relative(alone, &own, size),
            bound,
            "relative",
        );
        let g = normals(4, want.len(), 1.0);
        let mut by_table = vec![[0f32; 2]; table.len()];
        let by_flat = sdf::backward(&done, &weights, &g, &mut by_table);
        let (toward, toward_table) = (normals(5, flat.len(), 1.0), normals(6, 2 * table.len(), 1.0));
        let loss = |h: f64| -> f64 {
            let mut t = wide_table.clone();
            t.as_flattened_mut().iter_mut().zip(&toward_table).for_each(|(v, d)| *v += h * *d as f64);
            let f: Vec<f64> = wide_flat.iter().zip(&toward).map(|(v, d)| v + h * *d as f64).collect();
            all(&t, &f).iter().zip(&g).map(|(o, g)| o * *g as f64).sum()
        };
        let parts = by_flat.iter().zip(&toward).chain(by_table.as_flattened().iter().zip(&toward_table));
        let error = if weight == 0.0 { finite(parts.map(|(g, _)| *g)) } else { along(parts, &loss, 1e-8) };
        cases.add(format!("networks, weights {name}: backward"), error, 10.0 * bound, "relative");
    }
}

/// 0 if all are numbers.
fn finite(mut values: impl Iterator<Item = f32>) -> f64 {
    if values.all(f32::is_finite) { 0.0 } else { f64::NAN }
}

/// How far a gradient's product with a direction is from the slope of the loss along it, relative
/// to the root of the sum of the squares of its terms.
fn along<'a>(parts: impl Iterator<Item = (&'a f32, &'a f32)>, loss: &dyn Fn(f64) -> f64, h: f64) -> f64 {
    let (mut sum, mut squares) = (0.0, 0.0);
    for (g, d) in parts {
        let term = *g as f64 * *d as f64;
        (sum, squares) = (sum + term, squares + term * term);
    }
    ((loss(h) - loss(-h)) / (2.0 * h) - sum).abs() / squares.sqrt()
}

/// TensoRF: densities, rays and their gradients, thin as air to hard as rock.
fn radiance(cases: &mut Cases) {
    for (name, softplus, scale, bound) in [
        ("thin", false, 1e-3, 2e-2),
        ("usual", false, 0.4, 1e-5),
        ("hard", false, 30.0, 1e-5),
        ("softplus", true, 1.0, 1e-5),
        ("softplus, hard", true, 30.0, 1e-5),
    ] {
        let decoder = DecoderShape {
            channels: 12,
            features: 9,
            hidden: 16,
            view_frequencies: 2,
            feature_frequencies: 2,
        };
        let lattice = Lattice {
            min: [-1.0, -0.8, -0.6],
            max: [1.0, 0.8, 0.6],
            step: 0.05,
            samples: 100,
            near: 0.0,
            far: 9.0,
        };
        let shading = Shading {
            softplus,
            shift: -3.0,
            distance_scale: 25.0,
            weight_threshold: 0.0,
            stop: 0.0,
            group_weight: 0.0,
        };
        let grid = |rank| Grid { size: [9, 8, 7], rank };
        let (density, color) = (grid([4, 3, 5]), grid([6, 2, 4]));
        let f = VmField { density, color, decoder, lattice, shading, mask: None };
        let of_density: Vec<f32> =
            normals(7, f.density.len(), scale).iter().map(|v| v + 0.3 * scale).collect();
        let (of_color, network) = (normals(8, f.color.len(), 0.7), normals(9, f.decoder.len(), 0.4));
        let x: Vec<[f32; 3]> = points(1000, 1.0).iter().map(|p| [p[0], 0.8 * p[1], 0.6 * p[2]]).collect();
        let wide_density = wide(&of_density);
        let want: Vec<f64> =
            x.iter().map(|p| reference::vm::density(&f, &wide_density, p.map(f64::from))).collect();
        let size = worst(want.iter().copied());
        let got = vm::density_at(&f, &of_density, &x);
        cases.add(format!("radiance field, {name}: density"), relative(got, &want, size), 1e-5, "relative");
        let (rays, jitter): (Vec<Ray>, Vec<f32>) = (0..40)
            .map(|i| {
                let u = |k: u64| rng::uniform(56, k, i) - 0.5;
                (Ray::new([u(0), u(1), 2.5], [0.4 * u(2), 0.4 * u(3), -1.0]), u(4) + 0.5)
            })
            .unzip();
        let weights = DecoderWeights::new(f.decoder, &network);
        let rendered = vm::render(&f, &of_density, &of_color, &weights, &rays, &jitter);
        let flat = wide(&[&of_density[..], &of_color, &network].concat());
        let want = reference::vm::render(&f, &flat, &rays, &jitter);
        let got = rendered.out.clone();
        cases.add(format!("radiance field, {name}: rays"), relative(got, &want, 1.0), 2e-5, "absolute");
        let g = normals(10, want.len(), 1.0);
        let (mut by_density, mut by_color) = (vec![0.0; of_density.len()], vec![0.0; of_color.len()]);
        let by_network =
            vm::backward(&f, &of_density, &weights, rendered, &g, &mut by_density, &mut by_color);
        let gradient = [by_density, by_color, by_network].concat();
        let toward = normals(11, flat.len(), 1.0);
        let loss = |h: f64| -> f64 {
            let moved: Vec<f64> = flat.iter().zip(&toward).map(|(v, d)| v + h * *d as f64).collect();
            let out = reference::vm::render(&f, &moved, &rays, &jitter);
            out.iter().zip(&g).map(|(o, g)| o * *g as f64).sum()
        };
        let error = along(gradient.iter().zip(&toward), &loss, if scale < 0.01 { 1e-7 } else { 1e-9 });
        // of a thin step 1 − exp(−x) is known to 6e-8, which is a good part of it
        cases.add(format!("radiance field, {name}: backward"), error, bound, "relative");
    }
}

/// A pixel's ray projected again, for lenses of all widths and bends, near and far from the origin.
fn cameras(cases: &mut Cases) {
    let bends = [
        ("no bend", Distortion::default()),
        ("barrel", Distortion { k1: -0.2, k2: 0.05, p1: 1e-3, p2: -2e-3, ..Distortion::default() }),
        ("cushion", Distortion { k1: 0.3, k3: 0.1, p2: 3e-3, ..Distortion::default() }),
    ];
    for (name, distortion) in bends {
        for (lens, focal, far, bound) in [
            // a step of f32 in the direction is 6e-8 · 5.7e5 = 0.03 pixels
            ("0.1 degrees", 5.7e5, 0.0, 0.2),
            ("60 degrees", 870.0, 0.0, 2e-3),
            ("90 degrees", 500.0, 0.0, 2e-3),
            ("60 degrees, 1e4 away", 870.0, 1e4, 2.0),
        ] {
            let rotation = DMat3::from_rotation_y(0.7) * DMat3::from_rotation_x(-0.4);
            let position = DVec3::new(1.0 + far, 2.0 - far, 3.0);
            let (width, height, cx, cy) = (1000, 800, 500.0, 400.0);
            let camera =
                Camera { width, height, fx: focal, fy: 1.01 * focal, cx, cy, distortion, rotation, position };
            let back = |i: u64| {
                let u = |k: u64| rng::uniform(57, k, i);
                let pixel = Vec2::new(1000.0 * u(0), 800.0 * u(1));
                let ray = camera.ray(pixel)?;
                let (back, _) = camera.project(ray.at(1.0 + 2.0 * u(2)))?;
                Some(back.distance(pixel) as f64)
            };
            let error = worst((0..3000).map(|i| back(i).unwrap_or(f64::NAN)));
            cases.add(format!("camera of {lens}, {name}: there and back"), error, bound, "pixels");
        }
        let undone = (0..5000).map(|i| {
            let u = |k: u64| 1.4 * rng::uniform(58, k, i) as f64 - 0.7;
            let (x, y) = (u(0), u(1));
            let (xd, yd) = distortion.apply(x, y);
            distortion.undistort(xd, yd).map_or(f64::NAN, |(a, b)| (a - x).abs() + (b - y).abs())
        });
        cases.add(format!("lens, {name}: undone"), worst(undone), 1e-7, "focal lengths");
    }
}

/// SSIM against its definition, window by window, the means taken away first: for noise, for
/// pictures without contrast, and for such as lie beside the range.
fn pictures(cases: &mut Cases) {
    let drawn = |stream: u64, base: f32, contrast: f32| {
        let mut image = Image::new(20, 18, 3);
        let noise =
            |(i, v): (usize, &mut f32)| *v = base + contrast * (rng::uniform(59, stream, i as u64) - 0.5);
        image.data.iter_mut().enumerate().for_each(noise);
        image
    };
    for (name, a, b) in [
        ("noise", drawn(0, 0.5, 1.0), drawn(1, 0.5, 1.0)),
        ("white with no contrast", drawn(0, 1.0, 1e-6), drawn(1, 1.0, 1e-6)),
        ("black and nothing", Image::new(20, 18, 3), drawn(1, 0.0, 0.0)),
        ("a hundred times too bright", drawn(0, 100.0, 1.0), drawn(1, 100.0, 1.0)),
    ] {
        let (mut sum, mut count) = (0.0, 0.0);
        let weight = |k: usize| (-((k as f64 - 5.0) / 1.5).powi(2) / 2.0).exp();
        let total: f64 = (0..121).map(|k| weight(k % 11) * weight(k / 11)).sum();
        for (c, y, x) in (0..3 * 8 * 10).map(|i| (i % 3, i / 3 % 8, i / 24)) {
            let over = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
                let at =
                    |image: &Image, k: usize| image.pixel((x + k % 11) as u32, (y + k / 11) as u32)[c] as f64;
                (0..121).map(|k| weight(k % 11) * weight(k / 11) / total * f(at(&a, k), at(&b, k))).sum()
            };
            let (ma, mb) = (over(&|p, _| p), over(&|_, q| q));
            let (va, vb) = (over(&|p, _| (p - ma).powi(2)), over(&|_, q| (q - mb).powi(2)));
            let both = over(&|p, q| (p - ma) * (q - mb));
            let (c1, c2) = (1e-4, 9e-4);
            sum += (2.0 * ma * mb + c1) * (2.0 * both + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
            count += 1.0;
        }
        let error = ssim_valid(&a, &b).map_or(f64::NAN, |s| (s - sum / count).abs());
        cases.add(format!("SSIM, {name}: its definition"), error, 1e-8, "absolute");
        let beyond =
            ssim_reflect_map(&a, &b).map_or(f64::NAN, |map| worst(map.iter().map(|s| s.abs() - 1.0)));
        cases.add(format!("SSIM, {name}: beyond 1"), beyond, 1e-9, "absolute");
    }
}
