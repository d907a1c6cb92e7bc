//! Published checkpoints: files that torch wrote (tools/reference/tensorf_checkpoint.py), read here, and packed
//! otherwise.

mod zips;

use std::path::Path;
use std::sync::Arc;
use tiface::io::{self, Limits, TorchNumbers, TorchTensor, TorchValue};
use tiface::tface::th::{self, VmCheckpoint};

fn reference(name: &str) -> std::path::PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/reference").join(name)
}

fn fixture() -> VmCheckpoint {
    th::read_th(&reference("vm_g5.th"), &Limits::default()).unwrap()
}

fn same(found: &[f32], expected: impl Fn(usize) -> f64, count: usize, name: &str) {
    assert_eq!(found.len(), count, "{name}");
    for (i, &x) in found.iter().enumerate() {
        // half a step of f32 where two machines' sines differ in their last bit of f64; lines are exact
        let e = expected(i) as f32;
        assert!(x == e || (name.contains("sine") && (x - e).abs() <= 1.2e-7), "{name}[{i}]: {x} {e}");
    }
}

#[test]
fn a_file_written_by_torch_holds_what_the_formulas_say() {
    let vm = fixture();
    assert_eq!(vm.aabb, [[-1.5, -1.67, -1.0], [1.5, 1.67, 1.0]]);
    assert_eq!((vm.density_grid.size, vm.color_grid.size), ([5, 6, 7], [5, 6, 7]));
    assert_eq!((vm.density_grid.rank, vm.color_grid.rank), ([2, 1, 1], [2, 1, 1]));
    assert_eq!((vm.decoder.features, vm.decoder.hidden, vm.decoder.inputs()), (27, 128, 30));
    let shading = vm.shading;
    assert_eq!((shading.shift, vm.alpha_mask_threshold, shading.weight_threshold), (-10.0, 1e-4, 1e-4));
    assert_eq!((shading.distance_scale, vm.step_ratio, vm.near_far), (25.0, 0.5, [3.5, 7.0]));
    assert!(!shading.softplus);
    assert_eq!((vm.decoder.view_frequencies, vm.decoder.feature_frequencies), (0, 0));
    for i in 0..3 {
        let (rank, i1) = ([2, 1, 1][i], i as f64 + 1.0);
        // widths x x y, heights y z z, lines z y x
        let (width, height, line) = ([5, 5, 6][i], [6, 7, 7][i], [7, 6, 5][i]);
        let count = rank * width * height;
        let chw = |n: usize| {
            let (c, h, w) = (n / (width * height), n / width % height, n % width);
            (c as f64 + 1.0, h as f64, w as f64)
        };
        let ck = |n: usize| ((n / line) as f64 + 1.0, (n % line) as f64);
        let plane = |n| {
            let (c, h, w) = chw(n);
            0.1 * c * i1 + 0.03 * h + 0.01 * w
        };
        same(&vm.density[i], plane, count, "density plane");
        let plane = |n| {
            let (c, h, w) = chw(n);
            0.2 * c * i1 - 0.02 * h + 0.05 * w
        };
        same(&vm.color[i], plane, count, "color plane");
        same(&vm.density[3 + i], |n| 0.2 * ck(n).0 - 0.02 * ck(n).1 * i1, rank * line, "density line");
        same(&vm.color[3 + i], |n| 0.3 * ck(n).0 - 0.01 * ck(n).1 * i1, rank * line, "color line");
    }
    let sine =
        |n: usize, columns: usize| (0.7 * (n / columns) as f64 + 1.3 * (n % columns) as f64 + 1.0).sin();
    let mut rest = &vm.network[..];
    let mut next = |count: usize| rest.split_off(..count).unwrap();
    same(next(27 * 4), |n| 2.0 * sine(n, 4), 27 * 4, "basis, a sine");
    for (rows, columns) in [(128, 30), (128, 128), (3, 128)] {
        same(next(rows * columns), |n| 0.4 * sine(n, columns), rows * columns, "weight, a sine");
        same(next(rows), |n| 0.01 * (n as f64).cos(), rows, "bias, a sine");
    }
    assert!(rest.is_empty());
    let mask = vm.mask.unwrap();
    assert_eq!((mask.shape, mask.aabb), ([4, 3, 5], [[-1.2, -1.4, -0.9], [1.4, 1.5, 0.8]]));
    for (i, &occupied) in mask.occupied.iter().enumerate() {
        let (z, y, x) = (i / 15, i / 5 % 3, i % 5);
        assert_eq!(occupied, z >= 2 && (x + y) % 3 != 0, "{z} {y} {x}");
    }
}

/// Σ plane · line at `u`, from the layout the checkpoint documents.
fn density_feature(vm: &VmCheckpoint, u: [f64; 3]) -> f64 {
    let nodes = |axis: usize| {
        let n = vm.density_grid.size[axis];
        let x = (u[axis] + 1.0) / 2.0 * (n - 1) as f64;
        let low = (x as usize).min(n - 2);
        [(low, 1.0 - (x - low as f64)), (low + 1, x - low as f64)]
    };
    let mut sum = 0.0;
    for (i, [width, height, line]) in [[0, 1, 2], [0, 2, 1], [1, 2, 0]].into_iter().enumerate() {
        let [w, h, n] = [width, height, line].map(|axis| vm.density_grid.size[axis]);
        for c in 0..vm.density_grid.rank[i] {
            let mut on_plane = 0.0;
            for (y, wy) in nodes(height) {
                for (x, wx) in nodes(width) {
                    on_plane += wy * wx * vm.density[i][(c * h + y) * w + x] as f64;
                }
            }
            let on_line: f64 =
                nodes(line).iter().map(|&(k, wk)| wk * vm.density[3 + i][c * n + k] as f64).sum();
            sum += on_plane * on_line;
        }
    }
    sum
}

#[test]
fn planes_and_lines_lie_along_the_axes_the_published_code_gives_them() {
    let vm = fixture();
    // golden values of the published arithmetic, computed apart from this crate
    for (u, golden) in [
        ([0.0, 0.0, 0.0], 0.1918000),
        ([0.25, -0.5, 0.75], 0.1737500),
        ([-0.9, 0.3, -0.1], 0.2303020),
        ([1.0, 1.0, 1.0], 0.1112000),
    ] {
        assert!((density_feature(&vm, u) - golden).abs() < 1e-7, "{u:?}");
    }
    let json = io::read_json(&reference("vm_g5.json"), &Limits::default()).unwrap();
    for point in json["points"].as_array().unwrap() {
        let u = [0, 1, 2].map(|axis| point["normalized"][axis].as_f64().unwrap());
        let expected = point["density_feature"].as_f64().unwrap();
        assert!((density_feature(&vm, u) - expected).abs() < 1e-9, "{u:?}");
    }
}

#[test]
fn a_checkpoint_packed_again_with_compression_reads_alike() {
    let bytes = std::fs::read(reference("vm_g5.th")).unwrap();
    let entries = zips::entries(&bytes);
    let packed = zips::deflated(&entries);
    assert!(packed.len() < bytes.len());
    let vm = th::from_bytes(&packed, Path::new("packed.th"), &Limits::default()).unwrap();
    assert_eq!(vm, fixture());
    // and under any name of its folder, or none
    for root in ["some/where/", ""] {
        let moved: Vec<_> = entries.iter().map(|(n, d)| (n.replace("vm_g5/", root), d.clone())).collect();
        let moved = th::from_bytes(&zips::stored(&moved), Path::new("moved.th"), &Limits::default());
        assert_eq!(moved.unwrap(), fixture());
    }
}

#[test]
fn every_kind_of_value_is_read_in_every_protocol_torch_offers() {
    let floats = |shape: &[usize], values: &[f32]| TorchTensor {
        shape: shape.into(),
        values: TorchNumbers::F32(values.into()),
    };
    let longs = |values: &[i64]| TorchTensor { shape: vec![2, 3], values: TorchNumbers::I64(values.into()) };
    let count = floats(&[2, 3], &[0., 1., 2., 3., 4., 5.]);
    let tensor = |t: TorchTensor| TorchValue::Tensor(Arc::new(t));
    let array = |t: TorchTensor| TorchValue::Array(Arc::new(t));
    for protocol in 2..=5 {
        let path = reference(&format!("kinds_{protocol}.pt"));
        let root = io::read_torch(&path, &Limits::default()).unwrap();
        let is = |key: &str, expected: TorchValue| {
            assert_eq!(root.get(key), Some(&expected), "`{key}` in protocol {protocol}");
        };
        is("transposed", tensor(floats(&[3, 2], &[0., 3., 1., 4., 2., 5.])));
        is("every second", tensor(floats(&[3], &[1., 3., 5.])));
        is("parameter", tensor(count.clone()));
        is("expanded", tensor(floats(&[3, 2], &[0., 0., 1., 1., 2., 2.])));
        is("same", TorchValue::List(vec![tensor(count.clone()); 2]));
        is("half", tensor(count.clone()));
        is("double", tensor(count.clone()));
        is("long", tensor(longs(&[0, 1, 2, 3, 4, 5])));
        is("int", tensor(longs(&[0, -1, -2, -3, -4, -5])));
        let byte = TorchNumbers::U8(vec![0, 1, 2, 3, 4, 5]);
        is("byte", tensor(TorchTensor { shape: vec![2, 3], values: byte }));
        let bools = TorchNumbers::Bool(vec![false, false, false, true, true, true]);
        is("bool", tensor(TorchTensor { shape: vec![2, 3], values: bools }));
        is("scalar", tensor(floats(&[], &[2.5])));
        is("none at all", tensor(floats(&[0, 3], &[])));
        is("size", TorchValue::Tuple(vec![TorchValue::Int(2), TorchValue::Int(3)]));
        is("numpy", array(longs(&[0, 1, 2, 3, 4, 5])));
        is("fortran", array(count.clone()));
        let bytes = TorchNumbers::U8(vec![250, 251, 252, 253, 254, 255]);
        is("bytes", array(TorchTensor { shape: vec![6], values: bytes }));
        is("number", TorchValue::Float(0.1));
        is("integer", TorchValue::Int(-7));
        let plain = [TorchValue::None, TorchValue::Bool(true), TorchValue::Bool(false)].into_iter();
        let plain = plain.chain([-1, 300, 70000, -(1i64 << 40)].map(TorchValue::Int)).chain([
            TorchValue::Float(0.1),
            TorchValue::Str("häd".into()),
            TorchValue::Tuple(vec![]),
            TorchValue::Tuple(vec![TorchValue::Int(1)]),
            TorchValue::Dict(vec![("a".into(), TorchValue::Dict(vec![]))]),
        ]);
        is("plain", TorchValue::List(plain.collect()));
    }
}
