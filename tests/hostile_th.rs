//! Crafted and damaged torch checkpoints: each ends in a named error, nothing in them is ever run, and no
//! memory is reserved for what they only claim.

mod zips;

use std::path::Path;
use std::time::Instant;
use tiface::io::{self, Limits, ReadError, TorchValue};
use tiface::kernel::cpu::vm::{DecoderShape, Grid, Shading};
use tiface::tface::th::{self, VmCheckpoint, VmMask};
use zips::Entry;

fn parse(bytes: &[u8]) -> Result<TorchValue, ReadError> {
    io::parse_torch(Path::new("x.th"), bytes, &Limits::default())
}

/// An archive around a pickle and one storage of six floats, 0 to 5.
fn with_pickle(pickle: &[u8]) -> Vec<u8> {
    let six: Vec<u8> = (0..6).flat_map(|i| (i as f32).to_le_bytes()).collect();
    zips::stored(&[("a/data.pkl".into(), pickle.into()), ("a/data/0".into(), six)])
}

fn error_of(pickle: &[u8]) -> String {
    let error = parse(&with_pickle(pickle)).map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("x.th") && !error.hint().is_empty(), "{error}");
    error.to_string()
}

/// The pickle of a text.
fn text(text: &str) -> Vec<u8> {
    [&[0x8c, text.len() as u8], text.as_bytes()].concat()
}

fn int(value: i64) -> Vec<u8> {
    [&[0x8a, 8][..], &value.to_le_bytes()].concat()
}

fn tuple(items: &[Vec<u8>]) -> Vec<u8> {
    [b"(", &items.concat()[..], b"t"].concat()
}

fn sizes(values: &[i64]) -> Vec<u8> {
    tuple(&values.iter().map(|&v| int(v)).collect::<Vec<_>>())
}

/// A tensor of storage `key`, as torch pickles it.
fn tensor(class: &str, key: &str, count: i64, offset: i64, shape: &[i64], strides: &[i64]) -> Vec<u8> {
    let class = format!("ctorch\n{class}\n").into_bytes();
    let storage = tuple(&[text("storage"), class, text(key), text("cuda:7"), int(count)]);
    let hooks = b"ccollections\nOrderedDict\n)R".to_vec();
    let storage = [&storage[..], b"Q"].concat();
    let arguments = tuple(&[storage, int(offset), sizes(shape), sizes(strides), vec![0x89], hooks]);
    [b"ctorch._utils\n_rebuild_tensor_v2\n", &arguments[..], b"R"].concat()
}

fn whole(body: &[u8]) -> Vec<u8> {
    [b"\x80\x02", body, b"."].concat()
}

fn list(values: &[i64]) -> Vec<u8> {
    [b"](", &values.iter().flat_map(|&v| int(v)).collect::<Vec<u8>>()[..], b"e"].concat()
}

fn float(value: f64) -> Vec<u8> {
    [b"G", &value.to_be_bytes()[..]].concat()
}

fn dict(pairs: &[(String, Vec<u8>)]) -> Vec<u8> {
    let pairs: Vec<u8> = pairs.iter().flat_map(|(key, value)| [text(key), value.clone()].concat()).collect();
    [b"}(", &pairs[..], b"u"].concat()
}

/// A numpy array as numpy 2 pickles it, its values inside the pickle.
fn array(code: &str, shape: &[i64], data: &[u8]) -> Vec<u8> {
    let class = [b"cnumpy\ndtype\n", &tuple(&[text(code), vec![0x89], vec![0x88]])[..], b"R"].concat();
    let data = [&[b'C', data.len() as u8], data].concat();
    let arguments = tuple(&[data, class, sizes(shape), text("C")]);
    [b"cnumpy._core.numeric\n_frombuffer\n", &arguments[..], b"R"].concat()
}

fn floats(shape: &[i64], values: &[f32]) -> Vec<u8> {
    array("f4", shape, &values.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>())
}

/// The smallest field: two nodes along each axis, one component, one feature.
fn small() -> VmCheckpoint {
    let numbers = |n: usize| (0..n).map(|i| i as f32 * 0.25 - 1.0).collect::<Vec<f32>>();
    let grid = Grid { size: [2; 3], rank: [1; 3] };
    let shift = -10.0;
    VmCheckpoint {
        aabb: [[-1.0, -2.0, -3.0], [1.0, 2.0, 3.0]],
        density_grid: grid,
        color_grid: grid,
        decoder: DecoderShape {
            channels: 3,
            features: 1,
            hidden: 2,
            view_frequencies: 0,
            feature_frequencies: 0,
        },
        shading: Shading { softplus: true, shift, distance_scale: 25.0, weight_threshold: 1e-4, stop: 0.0 },
        alpha_mask_threshold: 1e-4,
        near_far: [2.0, 6.0],
        step_ratio: 0.5,
        density: [4, 4, 4, 2, 2, 2].map(numbers),
        color: [4, 4, 4, 2, 2, 2].map(numbers),
        network: [3, 8, 2, 4, 2, 6, 3].map(numbers).concat(),
        mask: Some(VmMask {
            shape: [2, 2, 3],
            occupied: (0..12).map(|i| i % 5 == 0).collect(),
            aabb: [[-1.0; 3], [1.0; 3]],
        }),
    }
}

/// A dictionary of [`small`]'s file, the entry, and its pickle.
type Part = (&'static str, String, Vec<u8>);

/// [`small`] as torch would pickle it, and its storages.
fn parts() -> (Vec<Part>, Vec<Vec<f32>>) {
    let vm = small();
    let mut parts: Vec<Part> = Vec::new();
    let mut storages = Vec::new();
    let mut stored = |shape: &[i64], values: &[f32]| {
        let strides: Vec<i64> = (1..=shape.len()).map(|i| shape[i..].iter().product()).collect();
        storages.push(values.to_vec());
        let key = (storages.len() - 1).to_string();
        tensor("FloatStorage", &key, values.len() as i64, 0, shape, &strides)
    };
    let counts = |v: [usize; 3]| list(&v.map(|n| n as i64));
    let near_far = [b"](", &vm.near_far.map(|x| float(x.into())).concat()[..], b"e"].concat();
    for (key, value) in [
        ("aabb", stored(&[2, 3], vm.aabb.as_flattened())),
        ("gridSize", counts(vm.density_grid.size)),
        ("density_n_comp", counts(vm.density_grid.rank)),
        ("appearance_n_comp", counts(vm.color_grid.rank)),
        ("app_dim", int(vm.decoder.features as i64)),
        ("density_shift", float(vm.shading.shift.into())),
        ("alphaMask_thres", float(vm.alpha_mask_threshold.into())),
        ("distance_scale", float(vm.shading.distance_scale.into())),
        ("rayMarch_weight_thres", float(vm.shading.weight_threshold.into())),
        ("fea2denseAct", text("softplus")),
        ("near_far", near_far),
        ("step_ratio", float(vm.step_ratio.into())),
        ("shadingMode", text("MLP_Fea")),
        ("pos_pe", int(6)),
        ("view_pe", int(vm.decoder.view_frequencies as i64)),
        ("fea_pe", int(vm.decoder.feature_frequencies as i64)),
        ("featureC", int(vm.decoder.hidden as i64)),
    ] {
        parts.push(("kwargs", key.into(), value));
    }
    let mut network = &vm.network[..];
    let mut next = |count: i64| network.split_off(..count as usize).unwrap();
    let basis = next(3);
    for i in 0..3 {
        for (name, factors) in [("density", &vm.density), ("app", &vm.color)] {
            parts.push(("state_dict", format!("{name}_plane.{i}"), stored(&[1, 1, 2, 2], &factors[i])));
            parts.push(("state_dict", format!("{name}_line.{i}"), stored(&[1, 1, 2, 1], &factors[3 + i])));
        }
        let (rows, columns) = [(2, 4), (2, 2), (3, 2)][i];
        let layer = format!("renderModule.mlp.{}", 2 * i);
        parts.push(("state_dict", format!("{layer}.weight"), stored(&[rows, columns], next(rows * columns))));
        parts.push(("state_dict", format!("{layer}.bias"), stored(&[rows], next(rows))));
    }
    parts.push(("state_dict", "basis_mat.weight".into(), stored(&[1, 3], basis)));
    // bits 0, 5 and 10 of twelve, the highest first
    parts.push(("", "alphaMask.shape".into(), sizes(&[1, 1, 2, 2, 3])));
    parts.push(("", "alphaMask.mask".into(), array("u1", &[2], &[0b1000_0100, 0b0010_0000])));
    parts.push(("", "alphaMask.aabb".into(), stored(&[2, 3], vm.mask.unwrap().aabb.as_flattened())));
    (parts, storages)
}

/// The file of these; an entry of the root may stand for a whole dictionary, or leave it out.
fn file_of(parts: &[Part], storages: &[Vec<f32>], left_out: &str) -> Vec<u8> {
    let of = |table: &str| -> Vec<(String, Vec<u8>)> {
        parts.iter().filter(|p| p.0 == table).map(|p| (p.1.clone(), p.2.clone())).collect()
    };
    let mut root = of("");
    for table in ["kwargs", "state_dict"] {
        if table != left_out && !root.iter().any(|(key, _)| key == table) {
            root.push((table.into(), dict(&of(table))));
        }
    }
    let mut entries = vec![("a/data.pkl".to_string(), whole(&dict(&root)))];
    for (i, values) in storages.iter().enumerate() {
        entries.push((format!("a/data/{i}"), values.iter().flat_map(|v| v.to_le_bytes()).collect()));
    }
    zips::stored(&entries)
}

fn small_bytes() -> Vec<u8> {
    let (parts, storages) = parts();
    file_of(&parts, &storages, "")
}

fn read_small(bytes: &[u8]) -> tiface::Result<VmCheckpoint> {
    th::from_bytes(bytes, Path::new("x.th"), &Limits::default())
}

#[test]
fn a_file_cut_off_anywhere_is_an_error() {
    let bytes = small_bytes();
    assert_eq!(read_small(&bytes).unwrap(), small());
    for length in 0..bytes.len() {
        let error = read_small(&bytes[..length]).unwrap_err();
        assert!(error.to_string().contains("x.th") && !error.hint().is_empty(), "{length}: {error}");
    }
}

#[test]
fn a_changed_byte_is_an_error_or_changes_nothing() {
    let bytes = small_bytes();
    let begin = Instant::now();
    let mut harmless = 0;
    for at in 0..bytes.len() {
        for flip in [0x01, 0x80, 0xFF] {
            let mut damaged = bytes.clone();
            damaged[at] ^= flip;
            if let Ok(read) = read_small(&damaged) {
                assert_eq!(read, small(), "byte {at}");
                harmless += 1;
            }
        }
    }
    // dates, versions and padding mean nothing; everything else is under a check sum or compared
    assert!(harmless < bytes.len() * 3 * 2 / 3, "{harmless} of {}", bytes.len() * 3);
    assert!(begin.elapsed().as_secs() < 60);
}

/// Check sums are made right again, so that the pickle's reader itself meets the damage.
#[test]
fn a_pickle_with_any_byte_changed_or_missing_never_ends_in_a_panic() {
    let entries = zips::entries(&std::fs::read("tests/reference/kinds_4.pt").unwrap());
    let of = |pickle: &[u8]| {
        let mut entries = entries.clone();
        entries.iter_mut().find(|(n, _)| n.ends_with("data.pkl")).unwrap().1 = pickle.into();
        zips::stored(&entries)
    };
    let pickle = entries.iter().find(|(n, _)| n.ends_with("data.pkl")).unwrap().1.clone();
    let begin = Instant::now();
    for at in 0..pickle.len() {
        assert!(parse(&of(&pickle[..at])).is_err());
        for value in [0x00, 0x01, 0x7F, 0x80, 0xFF, b'R', b'b', b'h', b'(', b'0', b't', b'e', 0x94] {
            let mut damaged = pickle.clone();
            damaged[at] = value;
            let _ = parse(&of(&damaged));
        }
    }
    // and several at once
    let mut state = 7u64;
    let mut random = |below: usize| {
        state = state.wrapping_mul(6364136223846793005).wrapping_add(1442695040888963407);
        (state >> 33) as usize % below
    };
    for _ in 0..20_000 {
        let mut damaged = pickle.clone();
        for _ in 0..1 + random(4) {
            let at = random(damaged.len());
            damaged[at] = if random(2) == 0 { random(256) as u8 } else { pickle[random(pickle.len())] };
        }
        let _ = parse(&of(&damaged));
    }
    assert!(begin.elapsed().as_secs() < 60);
}

#[test]
fn foreign_names_are_refused_where_they_stand_and_nothing_is_run() {
    let dir = tempfile::tempdir().unwrap();
    let touched = dir.path().join("touched");
    let command = text(&format!("touch {}", touched.display()));
    for (module, name) in [
        ("os", "system"),
        ("posix", "system"),
        ("builtins", "eval"),
        ("__builtin__", "exec"),
        ("subprocess", "Popen"),
        ("torch", "load"),
        ("torch._utils", "_rebuild_tensor"),
        ("torch", "FloatStorage.from_file"),
        ("numpy", "fromfile"),
        ("collections", "OrderedDict\u{0}"),
    ] {
        let call = [b"c", module.as_bytes(), b"\n", name.as_bytes(), b"\n", &command, b"\x85R"].concat();
        let message = error_of(&whole(&call));
        let shown = name.replace('\0', "\\0");
        let expected = format!("`{module}.{shown}` (at byte 2 of `data.pkl`)");
        assert!(message.contains(&expected), "{message}");
        // the same by protocol 4's opcode, after two texts
        let call = [text(module), text(name), vec![0x93], command.clone(), b"\x85R".to_vec()].concat();
        assert!(error_of(&whole(&call)).contains(&format!("`{module}.{shown}`")));
    }
    assert!(!touched.exists());
    let hint = parse(&with_pickle(b"\x80\x02cos\nsystem\n.")).unwrap_err().hint();
    assert!(hint.contains("nothing in the file was run"), "{hint}");
}

#[test]
fn other_opcodes_that_could_make_objects_are_named() {
    // INST, OBJ, NEWOBJ, NEWOBJ_EX, EXT1, PERSID, NEXT_BUFFER, and text opcodes of protocol 0
    for opcode in [b'i', b'o', 0x81, 0x92, 0x82, b'P', 0x97, b'I', b'V', b'S', 0x8f] {
        let message = error_of(&whole(&[b'N', opcode, 0, 0, 0, 0]));
        assert!(message.contains(&format!("opcode 0x{opcode:02x} (at byte 3 of `data.pkl`)")), "{message}");
    }
    assert!(error_of(b"\x80\x09N.").contains("protocol 9"));
}

#[test]
fn known_names_are_called_only_as_torch_calls_them() {
    let call = |name: &str, arguments: &[Vec<u8>]| {
        let (module, name) = name.rsplit_once('.').unwrap();
        let global = format!("c{module}\n{name}\n").into_bytes();
        whole(&[global, tuple(arguments), b"R".to_vec()].concat())
    };
    for (pickle, expected) in [
        (whole(&[text("eval"), text("1").clone(), b"\x85R".to_vec()].concat()), "no function"),
        (call("torch.FloatStorage", &[int(1 << 40)]), "arguments"),
        (call("collections.OrderedDict", &[text("x")]), "arguments"),
        (call("_codecs.encode", &[text("x"), text("zlib")]), "arguments"),
        (call("_codecs.encode", &[text("é")]), "arguments"),
        (call("numpy.dtype", &[text("O8")]), "`O8` is not read"),
        (call("numpy.ndarray", &[sizes(&[1 << 40])]), "arguments"),
        (call("numpy.core.multiarray._reconstruct", &[text("x"), sizes(&[0]), text("b")]), "arguments"),
        (call("torch._utils._rebuild_parameter", &[text("x"), vec![0x88]]), "arguments"),
        (
            call("torch._utils._rebuild_tensor_v2", &[text("x"), int(0), sizes(&[1]), sizes(&[1])]),
            "arguments",
        ),
        (call("torch.Size", &vec![int(0); 100]), "100 arguments"),
        (whole(b"N}b"), "a state"),
        (whole(b"NQ"), "no storage"),
        (whole(b"ctorch\nSize\n"), "stands where a value should"),
    ] {
        let message = error_of(&pickle);
        assert!(message.contains(expected), "{message}");
    }
}

#[test]
fn broken_stacks_memories_and_containers_are_errors() {
    let long = [&[0x8a, 9][..], &[1; 9]].concat();
    for (body, expected) in [
        (&b""[..], "too few values"),
        (b"0", "too few values"),
        (b"NN\x87", "too few values"),
        (b"N(0", "too few values"),
        (b"t", "no mark"),
        (b"NNa", "no list"),
        (b"}(NNNu", "no dictionary"),
        (b"N(NNu", "no dictionary"),
        (b"h\x05", "never remembered"),
        (b"q\x05", "too few values"),
        (b"\x8d\xff\xff\xff\xff\xff\xff\xff\xff", "should follow"),
        (b"B\xff\xff\xff\xff", "should follow"),
        (b"\x8c\x02\xff\xfe", "not UTF-8"),
        (b"cos", "has no end"),
        (&long, "an integer of 9 bytes"),
        (b"}NNs", "not text"),
        (b"}(\x8c\x01aN\x8c\x01aNu", "the key `a` twice"),
        (b"]q\x00h\x00a", "nested deeper"),
    ] {
        let message = error_of(&whole(body));
        assert!(message.contains(expected), "{body:?}: {message}");
    }
}

#[test]
fn small_pickles_that_unfold_to_much_are_stopped() {
    // 60 lists, each holding the one before twice: 2⁶⁰ values
    let mut body = b"]q\x00".to_vec();
    for i in 0..60u8 {
        body.extend([b']', b'(', b'h', i, b'h', i, b'e', b'q', i + 1]);
    }
    assert!(error_of(&whole(&body)).contains("unfold"));
    // a list in a list in a list
    let message = error_of(&whole(&[vec![b']'; 100_000], vec![b'a'; 99_999]].concat()));
    assert!(message.contains("nested deeper"), "{message}");
    for opcode in [b'N', b'(', b']'] {
        assert!(error_of(&whole(&vec![opcode; 1 << 20])).contains("more than 262144 values"));
    }
    // one storage of 60 000 floats seen by 400 tensors would be 96 MB, from a file of 400 kB
    let view = tensor("FloatStorage", "0", 60_000, 0, &[60_000], &[1]);
    let pickle = whole(&[&b"("[..], &view.repeat(400), b"t"].concat());
    let bytes = zips::stored(&[("a/data.pkl".into(), pickle), ("a/data/0".into(), vec![0; 240_000])]);
    let error = parse(&bytes).map(|_| ()).unwrap_err();
    assert!(error.to_string().contains("share storages so often"), "{error}");
    // one tensor seen often is one
    let view = tensor("FloatStorage", "0", 6, 0, &[6], &[1]);
    let body = [&view[..], b"q\x000]("].concat();
    let body = [&body[..], &b"h\x00".repeat(100_000), b"e"].concat();
    let TorchValue::List(list) = parse(&with_pickle(&whole(&body))).unwrap() else { panic!() };
    assert_eq!(list.len(), 100_000);
}

#[test]
fn tensors_stay_inside_their_storage() {
    let read = |count, offset, shape: &[i64], strides: &[i64]| {
        parse(&with_pickle(&whole(&tensor("FloatStorage", "0", count, offset, shape, strides))))
    };
    assert!(read(6, 0, &[2, 3], &[3, 1]).is_ok());
    assert!(read(6, 5, &[1, 1], &[i64::MAX, i64::MAX]).is_ok(), "strides of extents 1 are never taken");
    assert!(read(6, 9, &[0], &[1]).is_ok(), "nothing is read");
    let max = i64::MAX;
    for (offset, shape, strides) in [
        (0, &[7][..], &[1][..]),
        (1, &[6], &[1]),
        (6, &[1], &[1]),
        (6, &[], &[]),
        (0, &[2, 3], &[4, 1]),
        (0, &[1 << 40], &[0]),
        (0, &[1 << 40], &[1]),
        (0, &[1 << 32, 1 << 32], &[0, 0]),
        (0, &[max, max, max], &[1, 1, 1]),
        (0, &[2], &[max]),
        (0, &[3, 2], &[max, max]),
        (max, &[2], &[1]),
    ] {
        let error = read(6, offset, shape, strides).unwrap_err().to_string();
        assert!(error.contains("does not fit its storage `data/0` of 6 values"), "{error}");
    }
    for (offset, shape, strides) in
        [(-1, &[1][..], &[1][..]), (0, &[-1], &[1]), (0, &[1], &[-1]), (0, &[1, 1], &[1])]
    {
        assert!(read(6, offset, shape, strides).unwrap_err().to_string().contains("arguments"));
    }
    assert!(read(6, 0, &[1; 17], &[1; 17]).is_err());
    for count in [0, 5, 7, 1 << 40, max] {
        let error = read(count, 0, &[1], &[1]).unwrap_err().to_string();
        assert!(error.contains("should hold") && error.contains("24 bytes"), "{error}");
    }
    let other = |class: &str, key: &str| error_of(&whole(&tensor(class, key, 6, 0, &[1], &[1])));
    assert!(other("DoubleStorage", "0").contains("6 values of 8 bytes and has 24 bytes"));
    assert!(other("FloatStorage", "1").contains("the storage `data/1` is missing"));
    assert!(other("FloatStorage", "../data.pkl").contains("is missing"));
    assert!(other("ComplexFloatStorage", "0").contains("`torch.ComplexFloatStorage`"));
}

#[test]
fn archives_that_lie_are_errors() {
    let pickle = whole(b"N");
    let good = [Entry::stored("a/data.pkl", &pickle), Entry::stored("a/data/0", &[0; 24])];
    let made = |change: &dyn Fn(&mut Vec<Entry>)| {
        let mut entries = good.to_vec();
        change(&mut entries);
        parse(&zips::archive(&entries, |_, at| at))
    };
    assert_eq!(made(&|_| ()).unwrap(), TorchValue::None);
    let message = |result: Result<TorchValue, ReadError>| result.unwrap_err().to_string();
    assert!(message(made(&|e| e[1].name = "a/data.pkl".into())).contains("duplicate"));
    assert!(message(made(&|e| e[1].name = "b/data.pkl".into())).contains("more than one `data.pkl`"));
    assert!(message(made(&|e| e[0].name = "a/data.pickle".into())).contains("no `data.pkl`"));
    assert!(message(made(&|e| e[1].crc ^= 1)).contains("cannot be unpacked"));
    assert!(message(made(&|e| e[1].size += 1)).contains("has 24 bytes, its entry says 25"));
    assert!(message(made(&|e| e[1].flags = 1)).contains("Password"));
    assert!(message(made(&|e| e[1].method = 12)).contains("not supported: 12"));
    assert!(message(made(&|e| e[1].method = 8)).contains("cannot be unpacked"));
    // two entries on the same bytes
    let twice = zips::archive(&[good[0].clone(), good[0].clone()], |_, _| 0);
    assert!(message(parse(&twice)).contains("duplicate"));
    // an entry inside the data of another one
    let inner = zips::archive(&[Entry::stored("a/data/1", &[0; 9])], |_, at| at);
    let outer = [good[0].clone(), Entry::stored("a/data/0", &inner), Entry::stored("a/data/1", &[0; 9])];
    let at = 30 + "a/data.pkl".len() + pickle.len() + 30 + "a/data/0".len();
    let shared = zips::archive(&outer, |i, own| if i == 2 { at as u32 } else { own });
    assert!(message(parse(&shared)).contains("overlapping"));
    for offset in [u32::MAX - 1, 1 << 20, 3] {
        assert!(parse(&zips::archive(&good, |_, at| at + offset.min(u32::MAX - at))).is_err());
    }
}

#[test]
fn small_archives_that_unpack_to_much_are_refused_before_they_are_unpacked() {
    let begin = Instant::now();
    let zeros = Entry::deflated("a/data/0", &vec![0; 64 << 20]);
    assert!(zeros.data.len() < 100 << 10);
    let error =
        parse(&zips::archive(&[Entry::stored("a/data.pkl", b"\x80\x02N."), zeros.clone()], |_, at| at));
    assert!(matches!(error, Err(ReadError::TooLarge { found, .. }) if found >= 64 << 20), "{error:?}");
    // the size it claims is all it gets
    let liar = Entry { size: 100, ..zeros };
    let error = parse(&zips::archive(&[Entry::stored("a/data.pkl", b"\x80\x02N."), liar], |_, at| at));
    assert!(error.unwrap_err().to_string().contains("cannot be unpacked"));
    assert!(begin.elapsed().as_secs() < 20);
}

#[test]
fn files_that_are_no_archives_say_what_they_are() {
    let legacy = b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.\x80\x02M\xe9\x03.";
    let error = parse(legacy).unwrap_err();
    assert!(
        error.to_string().contains("before version 1.6") && error.hint().contains("torch.save"),
        "{error}"
    );
    for bytes in [&b"\x89PNG\r\n"[..], b"P", b"PK\x03\x04", b"PK\x05\x06"] {
        assert!(matches!(parse(bytes), Err(ReadError::Damaged { .. })));
    }
    let missing = th::read_th(Path::new("/nowhere/x.th"), &Limits::default()).unwrap_err();
    assert!(missing.to_string().contains("/nowhere/x.th"));
}

// ------------------------------------------------------------------------- sound files of another content

/// The message about the small field with one entry of one dictionary replaced, or taken out.
fn changed(table: &'static str, key: &str, value: Option<Vec<u8>>) -> tiface::Error {
    let (mut parts, storages) = parts();
    let before = parts.len();
    parts.retain(|(t, k, _)| (*t, k.as_str()) != (table, key));
    let whole_table = table.is_empty() && ["kwargs", "state_dict"].contains(&key);
    assert!(parts.len() < before || value.is_some() || whole_table, "there is no {key}");
    let left_out = if whole_table && value.is_none() { key } else { "" };
    parts.extend(value.map(|v| (table, key.into(), v)));
    let error = read_small(&file_of(&parts, &storages, left_out)).unwrap_err();
    assert!(error.to_string().contains("x.th") && !error.hint().is_empty());
    error
}

#[test]
fn entries_that_do_not_fit_are_named_with_what_was_expected() {
    let list = |v: &[i64]| Some(list(v));
    let word = |s: &str| Some(text(s));
    let floats = |shape: &[i64], values: &[f32]| Some(floats(shape, values));
    for (table, key, value, expected) in [
        ("", "kwargs", None, "`kwargs` is missing"),
        ("", "kwargs", word("x"), "`kwargs` is text, expected a dictionary"),
        ("", "state_dict", None, "`state_dict` is missing"),
        ("kwargs", "gridSize", None, "`kwargs.gridSize` is missing"),
        ("kwargs", "gridSize", list(&[2, 2]), "three integers"),
        (
            "kwargs",
            "gridSize",
            list(&[2, 2, 1]),
            "`kwargs.gridSize` is [2, 2, 1], expected three integers from 2",
        ),
        ("kwargs", "gridSize", list(&[2, 2, i64::MAX]), "three integers"),
        ("kwargs", "gridSize", list(&[2, 2, -3]), "three integers"),
        (
            "kwargs",
            "gridSize",
            list(&[2, 3, 2]),
            "`state_dict.density_plane.0` is a tensor of floats of shape [1, 1, 2, 2], expected a tensor of floats \
             of shape [1, 1, 3, 2]",
        ),
        ("kwargs", "app_dim", Some(float(1.0)), "`kwargs.app_dim` is 1, expected an integer"),
        ("kwargs", "app_dim", list(&[1]), "`kwargs.app_dim` is a list of 1"),
        ("kwargs", "fea_pe", Some(int(2)), "expected a tensor of floats of shape [2, 8]"),
        ("kwargs", "fea2denseAct", word("elu"), "`elu`, expected `relu` or `softplus`"),
        ("kwargs", "near_far", list(&[6, 2]), "`kwargs.near_far`"),
        ("kwargs", "step_ratio", Some(float(0.0)), "`kwargs.step_ratio` is 0"),
        ("kwargs", "density_shift", Some(float(f64::NAN)), "`kwargs.density_shift` is NaN"),
        ("kwargs", "aabb", floats(&[2, 3], &[0., 0., 0., 1., 0., 1.]), "a lower corner and a higher one"),
        ("kwargs", "aabb", floats(&[6], &[0.; 6]), "expected a tensor of floats of shape [2, 3]"),
        ("state_dict", "app_line.2", None, "`state_dict.app_line.2` is missing"),
        ("state_dict", "app_line.3", floats(&[1], &[0.]), "`state_dict.app_line.3` is there"),
        ("state_dict", "app_line.2", word("x"), "`state_dict.app_line.2` is text"),
        ("state_dict", "basis_mat.weight", floats(&[1, 3], &[1., f32::NAN, 2.]), "is NaN at index 1"),
        (
            "state_dict",
            "renderModule.mlp.4.bias",
            floats(&[3], &[0., 0., f32::INFINITY]),
            "is inf at index 2",
        ),
        ("", "alphaMask.shape", None, "`alphaMask.shape` is missing"),
        ("", "alphaMask.aabb", None, "`alphaMask.aabb` is missing"),
        ("", "alphaMask.shape", list(&[1, 1, 2, 2, 9]), "expected 5 bytes, the bits of [2, 2, 9] nodes"),
        ("", "alphaMask.shape", list(&[1, 1, 1 << 16, 1 << 16, 1 << 16]), "35184372088832 bytes"),
        ("", "alphaMask.shape", list(&[2, 2, 3]), "`alphaMask.shape`"),
        ("", "alphaMask.mask", floats(&[2], &[0.; 2]), "a tensor of floats of shape [2], expected 2 bytes"),
    ] {
        let message = changed(table, key, value).to_string();
        assert!(message.contains(expected), "{message}\n{expected}");
    }
}

#[test]
fn other_models_are_told_apart() {
    let error = changed("kwargs", "shadingMode", Some(text("MLP_PE")));
    assert!(error.to_string().contains("shadingMode `MLP_PE`, only `MLP_Fea`"), "{error}");
    let error = changed("state_dict", "density_plane.0", None);
    assert!(error.to_string().contains("lines without planes"), "{error}");
    assert!(error.hint().contains("--model_name TensorVMSplit"), "{error:?}");
}
