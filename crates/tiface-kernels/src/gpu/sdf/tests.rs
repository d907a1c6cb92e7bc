use super::super::case_tests::Case;
use super::super::testing::{agree, device, devices, planes};
use super::*;
use crate::cpu::mlp::Weights;
use crate::cpu::sdf;

const SAMPLES: usize = 1000;
const CAPACITY: usize = 1088; // one tile more than the samples fill

fn case(levels: usize, color_skip: bool, active: usize) -> Case {
    Case::new(SAMPLES, levels, color_skip, active)
}

#[test]
fn the_field_and_its_gradients_are_those_of_the_cpu() {
    agrees_with_the_cpu((5, true, 4), devices());
    // more features than a tile has columns
    agrees_with_the_cpu((14, true, 14), device().into_iter().collect());
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; compiles the published field, and its sums for each way to add"]
fn the_published_field_and_its_gradients_are_those_of_the_cpu() {
    agrees_with_the_cpu((16, false, 16), devices());
}

/// Compares a field with so many levels, with or without the color skip, of which so many levels
/// are active.
fn agrees_with_the_cpu((levels, skip, active): (usize, bool, usize), devices: Vec<Device>) {
    let Case { shape, table, flat, x, direction, g_out } = case(levels, skip, active);
    let weights = Weights::new(shape.layout(), &flat);
    let a = sdf::forward(&shape, &table, &weights, &x, &direction);
    let mut g_table = vec![[0f32; 2]; table.len()];
    let g_flat = sdf::backward(&a, &weights, g_out.as_flattened(), &mut g_table);
    for device in devices {
        let name = |what: &str| format!("{what}, {levels} levels, skip {skip}, {:?}", device.atomics());
        let mut on = Sdf::new(&device, &shape, CAPACITY);
        on.activate(active);
        let [x, direction] = [&x, &direction].map(|v| device.upload(&planes(v, CAPACITY)));
        let (table, flat) = (device.upload(table.as_flattened()), device.upload(&flat));
        let count = device.upload(&[SAMPLES as u32]);
        let out = device.read::<f32>(on.forward(&device, &table, &flat, &x, &direction, &count));
        let rows: &[[f32; WIDTH]] = a.output().as_chunks().0;
        for k in 0..WIDTH {
            let want: Vec<f32> = rows.iter().map(|r| r[k]).collect();
            agree(&name(&format!("output {k}")), &out[k * CAPACITY..][..SAMPLES], &want, 1e-4);
        }
        let mut g_planes = planes(&g_out, CAPACITY);
        // behind the last sample nothing counts
        (0..WIDTH).for_each(|k| g_planes[k * CAPACITY + SAMPLES] = f32::NAN);
        let got_table = device.zeros::<f32>(2 * g_table.len());
        let got_flat = device.zeros::<f32>(g_flat.len());
        on.backward(&device, &x, &direction, &count, &device.upload(&g_planes), &got_table, &got_flat);
        let mut start = 0;
        for (o, i) in shape.layout().shapes() {
            let span = start..start + o * i;
            start += o * i;
            agree(&name("weights"), &device.read::<f32>(&got_flat)[span.clone()], &g_flat[span], 1e-4);
        }
        agree(&name("table"), &device.read::<f32>(&got_table), g_table.as_flattened(), 1e-4);
    }
}

#[test]
#[ignore = "long: run by `tools/test.sh all`; device and CPU are compared in the check, and the CPU with f64"]
fn the_gradients_are_those_of_the_model_second_order_included() {
    for skip in [false, true] {
        let Some(device) = device() else { return };
        sdf::tests::backward_agrees(skip, |case| {
            let capacity = case.x.len().next_multiple_of(TILE);
            let on = Sdf::new(&device, case.shape, capacity);
            let [x, direction] = [case.x, case.direction].map(|v| device.upload(&planes(v, capacity)));
            let (table, flat) = (device.upload(case.table.as_flattened()), device.upload(case.flat));
            let count = device.upload(&[case.x.len() as u32]);
            on.forward(&device, &table, &flat, &x, &direction, &count);
            let g_out = device.upload(&planes(case.g_out.as_chunks::<WIDTH>().0, capacity));
            let g_table = device.zeros::<f32>(2 * case.table.len());
            let g_flat = device.zeros::<f32>(case.flat.len());
            on.backward(&device, &x, &direction, &count, &g_out, &g_table, &g_flat);
            (device.read(&g_flat), device.read::<f32>(&g_table).as_chunks().0.to_vec())
        });
    }
}

#[test]
fn no_samples_give_no_gradient() {
    let Some(device) = device() else { return };
    let Case { shape, table, flat, x, direction, g_out } = case(5, true, 5);
    let on = Sdf::new(&device, &shape, CAPACITY);
    let [x, direction] = [&x, &direction].map(|v| device.upload(&planes(v, CAPACITY)));
    let (entries, floats) = (table.len(), flat.len());
    let (table, flat, count) =
        (device.upload(table.as_flattened()), device.upload(&flat), device.upload(&[0u32]));
    on.forward(&device, &table, &flat, &x, &direction, &count);
    let (g_table, g_flat) = (device.zeros::<f32>(2 * entries), device.upload(&vec![1f32; floats]));
    let g_out = device.upload(&planes(&g_out, CAPACITY));
    on.backward(&device, &x, &direction, &count, &g_out, &g_table, &g_flat);
    let zero = |b: &Buffer| device.read::<f32>(b).iter().all(|&v| v == 0.0);
    assert!(zero(&g_table) && zero(&g_flat));
    let (launches, readbacks) = device.counts();
    println!("{launches} launches and {readbacks} readbacks of a field, forward and backward");
}

#[test]
fn the_gradients_are_those_of_the_cpu_where_groups_sum_over_several_tiles() {
    let Some(device) = device() else { return };
    let Case { shape, table, flat, x, direction, g_out } = case(5, true, 5);
    let weights = Weights::new(shape.layout(), &flat);
    let a = sdf::forward(&shape, &table, &weights, &x, &direction);
    let mut g_table = vec![[0f32; 2]; table.len()];
    let want = sdf::backward(&a, &weights, g_out.as_flattened(), &mut g_table);
    let mut on = Sdf::new(&device, &shape, CAPACITY);
    // five or six of sixteen tiles for each
    on.summing = 3;
    let [x, direction] = [&x, &direction].map(|v| device.upload(&planes(v, CAPACITY)));
    let (table, flat) = (device.upload(table.as_flattened()), device.upload(&flat));
    let count = device.upload(&[SAMPLES as u32]);
    on.forward(&device, &table, &flat, &x, &direction, &count);
    let (got_table, got) = (device.zeros::<f32>(2 * g_table.len()), device.zeros::<f32>(want.len()));
    on.backward(&device, &x, &direction, &count, &device.upload(&planes(&g_out, CAPACITY)), &got_table, &got);
    agree("weights", &device.read::<f32>(&got), &want, 1e-4);
    agree("table", &device.read::<f32>(&got_table), g_table.as_flattened(), 1e-4);
}

#[test]
fn partial_gradients_of_a_thousand_groups_are_added_whatever_the_number_of_samples() {
    let Some(device) = device() else { return };
    let (size, tile, summing) = (300, 64, 1000);
    let partial: Vec<f32> =
        (0..size * summing).map(|i| tiface_base::math::rng::normal(1, 2, i as u64)).collect();
    let map: Vec<u32> = (0..200).map(|i| i * 7 % 300).collect();
    for samples in [0usize, 1, 64 * 33, 64 * 999 + 1, 64 * 5000] {
        let groups = samples.div_ceil(tile).min(summing);
        let sum = |i: usize| (0..groups).map(|g| f64::from(partial[g * size + i])).sum::<f64>() as f32;
        let count = device.upload(&[samples as u32]);
        for mapped in [true, false] {
            let want: Vec<f32> = match mapped {
                true => map.iter().map(|&i| sum(i as usize)).collect(),
                false => (0..size).map(sum).collect(),
            };
            let (flat, map) = (device.upload(&vec![1f32; want.len()]), device.upload(&map));
            let (own, map) = (device.upload(&partial), mapped.then_some(&map));
            kernels::sum_groups(&device, &own, map, &count, &flat, (size, tile, summing));
            agree("sums of groups", &device.read::<f32>(&flat), &want, 1e-5);
        }
    }
}
