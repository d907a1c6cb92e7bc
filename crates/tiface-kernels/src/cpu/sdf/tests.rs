//! Tests of the fused field against a model of its formulas in f64, and against the model's
//! gradients.

use super::*;
use crate::cpu::reference::sdf::field as model;
use crate::cpu::reference::tape::{Var, gradient};
use crate::cpu::reference::{Real, wide};

/// Returns shape, table and weights of a small field, with weights that vary strongly.
fn field() -> (FieldShape, Vec<[f32; 2]>, Vec<f32>) {
    small_field(false)
}

/// Returns the small field with or without the color skip; with it, the sharpness is local.
fn small_field(color_skip: bool) -> (FieldShape, Vec<[f32; 2]>, Vec<f32>) {
    let levels = hash::levels(5, 4, 1.8, 9);
    let shape =
        FieldShape { levels, radius: 1.3, active: 5, color_skip, soften: if color_skip { 1.5 } else { 0.0 } };
    let table = (0..hash::entries(&shape.levels))
        .map(|i| [(i as f32 * 0.731).sin() * 0.4, (i as f32 * 0.317).cos() * 0.4])
        .collect();
    let flat = (0..shape.layout().len())
        .map(|i| ((i as f32 * 0.619).sin() + (i as f32 * 0.137).cos()) * 0.13)
        .collect();
    (shape, table, flat)
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    glam::Vec3::from(v).normalize().to_array()
}

fn points(n: usize) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let at = |i: usize, k: f32| ((i as f32 + 0.37) * k).sin();
    let x = (0..n).map(|i| [at(i, 1.7), at(i, 2.9), at(i, 0.83)]).collect();
    let d = (0..n).map(|i| unit([at(i, 0.7), at(i, 1.1) + 0.2, at(i, 2.3)])).collect();
    (x, d)
}

#[test]
fn the_activation_gives_the_published_values() {
    // reference values of softplus with β = 100 at four places
    let golden = [(-0.05, 6.715348e-5), (0.0, 0.0069314718), (0.01, 0.0131326169), (0.3, 0.3)];
    let (mut z, mut s) = ([0f32; HIDDEN], [0f32; HIDDEN]);
    golden.iter().zip(&mut z).for_each(|((place, _), z)| *z = *place);
    activate::<true>(&mut z, &mut s, &[0.0; HIDDEN], &[1.0; HIDDEN]);
    for ((place, want), got) in golden.iter().zip(z) {
        assert!((got - want).abs() < 2e-9 + 2e-7 * want, "{place}: {got} {want}");
    }
}

#[test]
fn the_forward_agrees_with_an_f64_model() {
    for skip in [false, true] {
        forward_agrees(skip);
    }
}

fn forward_agrees(color_skip: bool) {
    let (shape, table, flat) = small_field(color_skip);
    let (x, d) = points(150); // two full tiles and a part
    let w = Weights::new(shape.layout(), &flat);
    let a = forward(&shape, &table, &w, &x, &d);
    let table64: Vec<[f64; 2]> = table.iter().map(|e| [e[0] as f64, e[1] as f64]).collect();
    let flat64 = wide(&flat);
    let sdf = values(&shape, &table, &w, &x);
    let soft = softness(&shape, &table, &w, &x);
    let normals = gradients(&shape, &table, &w, &x);
    let units: Vec<[f32; 3]> = normals.iter().map(|n| unit(n.1)).collect();
    let colors = colors(&shape, &table, &w, &x, &units, None, &d);
    for i in 0..x.len() {
        let want = model(&shape, &table64, &flat64, x[i], d[i]);
        for k in 0..8 {
            let got = a.output()[i * WIDTH + k] as f64;
            assert!((got - want[k]).abs() < 2e-4 * want[k].abs().max(1.0), "{i} {k}: {got} {}", want[k]);
        }
        assert!(colors[i].iter().zip(&a.output()[i * WIDTH + 4..]).all(|(c, o)| (c - o).abs() < 1e-5));
        assert!((sdf[i] - a.output()[i * WIDTH]).abs() < 1e-5);
        assert!((soft[i] - a.output()[i * WIDTH + 7]).abs() < 1e-5);
        assert_eq!(normals[i].1, [1, 2, 3].map(|k| a.output()[i * WIDTH + k]));
    }
}

#[test]
fn colors_of_some_samples_are_those_of_all() {
    let (shape, table, flat) = small_field(true);
    // two chunks, of which the first has fewer of these than the second
    let (x, d) = points(CHUNK + 150);
    let w = Weights::new(shape.layout(), &flat);
    let all = forward(&shape, &table, &w, &x, &d);
    let some = |i: &usize| i.is_multiple_of(if *i < CHUNK { 11 } else { 2 });
    let mut a = geometry(&shape, &table, &w, &x);
    a.shade(&w, (0..x.len()).filter(some).map(|i| i as u32).collect(), &d);
    let before = geometry(&shape, &table, &w, &x);
    for i in 0..x.len() {
        let of = |a: &Activations| a.output()[i * WIDTH..][..WIDTH].to_vec();
        assert_eq!(of(&a), if some(&i) { of(&all) } else { of(&before) }, "{i}");
    }
}

#[test]
fn levels_that_are_not_active_read_as_zero() {
    let (shape, mut table, flat) = field();
    let (x, d) = points(70);
    let w = Weights::new(shape.layout(), &flat);
    let part = FieldShape { active: 3, ..shape.clone() };
    let got = forward(&part, &table, &w, &x, &d);
    table[shape.levels[3].offset..].fill([0.0; 2]);
    let want = forward(&shape, &table, &w, &x, &d);
    for (a, b) in got.output().iter().zip(want.output()) {
        assert!((a - b).abs() < 1e-6);
    }
}

#[test]
fn the_backward_agrees_with_the_gradients_of_the_model_second_order_included() {
    for skip in [false, true] {
        backward_agrees(skip, |case| {
            let w = Weights::new(case.shape.layout(), case.flat);
            let a = forward(case.shape, case.table, &w, case.x, case.direction);
            let mut g_table = vec![[0f32; 2]; case.table.len()];
            (backward(&a, &w, case.g_out, &mut g_table), g_table)
        });
    }
}

/// Arguments of a backward pass: it returns the gradients by weights and table of a loss whose
/// gradient by the output is `g_out`.
pub(crate) struct BackwardCase<'a> {
    pub shape: &'a FieldShape,
    pub table: &'a [[f32; 2]],
    pub flat: &'a [f32],
    pub x: &'a [[f32; 3]],
    pub direction: &'a [[f32; 3]],
    pub g_out: &'a [f32],
}

/// Asserts that worst and median relative errors of the gradients by all parameters are small.
pub(crate) fn backward_agrees(
    color_skip: bool,
    gradients: impl FnOnce(BackwardCase) -> (Vec<f32>, Vec<[f32; 2]>),
) {
    let (shape, table, flat) = small_field(color_skip);
    let (x, d) = points(90);
    let w = Weights::new(shape.layout(), &flat);
    let a = forward(&shape, &table, &w, &x, &d);
    // loss = Σ g·out + 0.1 Σ (‖n‖ − 1)²: every output and the eikonal path
    let g: Vec<f64> = (0..x.len() * 8).map(|i| (i as f64 * 0.77).sin()).collect();
    let mut g_out = vec![0f32; x.len() * WIDTH];
    for i in 0..x.len() {
        let o = &a.output()[i * WIDTH..][..WIDTH];
        let len = (o[1] * o[1] + o[2] * o[2] + o[3] * o[3]).sqrt();
        for k in 0..8 {
            g_out[i * WIDTH + k] = g[i * 8 + k] as f32;
            if (1..4).contains(&k) {
                g_out[i * WIDTH + k] += 0.2 * (len - 1.0) / len * o[k];
            }
        }
    }
    let (g_flat, g_table) = gradients(BackwardCase {
        shape: &shape,
        table: &table,
        flat: &flat,
        x: &x,
        direction: &d,
        g_out: &g_out,
    });

    let inputs = [wide(table.as_flattened()), wide(&flat)].concat();
    let (_, slopes) = gradient(&inputs, |inputs| {
        let (table, flat) = inputs.split_at(2 * table.len());
        let loss = |i: usize| {
            let o = model(&shape, table.as_chunks::<2>().0, flat, x[i], d[i]);
            let off = (o[1] * o[1] + o[2] * o[2] + o[3] * o[3]).sqrt() - Var::of(1.0);
            (0..8).map(|k| o[k] * Var::of(g[i * 8 + k])).sum::<Var>() + off * off * Var::of(0.1)
        };
        (0..x.len()).map(loss).sum()
    });
    let (of_table, of_weights) = slopes.split_at(2 * table.len());
    let mut errors = Vec::new();
    for (got, want) in [(g_table.as_flattened(), of_table), (&g_flat[..], of_weights)] {
        let scale = f64::from(got.iter().fold(0f32, |m, v| m.max(v.abs())));
        // entries of the table that no point touches have no slope
        let touched = got.iter().zip(want).filter(|(got, want)| **got != 0.0 || **want != 0.0);
        let error = |(got, want): (&f32, &f64)| (want - f64::from(*got)).abs() / want.abs().max(1e-3 * scale);
        errors.extend(touched.map(error));
    }
    errors.sort_by(f64::total_cmp);
    let (median, worst) = (errors[errors.len() / 2], errors[errors.len() - 1]);
    println!("{} gradients: median {median:.1e}, worst {worst:.1e}", errors.len());
    assert!(median < 1e-4 && worst < 1e-3, "median {median:.1e}, worst {worst:.1e}");
}

#[test]
fn one_thread_and_many_give_the_same_bytes() {
    let (shape, table, flat) = field();
    let (x, d) = points(5000);
    let w = Weights::new(shape.layout(), &flat);
    let once = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let a = forward(&shape, &table, &w, &x, &d);
            let g_out = a.output().to_vec();
            let mut g = vec![[0f32; 2]; table.len()];
            (backward(&a, &w, &g_out, &mut g), g, g_out)
        })
    };
    assert_eq!(once(1), once(3));
}

#[test]
fn colors_along_many_directions_are_those_of_each() {
    let (shape, table, flat) = field();
    let (x, d) = points(3 * 5000);
    let w = Weights::new(shape.layout(), &flat);
    let normal: Vec<[f32; 3]> = x.iter().map(|&p| unit(p)).collect();
    // 0, 1, 2 or 5 directions of each of the first points, over several chunks and tiles
    let counts: Vec<u32> = (0..4000).map(|i| [0, 1, 2, 5][i % 4]).collect();
    let total: u32 = counts.iter().sum();
    let together =
        colors(&shape, &table, &w, &x[..4000], &normal[..4000], Some(&counts), &d[..total as usize]);
    let repeat = |v: &[[f32; 3]]| -> Vec<[f32; 3]> {
        v.iter().zip(&counts).flat_map(|(v, &n)| std::iter::repeat_n(*v, n as usize)).collect()
    };
    let (px, pn) = (repeat(&x[..4000]), repeat(&normal[..4000]));
    let apart = colors(&shape, &table, &w, &px, &pn, None, &d[..total as usize]);
    assert_eq!(together.len(), 8000);
    assert!(together.iter().zip(&apart).all(|(a, b)| a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6)));
}
