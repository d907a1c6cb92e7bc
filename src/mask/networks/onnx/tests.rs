//! Hostile files, each with the error it must produce; and that the engines really refuse what they refuse.

use super::made::{
    self, Message, floats, graph, integers, model, node, port, tensor, trimap_times, vitmatte,
};
use super::*;
use crate::image::{Gray, Photo};
use crate::mask::networks::{NetworkFiles, NetworkOptions, Networks};
use std::fs;

/// The shared data, where it is.
pub(in crate::mask) fn shared(folder: &str) -> Option<PathBuf> {
    let root = std::env::var_os("TIFACE_SHARED")
        .map(PathBuf::from)
        .unwrap_or_else(|| PathBuf::from(concat!(env!("CARGO_MANIFEST_DIR"), "/../shared")));
    let path = root.join("data/mask-models").join(folder);
    if path.is_dir() {
        return Some(path);
    }
    eprintln!("skipped: `{}` is not there", path.display());
    None
}

/// The ONNX Runtime library the environment names.
pub(in crate::mask) fn onnxruntime() -> Option<PathBuf> {
    let named = std::env::var_os("TIFACE_ONNXRUNTIME").map(PathBuf::from);
    if named.is_none() {
        eprintln!("skipped: ONNX Runtime, TIFACE_ONNXRUNTIME names no library");
    }
    named
}

/// Both engines, or the one there is.
pub(in crate::mask) fn engines() -> Vec<Option<PathBuf>> {
    std::iter::once(None).chain(onnxruntime().map(Some)).collect()
}

fn opened_with(bytes: &[u8], onnxruntime: Option<PathBuf>) -> Result<Networks, MaskNetworkError> {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("network.onnx");
    fs::write(&path, bytes).unwrap();
    let files = NetworkFiles { vitmatte: Some(path), onnxruntime, ..NetworkFiles::default() };
    Networks::open(&files, &NetworkOptions::default())
}

fn opened(bytes: &[u8]) -> Result<Networks, MaskNetworkError> {
    opened_with(bytes, None)
}

/// The error of a file that must not open, on both engines the same, with a hint.
fn refusal(bytes: &[u8]) -> MaskNetworkError {
    let mut errors = engines().into_iter().map(|engine| match opened_with(bytes, engine) {
        Ok(_) => panic!("it opened"),
        Err(e) => e,
    });
    let first = errors.next().unwrap();
    for other in errors {
        assert_eq!(std::mem::discriminant(&other), std::mem::discriminant(&first), "{other}");
    }
    assert!(first.hint().len() > 10, "no way out of: {first}");
    assert!(!first.to_string().contains('\n'));
    first
}

fn refused(bytes: &[u8]) -> String {
    match refusal(bytes) {
        MaskNetworkError::Refused { problem, .. } => problem,
        other => panic!("another error: {other}"),
    }
}

fn photo(width: u32, height: u32) -> (Photo, Gray) {
    let rgb = (0..width * height).map(|i| [(i % 251) as u8, (i % 83) as u8, 200]).collect();
    let values = (0..width * height).map(|i| [0, 128, 255][i as usize % 3]).collect();
    (Photo { width, height, rgb, alpha: None }, Gray { width, height, values })
}

#[test]
fn a_sound_network_made_by_hand_gives_the_trimap_on_each_engine() {
    // odd sizes: padded to 64 × 64, cut back to 35 × 33
    let (photo, trimap) = photo(35, 33);
    for engine in engines() {
        let networks = opened_with(&trimap_times(1.0), engine).unwrap();
        let alpha = networks.alpha(&photo, &trimap).unwrap();
        let expected: Vec<f32> = trimap.values.iter().map(|&v| [0.0, 0.5, 1.0][v as usize / 100]).collect();
        assert_eq!(alpha, expected);
    }
}

#[test]
fn text_nothing_and_half_a_file_are_no_onnx() {
    let page = b"<!DOCTYPE html><html><body>404</body></html>".as_slice();
    for bytes in [page, b"version https://git-lfs.github.com/spec/v1\n", &[0xff; 100], b"\n\x00\x12"] {
        assert!(matches!(refusal(bytes), MaskNetworkError::NotOnnx { .. }), "{}", refusal(bytes));
    }
    assert!(matches!(refusal(b""), MaskNetworkError::Read(_)));
    let whole = trimap_times(1.0);
    for end in 1..whole.len() {
        // an end between two fields leaves a message that parses and lacks what comes later
        let error = match opened(&whole[..end]) {
            // the last field is the opset: without it the rest still stands
            Ok(_) => continue,
            Err(e) => e,
        };
        let named = matches!(error, MaskNetworkError::NotOnnx { .. } | MaskNetworkError::Engine { .. });
        assert!(named, "cut at {end}: {error}");
    }
}

#[test]
fn any_single_byte_may_be_wrong_without_a_panic() {
    let whole = trimap_times(1.0);
    let (photo, trimap) = photo(8, 8);
    for at in 0..whole.len() {
        for flip in [0x01, 0xff] {
            let mut bytes = whole.clone();
            bytes[at] ^= flip;
            let given = opened(&bytes).and_then(|networks| networks.alpha(&photo, &trimap));
            if let Err(error) = given {
                assert!(!error.hint().is_empty());
                assert!(!error.to_string().contains("broke down"), "byte {at} ^ {flip:#x}: {error}");
            }
        }
    }
}

/// Minutes long, for changes here: `cargo test --release --no-default-features --features matting --lib damage -- --ignored`.
#[test]
#[ignore = "300 damaged networks on each engine take minutes; run with --ignored after changes here"]
fn random_damage_to_a_whole_network_ends_in_a_result_or_an_error() {
    let Some(folder) = shared("vitmatte_tiny") else { return };
    let whole = fs::read(folder.join("model.onnx")).unwrap();
    let (photo, trimap) = photo(40, 33);
    let mut seed = 20_240_607u64;
    let mut random = || {
        // Steele, Lea & Flood 2014: splitmix64
        seed = seed.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (seed ^ (seed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) as usize
    };
    let mut ends = std::collections::BTreeMap::new();
    for _ in 0..300 {
        let mut bytes = whole.clone();
        // the graph's nodes stand before its weights
        for _ in 0..1 + random() % 3 {
            let at = random() % (whole.len() / 4);
            bytes[at] ^= 1 << (random() % 8);
        }
        for engine in engines() {
            let name = if engine.is_some() { "ONNX Runtime" } else { "tract" };
            let end = match opened_with(&bytes, engine).and_then(|n| n.alpha(&photo, &trimap)) {
                Ok(_) => "an alpha".to_string(),
                Err(e) if e.to_string().contains("broke down") => format!("a panic caught: {e}"),
                Err(e) => format!("{e:?}").split_whitespace().next().unwrap_or_default().to_string(),
            };
            *ends.entry(format!("{name}: {end}")).or_insert(0) += 1;
        }
    }
    for (end, times) in ends {
        println!("{times:4} {end}");
    }
}

#[test]
fn weights_in_another_file_are_refused_wherever_they_lie() {
    let dir = tempfile::tempdir().unwrap();
    let beside = dir.path().join("weights.bin");
    fs::write(&beside, [0; 16]).unwrap();
    let absolute = beside.display().to_string();
    for location in [absolute.as_str(), "../weights.bin", "weights.bin", "/etc/passwd", "missing\u{1b}[2J"] {
        let entry = Message::new().text(1, "location").text(2, location);
        let w = tensor("w", 1, &[1, 4, 1, 1]).message(13, &entry).int(14, 1);
        let nodes = [node("Conv", &["pixel_values", "w"], &["alphas"], &[])];
        let bytes = vitmatte(&nodes, &[w]);
        let path = dir.path().join("network.onnx");
        fs::write(&path, &bytes).unwrap();
        let files = NetworkFiles { vitmatte: Some(path), ..NetworkFiles::default() };
        let Err(MaskNetworkError::Refused { problem, .. }) =
            Networks::open(&files, &NetworkOptions::default())
        else {
            panic!("{location} was followed")
        };
        assert!(problem.contains("another file") && !problem.contains('\u{1b}'), "{problem}");
        assert!(refused(&bytes).contains("another file"));
    }
    // announced, but not named
    let w = tensor("w", 1, &[1, 4, 1, 1]).int(14, 1);
    assert!(refused(&vitmatte(&[], &[w])).contains("does not name"));
}

#[test]
fn a_circle_and_a_name_from_nowhere_are_refused() {
    let circle = [node("Add", &["pixel_values", "b"], &["a"], &[]), node("Relu", &["a"], &["b"], &[])];
    assert!(refused(&vitmatte(&circle, &[])).contains("in a circle"));
    let itself = [node("Relu", &["alphas"], &["alphas"], &[])];
    assert!(refused(&vitmatte(&itself, &[])).contains("in a circle"));
    let nowhere = [node("Add", &["pixel_values", "ghost"], &["alphas"], &[])];
    assert!(refused(&vitmatte(&nowhere, &[])).contains("`ghost`, which nothing makes"));
    assert!(refused(&vitmatte(&[], &[])).contains("nothing makes its output `alphas`"));
    let twice =
        [node("Relu", &["pixel_values"], &["alphas"], &[]), node("Abs", &["pixel_values"], &["alphas"], &[])];
    assert!(refused(&vitmatte(&twice, &[])).contains("made twice"));
}

#[test]
fn extents_that_the_data_does_not_fill_are_refused_before_anything_is_reserved() {
    let nodes = [node("Conv", &["pixel_values", "w"], &["alphas"], &[])];
    let with = |w: Message| refused(&vitmatte(&nodes, &[w]));
    let huge = [1 << 20, 1 << 20, 16, 16];
    assert!(with(tensor("w", 1, &huge)).contains("but holds 0"));
    assert!(with(tensor("w", 1, &huge).bytes(9, &[0; 64])).contains("but holds 64"));
    assert!(with(tensor("w", 1, &[i64::MAX, i64::MAX])).contains("impossible extents"));
    assert!(with(tensor("w", 1, &[-1, 4])).contains("impossible extents"));
    assert!(with(tensor("w", 1, &[1; 40]).bytes(9, &[0; 4])).contains("impossible extents"));
    // one number short, one too many, and the same as a list instead of raw bytes
    assert!(with(tensor("w", 1, &[4]).bytes(9, &[0; 12])).contains("promises 16 bytes"));
    assert!(with(tensor("w", 1, &[4]).bytes(9, &[0; 20])).contains("promises 16 bytes"));
    assert!(with(tensor("w", 1, &[4]).bytes(4, &[0; 12])).contains("promises 4 numbers"));
    assert!(with(tensor("w", 7, &[4]).bytes(7, &[0; 3])).contains("promises 4 numbers"));
    assert!(with(tensor("w", 99, &[1])).contains("ONNX type 99"));
}

#[test]
fn constants_that_ask_for_an_array_beyond_all_pictures_are_refused() {
    let filled = node("ConstantOfShape", &["size"], &["big"], &[]);
    let tiled = node("Tile", &["pixel_values", "size"], &["big"], &[]);
    let ranged = node("Range", &["zero", "size", "one"], &["big"], &[]);
    let resized = node("Resize", &["pixel_values", "", "", "size"], &["big"], &[]);
    for (first, size) in [
        (filled, vec![1 << 20, 1 << 20]),
        (tiled, vec![1, 1 << 15, 1 << 15, 1 << 15]),
        (ranged, vec![1 << 40]),
        (resized, vec![1, 4, 1 << 20, 1 << 20]),
    ] {
        let nodes = [first, node("Identity", &["pixel_values"], &["alphas"], &[])];
        let weights = [integers("size", &size), integers("zero", &[0]), integers("one", &[1])];
        let problem = refused(&vitmatte(&nodes, &weights));
        assert!(problem.contains("asks for"), "{problem}");
    }
    // each small enough, together not: 2¹⁵ · 2¹⁵
    let nodes = [
        node("Tile", &["pixel_values", "size"], &["a"], &[]),
        node("Tile", &["a", "size"], &["alphas"], &[]),
    ];
    assert!(refused(&vitmatte(&nodes, &[integers("size", &[1, 1, 1, 1 << 15])])).contains("asks for"));
}

#[test]
fn extents_computed_from_constants_are_followed() {
    // 2¹⁵ · 2¹⁵ joined with 64: 2³⁶ numbers
    let nodes = [
        node("Mul", &["half", "half"], &["square"], &[]),
        node("Concat", &["square", "more"], &["size"], &[]),
        node("ConstantOfShape", &["size"], &["big"], &[]),
        node("Identity", &["pixel_values"], &["alphas"], &[]),
    ];
    let weights = [integers("half", &[1 << 15]), integers("more", &[64])];
    assert!(refused(&vitmatte(&nodes, &weights)).contains("asks for 68719476736 numbers"));
}

#[test]
fn extents_computed_from_the_picture_end_in_an_error_too() {
    // the picture's own shape times 2³⁰: [2³⁰, 4, 32, 32], 16 TiB, which the built-in engine sees beforehand
    let nodes = [
        node("Shape", &["pixel_values"], &["shape"], &[]),
        node("Mul", &["shape", "factor"], &["size"], &[]),
        node("Expand", &["pixel_values", "size"], &["alphas"], &[]),
    ];
    let bytes = vitmatte(&nodes, &[integers("factor", &[1 << 30, 1, 1, 1])]);
    let (photo, trimap) = photo(32, 32);
    for engine in engines() {
        let builtin = engine.is_none();
        let error = opened_with(&bytes, engine).unwrap().alpha(&photo, &trimap).unwrap_err();
        assert!(matches!(error, MaskNetworkError::Engine { .. }), "{error}");
        assert_eq!(
            error.to_string().contains("asks for an array of 17592186044416 bytes"),
            builtin,
            "{error}"
        );
    }
}

#[test]
fn weights_that_are_no_numbers_are_refused_in_every_storage() {
    let nodes = [node("Conv", &["pixel_values", "w"], &["alphas"], &[])];
    let with = |w: Message| vitmatte(&nodes, &[w]);
    let four = [1, 4, 1, 1];
    let bad = [1.0, 2.0, f32::NAN, 4.0];
    let raw: Vec<u8> = bad.iter().flat_map(|v| v.to_le_bytes()).collect();
    let doubles: Vec<u8> = bad.iter().flat_map(|&v| f64::from(v).to_le_bytes()).collect();
    let halves =
        |nan: u16| [0x3c00, nan, 0, 0].iter().flat_map(|v: &u16| v.to_le_bytes()).collect::<Vec<u8>>();
    let listed =
        [0x3c00u16, 0x7e00, 0, 0].iter().fold(tensor("w", 10, &four), |t, &v| t.int(5, i64::from(v)));
    for (w, word) in [
        (floats("w", &four, &bad), "NaN"),
        (tensor("w", 1, &four).bytes(4, &raw), "NaN"),
        (tensor("w", 11, &four).bytes(9, &doubles), "NaN"),
        (tensor("w", 11, &four).bytes(10, &doubles), "NaN"),
        (tensor("w", 10, &four).bytes(9, &halves(0x7e00)), "NaN"),
        (listed, "NaN"),
        (tensor("w", 16, &four).bytes(9, &halves(0x7fc0)), "NaN"),
        (floats("w", &four, &[1.0, f32::INFINITY, 0.0, 0.0]), "infinite"),
        (tensor("w", 10, &four).bytes(9, &halves(0xfc00)), "infinite"),
    ] {
        let problem = refused(&with(w));
        assert!(problem.contains(word) && problem.contains("`w`"), "{problem}");
    }
    // one infinite number alone is a filler, as in masks of attention
    let one = node("Max", &["pixel_values", "low"], &["m"], &[]);
    let conv = node("Conv", &["m", "w"], &["alphas"], &[]);
    let weights = [floats("low", &[1], &[f32::NEG_INFINITY]), floats("w", &four, &[0.0, 0.0, 0.0, 1.0])];
    opened(&vitmatte(&[one, conv], &weights)).unwrap();
}

#[test]
fn graphs_in_graphs_end_at_a_depth_and_see_what_is_around_them() {
    let deep = (0..20).fold(graph(&[], &[], &[], &[]), |inner, _| {
        let branch = made::graph_attribute("then_branch", &inner);
        graph(&[node("If", &["pixel_values"], &["x"], &[branch])], &[], &[], &[])
    });
    let branch = made::graph_attribute("then_branch", &deep);
    let nodes = [node("If", &["pixel_values"], &["alphas"], &[branch])];
    assert!(refused(&vitmatte(&nodes, &[])).contains("deeper"));
    // inside, a name of the graph around is known, one of a graph beside is not
    let reads = |name: &str| {
        let inner = graph(&[node("Relu", &[name], &["y"], &[])], &[], &[], &[port("y", 1, &[])]);
        node("If", &["pixel_values"], &["x"], &[made::graph_attribute("then_branch", &inner)])
    };
    let end = node("Identity", &["pixel_values"], &["alphas"], &[]);
    assert!(scan::scan(&vitmatte(&[reads("pixel_values"), end.clone()], &[])).is_ok());
    assert!(refused(&vitmatte(&[reads("y"), end.clone()], &[])).contains("circle"));
    assert!(refused(&vitmatte(&[reads("x"), end], &[])).contains("nothing makes"));
}

#[test]
fn what_no_such_network_needs_is_refused() {
    let sound = graph(&[node("Relu", &["pixel_values"], &["alphas"], &[])], &[], &[], &[]);
    let twice = Message::new().message(7, &sound).message(7, &sound).0;
    assert!(matches!(refusal(&twice), MaskNetworkError::NotOnnx { .. }));
    for (field, word) in [(20, "training"), (25, "functions")] {
        let bytes = Message::new().message(field, &Message::new()).message(7, &sound).0;
        assert!(refused(&bytes).contains(word));
    }
    let sparse = graph(&[], &[], &[], &[]).message(15, &Message::new());
    assert!(refused(&model(&sparse)).contains("sparse"));
    let many = graph(&vec![node("", &[], &[], &[]); 100_001], &[], &[], &[]);
    assert!(refused(&model(&many)).contains("more than 100000 nodes"));
}

#[test]
fn another_network_is_named_by_what_it_takes_and_gives() {
    let classifier = graph(
        &[node("Relu", &["data"], &["prob"], &[])],
        &[],
        &[port("data", 1, &[1, 3, 224, 224])],
        &[port("prob", 1, &[1, 1000])],
    );
    let error = refusal(&model(&classifier));
    assert!(matches!(error, MaskNetworkError::NotRecognised { .. }));
    assert!(error.to_string().contains("data [1, 3, 224, 224] → prob [1, 1000]"), "{error}");
    let encoder = made::original_encoder(true, 256, 32);
    let error = refusal(&encoder);
    assert!(matches!(error, MaskNetworkError::WrongRole { .. }), "{error}");
}

#[test]
fn outputs_that_are_not_as_promised_are_errors() {
    let (photo, trimap) = photo(32, 32);
    let mean = |op: &[Message]| {
        let head = node("ReduceMean", &["pixel_values"], &["m"], &[made::ints("axes", &[1])]);
        vitmatte(&[[head].as_slice(), op].concat(), &[])
    };
    let four_channels = vitmatte(&[node("Identity", &["pixel_values"], &["alphas"], &[])], &[]);
    // −|m| ≤ 0 has a logarithm that is NaN or −∞
    let nan = mean(&[
        node("Abs", &["m"], &["a"], &[]),
        node("Neg", &["a"], &["n"], &[]),
        node("Log", &["n"], &["alphas"], &[]),
    ]);
    let too_large = trimap_times(7.0);
    for engine in engines() {
        for (bytes, word) in [(&four_channels, "[1, 4, 32, 32]"), (&nan, "number"), (&too_large, "0 to 1")] {
            let networks = opened_with(bytes, engine.clone()).unwrap();
            let error = networks.alpha(&photo, &trimap).unwrap_err();
            assert!(matches!(error, MaskNetworkError::Output { .. }), "{error}");
            assert!(error.to_string().contains(word), "{error}");
        }
    }
}

#[test]
fn operators_nobody_knows_are_an_error_of_the_engine_with_the_way_out() {
    let (photo, trimap) = photo(32, 32);
    let bytes = vitmatte(&[node("Teleport", &["pixel_values"], &["alphas"], &[])], &[]);
    for engine in engines() {
        let builtin = engine.is_none();
        let error = match opened_with(&bytes, engine) {
            Err(e) => e,
            Ok(networks) => networks.alpha(&photo, &trimap).unwrap_err(),
        };
        assert!(matches!(error, MaskNetworkError::Engine { .. }), "{error}");
        assert_eq!(error.hint().contains("pip install onnxruntime"), builtin, "{}", error.hint());
        assert!(!error.hint().contains("float32"));
    }
    // half-precision weights are named as another reason
    let halves = tensor("w", 10, &[2]).bytes(9, &[0; 4]);
    let bytes = vitmatte(&[node("Teleport", &["pixel_values", "w"], &["alphas"], &[])], &[halves]);
    let error = opened(&bytes).and_then(|networks| networks.alpha(&photo, &trimap)).unwrap_err();
    assert!(error.hint().contains("use the float32 file"), "{}", error.hint());
}

#[test]
fn a_panic_inside_an_engine_becomes_its_message() {
    let said = guarded::<()>(|| panic!("index {} of {}", 3, 2)).unwrap_err();
    assert_eq!(said, "it broke down: index 3 of 2");
}

#[test]
fn a_file_that_is_no_library_is_refused_with_the_way_out() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("libonnxruntime.so");
    fs::write(&path, "not a library").unwrap();
    let Err(error) = Runtime::load(&path) else { panic!("it loaded") };
    assert!(matches!(error, MaskNetworkError::Library { .. }), "{error}");
    assert!(error.hint().contains("1.17") || error.hint().contains("anew"), "{}", error.hint());
    assert!(matches!(Runtime::load(&dir.path().join("none.so")), Err(MaskNetworkError::Read(_))));
}

#[test]
fn the_engine_recorded_is_the_one_the_manifest_pins() {
    let version = tract::NAME.strip_prefix("tract ").unwrap();
    assert!(
        include_str!("../../../../Cargo.toml").contains(&format!("tract-onnx = {{ version = \"={version}\""))
    );
}
