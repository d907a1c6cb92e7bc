use super::super::Atomics;
use super::super::device::Words;
use super::super::testing::{agree, device, devices, planes};
use super::case_tests::{DeviceCase, NARROW, Shape, capacity, case, on_cpu};
use super::*;
use crate::cpu::reference;
use crate::cpu::vm::losses::{BackgroundMode, MaskTerm};
use crate::cpu::vm::mask::Walk;
use crate::cpu::vm::{Grid, RAY_WIDTH, penalize};
use tiface_base::math::rng;

/// Hidden layers of a wide tile, ranks of any kind, nothing left out. Vectors of the density as
/// [`NARROW`] has them.
const WIDE: Shape = Shape {
    softplus: true,
    hidden: 72,
    density: [5, 7, 6],
    color: [9, 0, 6],
    threshold: 0.0,
    stop: 0.0,
    group_weight: 0.0,
    masked: false,
};

#[test]
fn lattice_points_are_those_of_the_cpu_with_and_without_a_mask() {
    let Some(device) = device() else { return };
    for masked in [true, false] {
        let case = case(Shape { masked, ..NARROW }, 700);
        let on_gpu = DeviceCase::new(&device, &case);
        on_gpu.vm.samples.march(&device, &on_gpu.vm.lattice, &on_gpu.rays);
        let (mut t, mut offsets, mut points) = (vec![], vec![0u32], vec![]);
        for (ray, &jitter) in case.rays.iter().zip(&case.jitter) {
            let mut walk = Walk::new(&case.field.lattice, case.field.mask.as_ref(), ray, jitter);
            t.extend(std::iter::from_fn(|| walk.advance()));
            offsets.push(t.len() as u32);
            points.push(case.field.lattice.points(ray) as u32);
        }
        offsets.extend([t.len() as u32; 3]);
        points.extend([0; 3]);
        println!("{} samples, {} at most", t.len(), on_gpu.vm.samples.t.word_count());
        assert_eq!(device.read::<u32>(&on_gpu.vm.samples.count), [t.len() as u32; 2]);
        assert_eq!(device.read::<u32>(&on_gpu.vm.samples.offsets), offsets);
        assert_eq!(device.read::<u32>(&on_gpu.vm.samples.points), points);
        agree("lattice points", &device.read::<f32>(&on_gpu.vm.samples.t)[..t.len()], &t, 1e-5);
    }
}

#[test]
fn rendered_rays_are_those_of_the_cpu() {
    rendered_like_the_cpu(&[NARROW, Shape { softplus: true, stop: 0.0, ..NARROW }, WIDE]);
}

fn rendered_like_the_cpu(shapes: &[Shape]) {
    let Some(device) = device() else { return };
    for &shape in shapes {
        let case = case(shape, 300);
        let (want, _) = on_cpu(&case);
        let on_gpu = DeviceCase::new(&device, &case);
        let got = on_gpu.render(&device).unwrap();
        let [looked_up, colored, _] = on_gpu.vm.counts().map(|b| device.read::<u32>(b)[0] as u64);
        assert_eq!(colored, want.color_samples);
        assert!(looked_up >= want.density_samples && colored > 1000, "{looked_up} {colored}");
        agree("rendered", &got, &planes::<RAY_WIDTH>(want.out.as_chunks().0, capacity(&case)), 1e-4);
    }
}

#[test]
fn gradients_are_those_of_the_cpu_however_they_are_added() {
    gradients_like_the_cpu(NARROW, devices());
    gradients_like_the_cpu(WIDE, device().into_iter().collect());
}

fn gradients_like_the_cpu(shape: Shape, devices: Vec<Device>) {
    let case = case(shape, 80);
    let (_, want) = on_cpu(&case);
    for device in devices {
        let mut on_gpu = DeviceCase::new(&device, &case);
        on_gpu.render(&device).unwrap();
        let got = on_gpu.gradients(&device).unwrap();
        for (what, (got, want)) in ["density", "color", "decoder"].iter().zip(got.iter().zip(&want)) {
            agree(&format!("{:?} gradient of the {what}", device.atomics()), got, want, 1e-4);
        }
        if device.atomics() == Atomics::Fixed {
            assert_eq!(on_gpu.gradients(&device).unwrap(), got, "whole numbers add to the same in any order");
        }
        // in pieces, and by groups with several tiles of each, the same
        (on_gpu.vm.decoder.chunk, on_gpu.vm.decoder.groups) = (16 * TILE, 3);
        let pieces = on_gpu.gradients(&device).unwrap();
        agree("gradient of the color in pieces", &pieces[1], &got[1], 1e-4);
        agree("gradient of the decoder in pieces", &pieces[2], &got[2], 1e-4);
    }
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; device and CPU are compared in the check, and the CPU with f64"]
fn gradients_are_those_of_the_formulas() {
    gradients_like_the_formulas(&[WIDE, Shape { softplus: false, ..WIDE }]);
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; compiles the decoder for two more widths, and each way to add for wide layers"]
fn decoders_of_other_widths_are_those_of_the_cpu() {
    let (widest, small) = (Shape { hidden: 128, ..WIDE }, Shape { softplus: false, hidden: 32, ..WIDE });
    rendered_like_the_cpu(&[widest, small]);
    gradients_like_the_cpu(WIDE, devices());
    gradients_like_the_cpu(widest, device().into_iter().collect());
    gradients_like_the_formulas(&[small]);
}

fn gradients_like_the_formulas(shapes: &[Shape]) {
    let Some(device) = device() else { return };
    let mut errors = Vec::new();
    for &shape in shapes {
        let case = case(shape, 24);
        let on_gpu = DeviceCase::new(&device, &case);
        on_gpu.render(&device).unwrap();
        let got = on_gpu.gradients(&device).unwrap().concat();
        let x = reference::wide(&[case.density.as_slice(), &case.color, &case.network].concat());
        let want = reference::vm::gradient(&case.field, &x, (&case.rays, &case.jitter), &case.g);
        let largest = got.iter().fold(0f32, |m, g| m.max(g.abs())) as f64;
        for k in 0..150 {
            let i = rng::below(1, 6, k, x.len() as u64) as usize;
            errors.push((got[i] as f64 - want[i]).abs() / want[i].abs().max(1e-2 * largest));
        }
    }
    errors.sort_by(f64::total_cmp);
    let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!("{} gradients: worst {worst:.2e}, median {median:.2e}", errors.len());
    assert!(worst <= 1e-3 && median <= 1e-5, "worst {worst:.2e}, median {median:.2e}");
}

#[test]
fn penalties_are_those_of_the_cpu() {
    let Some(device) = device() else { return };
    for rank in [[8, 7, 5], [9, 0, 6]] {
        let grid = Grid { size: [5, 8, 6], rank };
        let normal =
            |stream: u64| -> Vec<f32> { (0..grid.len() as u64).map(|i| rng::normal(7, stream, i)).collect() };
        let (x, before) = (normal(1), normal(2));
        for weight in [0.7, 0.0] {
            let mut want = before.clone();
            penalize(&grid, weight, &x, &mut want);
            let on = DeviceGrid::new(&device, grid);
            let (values, gradient) = (on.upload(&device, &x), on.upload(&device, &before));
            on.penalize(&device, &values, weight, &gradient);
            agree("penalized", &on.cut(device.read(&gradient)), &want, 1e-5);
            assert_eq!(on.cut(device.read(&values)), x);
        }
    }
}

/// Losses of rays in f64, unweighted: squared error, mask, squared opacity of the background.
fn losses(shown: &Shown, composed: &[f64], term: MaskTerm, mode: BackgroundMode) -> [f64; 3] {
    let n = shown.alpha.len();
    let alive = |r: &usize| shown.alive[*r] == 1;
    let outside = (0..n).filter(alive).filter(|&r| shown.alpha[r] == 0.0).count() as f64;
    let rays = (0..n).filter(alive).count() as f64;
    let mut t = [0f64; 3];
    for r in (0..n).filter(alive) {
        let (o, a) = (composed[3 * n + r], shown.alpha[r] as f64);
        for c in 0..3 {
            let b = shown.background[c * n + r] as f64;
            let seen = composed[c * n + r] + (1.0 - o) * (b + mode.lift as f64);
            let over = if mode.target { (1.0 - a) * b } else { 0.0 };
            t[0] += (seen.clamp(0.0, 1.0) - shown.color[c * n + r] as f64 - over).powi(2) / (3.0 * rays);
        }
        let p = o.clamp(1e-3, 1.0 - 1e-3);
        t[2] += if a == 0.0 { o * o / outside } else { 0.0 };
        if let MaskTerm::Ce(_) = term {
            t[1] -= if a > 0.0 { p.ln() } else { (1.0 - p).ln() } / rays;
        }
    }
    if let MaskTerm::L2(_) = term {
        t[1] = t[2];
    }
    t
}

/// What pixels show.
struct Shown {
    color: Vec<f32>,
    alpha: Vec<f32>,
    background: Vec<f32>,
    alive: Vec<u32>,
}

#[test]
fn losses_and_gradients_agree_with_f64_finite_differences() {
    let Some(device) = device() else { return };
    const N: usize = 40;
    let drawn = |stream: u64, n: usize, low: f32, high: f32| -> Vec<f32> {
        (0..n as u64).map(|i| low + (high - low) * rng::uniform(8, stream, i)).collect()
    };
    let alpha: Vec<f32> = (0..N).map(|r| [0.0, 1.0, 0.4][r % 3]).collect();
    let alive: Vec<u32> = (0..N).map(|r| u32::from(r % 7 != 3)).collect();
    let shown =
        Shown { color: drawn(1, 3 * N, 0.0, 1.0), alpha, background: drawn(2, 3 * N, 0.0, 1.0), alive };
    // some colors and opacities leave their range
    let composed = [drawn(3, 3 * N, -0.3, 1.1), drawn(4, N, 0.0, 1.0), drawn(5, N, 0.0, 3.0)].concat();
    let batch = DeviceBatch {
        color: device.upload(&shown.color),
        alpha: device.upload(&shown.alpha),
        background: device.upload(&shown.background),
        alive: device.upload(&shown.alive),
        ..DeviceBatch::new(&device, N)
    };
    let vm = Vm::new(&device, &case(NARROW, 1).field, N, false);
    for (term, lift, target) in
        [(MaskTerm::L2(0.3), 0.0, true), (MaskTerm::Ce(0.2), 1.0, false), (MaskTerm::None, 0.5, true)]
    {
        let mode = BackgroundMode { lift, target };
        let mut on = VmLosses::new(&device, N, term);
        let g = on.of_rays(&device, &device.upload(&composed), &batch, mode);
        let got = device.read::<f32>(g);
        let wide = reference::wide(&composed);
        let want = losses(&shown, &wide, term, mode);
        on.add(&device, &vm, &device.upload(&[0u32]));
        on.add(&device, &vm, &device.upload(&[1u32]));
        let figures = on.fetch(&device).unwrap();
        agree("losses", &figures.terms, &want.map(|t| 2.0 * t as f32), 1e-5);
        assert_eq!((figures.rays, figures.non_finite), (2 * 34, true));
        on.reset_totals(&device);
        assert_eq!(on.fetch(&device).unwrap().terms, [0.0; 3]);
        let total = |x: &[f64]| {
            let t = losses(&shown, x, term, mode);
            t[0] + match term {
                MaskTerm::None => 0.0,
                MaskTerm::L2(w) | MaskTerm::Ce(w) => w as f64 * t[1],
            }
        };
        let slope = |i: usize| {
            let mut x = wide.clone();
            x[i] += 1e-7;
            let up = total(&x);
            x[i] -= 2e-7;
            ((up - total(&x)) / 2e-7) as f32
        };
        agree("gradients", &got, &(0..5 * N).map(slope).collect::<Vec<_>>(), 1e-4);
    }
}
