//! `tiface export` as a user runs it: the finished mesh of a run in other files, and a run that
//! stays as it is.

use crate::command::{said, tiface};
use crate::kept::{copy_run, once};
use crate::tiny::{FIELD, capture};
use glam::Vec3;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use tiface::geom::topology;
use tiface::io::{Limits, parse_photo, parse_picture_info, read_tensors};
use tiface::mesh::files::{HeadMesh, PictureSource, ReadMesh, ReadOptions, read_with, weld};

/// A mesh in all formats, and views of it that need no radiance field.
const SETTINGS: &str = "mesh.triangles=600 mesh.texture_px=128 mesh.format=glb,obj,ply render.method=textured \
    ensemble.members=";

fn worked(folder: &Path, words: &[&str]) -> String {
    let output = tiface(folder, words);
    assert!(output.status.success(), "{words:?}: {}", said(&output));
    said(&output)
}

/// Makes all stages of a run, up to its metrics. The head is learned once; its mesh is made again
/// with these settings.
fn finished(folder: &Path, more: &[&str]) -> PathBuf {
    let kept = once("to export", |folder| {
        capture(folder);
        let mut words = vec!["run", "head", "--run", "run", "--preset", "draft"];
        let settings = FIELD.split_whitespace().chain(SETTINGS.split_whitespace());
        settings.for_each(|set| words.extend(["--set", set]));
        worked(folder, &words);
    });
    let run = copy_run(&kept, folder, "runs/head");
    if !more.is_empty() {
        let settings: Vec<&str> = more.iter().flat_map(|set| ["--set", *set]).collect();
        worked(folder, &[&["run", "runs/head", "--fresh", "mesh"], &settings[..]].concat());
    }
    run
}

/// All files of a folder with their bytes.
fn files(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            found.extend(files(&path));
        } else {
            found.insert(path.clone(), std::fs::read(&path).unwrap());
        }
    }
    found
}

fn names(folder: &Path) -> Vec<String> {
    let names = std::fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap());
    let mut names: Vec<String> = names.collect();
    names.sort();
    names
}

fn mesh(file: &Path) -> ReadMesh {
    read_with(&std::fs::read(file).unwrap(), file, &ReadOptions::default()).unwrap()
}

/// The JSON of a GLB.
fn document(file: &Path) -> serde_json::Value {
    let glb = std::fs::read(file).unwrap();
    let length = u32::from_le_bytes(glb[12..16].try_into().unwrap()) as usize;
    serde_json::from_slice(&glb[20..20 + length]).unwrap()
}

#[test]
fn without_options_the_files_are_those_of_the_stage_whatever_was_exported_before() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &["mesh.lobes=1", "mesh.hair=shells"]);
    let before = files(&run);
    // photographs are not asked for
    std::fs::rename(dir.path().join("head"), dir.path().join("moved")).unwrap();
    let output = worked(dir.path(), &["export", "runs/head", "--format", "glb,obj,ply", "--out", "again/"]);
    let in_all = ["head.glb", "head.mtl", "head.obj", "head.ply", "head.png"];
    assert_eq!(names(&dir.path().join("again")), in_all);
    for (file, bytes) in files(&dir.path().join("again")) {
        let own = run.join("mesh").join(file.file_name().unwrap());
        assert!(before[&own] == bytes, "{} differs from the stage's", file.display());
    }
    let megabytes = before[&run.join("mesh/head.glb")].len() as f64 / 1e6;
    assert!(output.contains(&format!("export    again/head.glb  {megabytes:.2} MB\n")), "{output}");
    // other options in between, which nothing remembers
    let other = ["--material", "lit", "--frame", "head", "--measure", "0,0,0", "0,0,1", "0.3", "--jpeg"];
    worked(dir.path(), &[&["export", "runs/head", "--out", "other.glb"][..], &other].concat());
    // by the ending alone, under another name, and by no option at all
    worked(dir.path(), &["export", "runs/head", "--out", "Other.GLB", "--quiet"]);
    let json = worked(dir.path(), &["export", "runs/head", "--json"]);
    let json: serde_json::Value = serde_json::from_str(json.lines().last().unwrap()).unwrap();
    assert_eq!(json["out"], serde_json::json!(["head.glb"]));
    assert_eq!(json["bytes"][0], before[&run.join("mesh/head.glb")].len());
    assert_eq!(json["triangles"], 600);
    let size = weld(&mesh(&dir.path().join("head.glb")).mesh).bounds().size();
    let told: Vec<f32> = serde_json::from_value(json["size_m"].clone()).unwrap();
    assert!(size.to_array().iter().zip(&told).all(|(a, b)| (a - b).abs() < 1e-5), "{size} {told:?}");
    let again = worked(dir.path(), &["export", "runs/head", "--dry-run"]);
    assert!(again.contains("would replace `head.glb`"), "{again}");
    let again = worked(dir.path(), &["export", "runs/head"]);
    assert!(again.contains("replaces `head.glb`"), "{again}");
    for file in ["Other.GLB", "head.glb"] {
        assert!(
            std::fs::read(dir.path().join(file)).unwrap() == before[&run.join("mesh/head.glb")],
            "{file}"
        );
    }
    worked(dir.path(), &["check", "Other.GLB", "--require", "watertight", "--require", "sound-uv"]);
    assert!(worked(dir.path(), &["run", "runs/head"]).contains("metrics: already done"));
    assert!(before == files(&run), "the export has changed the run");
}

#[test]
fn a_file_has_the_material_frame_size_and_picture_that_are_asked_for() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &["mesh.hair=shells"]);
    let before = files(&run);
    let options = ["--material", "lit", "--frame", "head", "--jpeg", "--unit", "cm"];
    let measure = ["--measure", "0,0,0", "0.3,0,0.4", "0.25"]; // half of what the dataset says
    let words = ["export", "runs/head", "--format", "glb,obj", "--out", "new/"];
    worked(dir.path(), &[&words[..], &options, &measure].concat());
    worked(dir.path(), &["export", "runs/head", "--format", "glb,obj", "--out", "plain/"]);
    assert_eq!(names(&dir.path().join("new")), ["head.glb", "head.jpg", "head.mtl", "head.obj"]);
    assert!(before == files(&run));
    let document = |file: &str| document(&dir.path().join(file));
    assert!(document("plain/head.glb")["extensionsUsed"].to_string().contains("unlit"));
    // lobes, if it has some, are variants
    assert!(!document("new/head.glb")["extensionsUsed"].to_string().contains("unlit"));
    let bounds = |file: &str| weld(&mesh(&dir.path().join(file)).mesh).bounds();
    let (plain, new, obj) = (bounds("plain/head.glb"), bounds("new/head.glb"), bounds("new/head.obj"));
    // the demo's cameras stand around it: only what is up is the same in both frames
    assert!((new.size().y / plain.size().y - 0.5).abs() < 1e-4, "{} {}", new.size(), plain.size());
    assert!(new.center().length() < 1e-3 * new.size().y && plain.center().length() > 0.01);
    assert!((obj.size() / new.size() - 100.0).abs().max_element() < 0.01, "{} {}", obj.size(), new.size());
    // the stage's formats alone can be changed, which needs no stage
    let other = tiface(dir.path(), &["mesh", "runs/head", "--format", "obj"]);
    assert!(
        other.status.code() == Some(1)
            && said(&other).contains("`tiface export runs/head --format obj` writes")
    );
    let plan = worked(dir.path(), &["mesh", "runs/head", "--fresh", "mesh", "--format", "obj", "--dry-run"]);
    assert!(plan.contains("mesh     to do again: removes "), "{plan}");
    assert!(plan.contains("`tiface export runs/head --format obj` writes these files"), "{plan}");
    assert!(before == files(&run));
}

#[test]
fn levels_of_detail_halve_are_closed_and_lie_in_one_place() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &[]);
    let before = files(&run);
    let words = ["export", "runs/head", "--lod", "2", "--format", "glb,ply", "--frame", "head"];
    let json = worked(dir.path(), &[&words[..], &["--out", "lod/", "--json"]].concat());
    let json = json.lines().find(|line| line.starts_with('{')).unwrap(); // a warning follows
    let json: serde_json::Value = serde_json::from_str(json).unwrap();
    let all = ["head.glb", "head.ply", "head_lod1.glb", "head_lod1.ply"];
    assert_eq!(names(&dir.path().join("lod")), all);
    let level = &json["levels"][0];
    let (largest, mean) = (level["largest_mm"].as_f64().unwrap(), level["mean_mm"].as_f64().unwrap());
    assert!(level["triangles"].as_u64().unwrap() <= 300 && 0.0 < mean && mean < largest, "{level}");
    let mesh = |file: &str| weld(&mesh(&dir.path().join("lod").join(file)).mesh);
    let [full, half] = ["head.glb", "head_lod1.glb"].map(mesh);
    assert!(full.is_closed() && half.is_closed() && half.triangles.len() <= 300);
    // no vertex of the smaller one lies farther from the box of the first than is told
    let (outer, inner) = (full.bounds(), half.bounds());
    let beyond = (inner.max - outer.max).max(outer.min - inner.min).max_element();
    assert!(f64::from(beyond) <= 1e-3 * largest + 1e-6, "{beyond} {largest}");
    // more triangles than the run's files have, from the surface that it keeps
    worked(dir.path(), &["export", "runs/head", "--triangles", "900", "--out", "more.glb"]);
    let more = weld(&self::mesh(&dir.path().join("more.glb")).mesh);
    assert!((850..=900).contains(&more.triangles.len()) && more.is_closed(), "{}", more.triangles.len());
    let all = worked(dir.path(), &["export", "runs/head", "--triangles", "90000", "--out", "all.glb"]);
    let count = weld(&self::mesh(&dir.path().join("all.glb")).mesh).triangles.len();
    assert!(all.contains(&format!("the surface has {count} triangles, which are all written")), "{all}");
    let refused = tiface(dir.path(), &["export", "runs/head", "--lod", "9", "--out", "a.glb"]);
    assert!(refused.status.code() == Some(2) && said(&refused).contains("--lod"), "{}", said(&refused));
    assert!(before == files(&run));
}

#[test]
fn a_compressed_head_is_small_and_says_what_a_reader_needs() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &[]);
    worked(dir.path(), &["export", "runs/head", "--compress", "--out", "small.glb"]);
    let small = document(&dir.path().join("small.glb"));
    let required = small["extensionsRequired"].to_string();
    assert!(required.contains("EXT_meshopt_compression"), "{required}");
    let plain = document(&run.join("mesh/head.glb"));
    let count = |document: &serde_json::Value| document["accessors"][0]["count"].clone();
    assert_eq!(count(&small), count(&plain));
    assert_eq!(small["images"][0]["mimeType"], "image/jpeg");
    let bytes = |file: &Path| std::fs::metadata(file).unwrap().len();
    assert!(2 * bytes(&dir.path().join("small.glb")) < bytes(&run.join("mesh/head.glb")));
    let refused = tiface(dir.path(), &["export", "runs/head", "--compress", "--out", "a.ply"]);
    assert!(refused.status.code() == Some(2) && said(&refused).contains("`--compress` does not affect .ply"));
}

#[test]
fn a_mesh_file_goes_to_the_other_formats_and_sizes() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &[]);
    for file in ["head.glb", "head.obj", "head.mtl", "head.png"] {
        std::fs::copy(run.join("mesh").join(file), dir.path().join(file)).unwrap();
    }
    let before = files(dir.path());
    worked(dir.path(), &["export", "head.obj", "--format", "glb,obj,ply,usdz", "--out", "all/"]);
    let all = ["head.glb", "head.mtl", "head.obj", "head.ply", "head.png", "head.usdz"];
    assert_eq!(names(&dir.path().join("all")), all);
    let shape = |file: &str| {
        let mesh = weld(&mesh(&dir.path().join(file)).mesh);
        (mesh.triangles.len(), mesh.is_closed(), mesh.bounds())
    };
    let (triangles, closed, bounds) = shape("head.glb");
    assert!(closed);
    for file in ["all/head.glb", "all/head.obj", "all/head.ply"] {
        let (n, closed, b) = shape(file);
        assert!((n, closed) == (triangles, true), "{file}");
        assert!((b.size() - bounds.size()).abs().max_element() < 1e-5, "{file}: {}", b.size());
    }
    let picture = |file: &str| match mesh(&dir.path().join(file)).picture {
        Some(PictureSource::Inside(picture)) => picture,
        _ => panic!("{file} has no picture"),
    };
    let pixels = |file: &str| parse_photo(&picture(file), Path::new(file), &Limits::default()).unwrap().rgb;
    assert!(pixels("all/head.glb") == pixels("head.glb"));
    worked(dir.path(), &["export", "head.glb", "--up", "z", "--out", "turned.glb"]);
    let (turned, size) = (shape("turned.glb").2.size(), bounds.size());
    assert!((turned - Vec3::new(size.x, size.z, size.y)).abs().max_element() < 1e-5, "{turned} {size}");
    worked(
        dir.path(),
        &["export", "head.glb", "--triangles", "300", "--texture", "64", "--out", "small.glb"],
    );
    let (n, closed, _) = shape("small.glb");
    assert!(n <= 300 && n > 250 && closed, "{n}");
    worked(dir.path(), &["check", "small.glb", "--require", "sound-uv"]);
    for (words, code, text) in [
        (&["head.glb"][..], 2, "head.glb` is the file that is read"),
        (
            &["head.glb", "--frame", "head", "--out", "a.glb"],
            2,
            "`--frame head` needs to know where the face looks",
        ),
        (&["absent.glb", "--out", "a.glb"], 1, "absent.glb"),
    ] {
        let output = tiface(dir.path(), &[&["export"][..], words].concat());
        assert_eq!(output.status.code(), Some(code), "{words:?}: {}", said(&output));
        assert!(said(&output).contains(text), "{words:?}: {}", said(&output));
    }
    // a picture that the mesh needs, or that belongs to something else, is not replaced
    std::fs::rename(dir.path().join("head.obj"), dir.path().join("scan.obj")).unwrap();
    for source in ["scan.obj", "head.glb"] {
        let words = ["export", source, "--texture", "64", "--out", "head.obj"];
        let output = tiface(dir.path(), &words);
        assert_eq!(output.status.code(), Some(2), "{words:?}: {}", said(&output));
        assert!(
            said(&output).contains("head.mtl` ") || said(&output).contains("head.png` "),
            "{}",
            said(&output)
        );
    }
    std::fs::rename(dir.path().join("scan.obj"), dir.path().join("head.obj")).unwrap();
    let refused = tiface(dir.path(), &["export", run.to_str().unwrap(), "--up", "z", "--out", "a.glb"]);
    assert!(refused.status.code() == Some(2) && said(&refused).contains("a run has its own up axis"));
    assert!(before.iter().all(|(file, bytes)| std::fs::read(file).unwrap() == *bytes));
    // a texture that is gone is not left out in silence
    std::fs::remove_file(dir.path().join("head.png")).unwrap();
    let refused = tiface(dir.path(), &["export", "head.obj", "--out", "bare.glb"]);
    assert!(
        refused.status.code() == Some(1) && said(&refused).contains("`--texture 0`"),
        "{}",
        said(&refused)
    );
}

#[test]
fn a_head_that_was_cut_lost_or_changed_is_noticed_and_put_back() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &[]);
    let head = run.join("mesh/head.glb");
    let whole = std::fs::read(&head).unwrap();
    let put_back = ["export", "runs/head", "--out", "runs/head/mesh/head.glb"];
    let named = format!("tiface {}", put_back.join(" "));
    let ends = |words: &[&str], code: i32, what: &str| {
        let output = tiface(dir.path(), words);
        assert_eq!(output.status.code(), Some(code), "{words:?}: {}", said(&output));
        assert!(said(&output).contains(what), "{words:?}: {}", said(&output));
    };
    std::fs::write(&head, &whole[..whole.len() / 2]).unwrap();
    for (words, code) in [("run", 1), ("report", 1), ("check", 3), ("status", 3), ("verify", 3)] {
        ends(&[words, "runs/head"], code, &named);
    }
    // another mesh does not take its place, and no other file is written into the run
    let smaller = [&put_back[..], &["--triangles", "300"]].concat();
    ends(&smaller, 2, "another `head.glb` than the run's");
    ends(&["export", "runs/head", "--out", "runs/head/mesh/other.glb"], 2, "is inside the run");
    worked(dir.path(), &put_back);
    assert!(std::fs::read(&head).unwrap() == whole);
    worked(dir.path(), &["verify", "runs/head"]);

    // a user may move it away: the run is done, and the file is not shown as there
    std::fs::remove_file(&head).unwrap();
    for words in ["run", "status", "report"] {
        worked(dir.path(), &[words, "runs/head"]);
    }
    for words in ["run", "status"] {
        ends(&[words, "runs/head"], 0, &named);
    }
    assert!(!worked(dir.path(), &["run", "runs/head"]).contains("mesh      runs/head/mesh/head.glb"));
    ends(&["check", "runs/head"], 1, &named);
    ends(&["verify", "runs/head"], 3, &named);
    let page = std::fs::read_to_string(run.join("report.html")).unwrap();
    assert!(page.contains("tiface export runs"), "the page says nothing about it");
    worked(dir.path(), &put_back);

    // what keeps its size shows by its digest only
    let mut changed = whole.clone();
    let middle = changed.len() - 9;
    changed[middle] ^= 1;
    std::fs::write(&head, &changed).unwrap();
    ends(&["verify", "runs/head"], 3, "has other contents than the stage `mesh` left");
    ends(&["check", "runs/head"], 3, "has other contents than the stage `mesh` left");
    worked(dir.path(), &put_back);
    assert!(std::fs::read(&head).unwrap() == whole);
    worked(dir.path(), &["check", "runs/head"]);
}

#[test]
fn a_smaller_head_is_watertight_and_keeps_its_texture() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(
        dir.path(),
        &["mesh.normal_map=true", "mesh.color=network", "mesh.lobes=1", "mesh.hair=shells"],
    );
    let before = files(&run);
    let words = ["export", "runs/head", "--triangles", "300", "--texture", "64"];
    worked(dir.path(), &[&words[..], &["--format", "glb,obj", "--out", "small/"]].concat());
    worked(dir.path(), &["export", "runs/head", "--texture", "64", "--out", "coarse.glb"]);
    worked(dir.path(), &["export", "runs/head", "--triangles", "300", "--out", "few.ply"]);
    assert!(before == files(&run));
    for (file, triangles) in [("small/head.glb", 300), ("small/head.obj", 300), ("coarse.glb", 600)] {
        let found = mesh(&dir.path().join(file));
        let closed = weld(&found.mesh);
        assert!(closed.triangles.len() <= triangles && closed.triangles.len() > triangles * 9 / 10, "{file}");
        assert!(closed.is_closed() && topology(&closed.positions, &closed.triangles).is_solid(), "{file}");
        if let Some(PictureSource::Inside(picture)) = &found.picture {
            let info = parse_picture_info(picture, Path::new(file), &Limits::default()).unwrap();
            assert_eq!(info.size(None), (64, 64), "{file}");
        }
        let bars = ["manifold", "no-self-intersections", "sound-uv"];
        let bars: Vec<&str> = bars.iter().flat_map(|bar| ["--require", bar]).collect();
        worked(dir.path(), &[&["check", file][..], &bars].concat());
    }
    // a normal map, its tangents and four lobes are there as before
    for file in ["small/head.glb", "coarse.glb"] {
        let document = document(&dir.path().join(file));
        assert_eq!(document["images"].as_array().unwrap().len(), 6, "{file}");
        let attributes = &document["meshes"][0]["primitives"][0]["attributes"];
        assert!(attributes.get("TANGENT").is_some(), "{file}");
    }
    let few = mesh(&dir.path().join("few.ply")).mesh;
    assert!(few.is_closed() && few.triangles.len() <= 300 && few.colors.len() == few.positions.len());
    // both without a texture, too
    worked(
        dir.path(),
        &[
            &["export", "runs/head", "--texture", "0", "--out", "bare.glb"][..],
            &["--no-lobes", "--no-normal-map"],
        ]
        .concat(),
    );
    let bare = mesh(&dir.path().join("bare.glb"));
    assert!(bare.picture.is_none() && bare.mesh.is_closed() && !bare.mesh.colors.is_empty());
}

/// The text of the stage in a USDZ, which is its first file.
fn stage_of(file: &Path) -> String {
    let usdz = std::fs::read(file).unwrap();
    let number = |at: usize, length: usize| {
        usdz[at..at + length].iter().rev().fold(0, |sum, &byte| sum << 8 | usize::from(byte))
    };
    let (size, start) = (number(22, 4), 30 + number(26, 2) + number(28, 2));
    assert_eq!((&usdz[..4], &usdz[30..39], start % 64), (&b"PK\x03\x04"[..], &b"head.usda"[..], 0));
    String::from_utf8(usdz[start..start + size].to_vec()).unwrap()
}

#[test]
fn a_usdz_shows_the_mesh_of_the_glb_and_is_not_read_back() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &["mesh.format=usdz", "mesh.color=network", "mesh.lobes=1"]);
    let before = files(&run);
    let own = run.join("mesh/head.usdz");
    worked(dir.path(), &["export", "runs/head", "--out", "Other.USDZ"]);
    assert!(std::fs::read(dir.path().join("Other.USDZ")).unwrap() == before[&own], "not the stage's");
    let settings = ["--format", "glb,usdz", "--material", "lit", "--frame", "head"];
    let said_of = worked(dir.path(), &[&["export", "runs/head", "--out", "new/"][..], &settings].concat());
    assert!(said_of.contains("a .usdz has no place for 4 textures"), "{said_of}");
    assert_eq!(names(&dir.path().join("new")), ["head.glb", "head.usdz"]);
    assert!(before == files(&run));
    let (unlit, lit) = (stage_of(&own), stage_of(&dir.path().join("new/head.usdz")));
    assert!(unlit.contains("emissiveColor.connect") && lit.contains("diffuseColor.connect"));
    let shown = weld(&mesh(&dir.path().join("new/head.glb")).mesh);
    let numbers = |name: &str| -> Vec<f32> {
        let line = lit.lines().find_map(|line| line.trim_start().strip_prefix(name)).unwrap();
        let list = line.split_once('[').unwrap().1.split_once(']').unwrap().0;
        list.split(',').map(|word| word.trim_matches(['(', ')']).parse().unwrap()).collect()
    };
    assert_eq!(numbers("int[] faceVertexIndices = ").len(), 3 * shown.triangles.len());
    assert_eq!(numbers("int[] primvars:st:indices = ").len(), 3 * shown.triangles.len());
    assert_eq!(numbers("point3f[] points = ").len(), 3 * shown.positions.len());
    let (extent, bounds) = (numbers("float3[] extent = "), shown.bounds());
    assert_eq!(extent, [bounds.min.to_array(), bounds.max.to_array()].concat());
    assert!(numbers("texCoord2f[] primvars:st = ").iter().all(|v| (0.0..=1.0).contains(v)));
    // the report offers it to browsers that show it, while it is there
    let offers = || {
        let page = std::fs::read_to_string(run.join("report.html")).unwrap();
        page.contains("<a rel=\"ar\" href=")
    };
    assert!(offers());
    // it is an export, but no mesh that is read
    for (words, text) in [
        (&["check", "Other.USDZ"][..], "USDZ"),
        (&["preview", "Other.USDZ", "--size", "16"], "USDZ"),
        (&["check", "runs/head"], "`tiface export runs/head --out head.glb`"),
    ] {
        let output = tiface(dir.path(), words);
        assert_eq!(output.status.code(), Some(1), "{words:?}: {}", said(&output));
        assert!(said(&output).contains(text) && said(&output).contains("not read"), "{}", said(&output));
    }
    std::fs::remove_file(&own).unwrap();
    worked(dir.path(), &["report", "runs/head"]);
    assert!(!offers());
    let verified = tiface(dir.path(), &["verify", "runs/head"]);
    let put_back = "tiface export runs/head --out runs/head/mesh/head.usdz";
    assert!(verified.status.code() == Some(3) && said(&verified).contains(put_back), "{}", said(&verified));
    worked(dir.path(), &put_back.split(' ').skip(1).collect::<Vec<_>>());
    assert!(std::fs::read(&own).unwrap() == before[&own]);
    worked(dir.path(), &["report", "runs/head"]);
    assert!(offers());
}

#[test]
fn what_cannot_be_exported_is_refused_by_name_and_leaves_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &["mesh.lobes=0"]);
    std::fs::create_dir(dir.path().join("began")).unwrap();
    std::fs::copy(run.join("config.toml"), dir.path().join("began/config.toml")).unwrap();
    let (before, here) = (files(&run), names(dir.path()));
    for (words, code, texts) in [
        (&["began"][..], 1, &["`began` has no mesh yet", "tiface mesh began"][..]),
        (&["head"], 2, &["`head` is not a run"]),
        (&["absent"], 1, &["`absent`"]),
        (&["--out", "head.fbx"], 2, &["end it in .glb, .obj, .ply, .usdz, or in `/`"]),
        (&["--out", "absent/head.glb"], 1, &["the folder `absent` does not exist"]),
        (&["--out", "runs/head/head.glb"], 2, &["is inside the run"]),
        (&["--out", "runs/head/new/"], 2, &["is inside the run"]),
        (&["--format", "stl"], 2, &["invalid value 'stl'", "glb, obj, ply, usdz"]),
        (&["--format", "ply", "--out", "a.glb"], 2, &["one .glb", "--format"]),
        (&["--material", "matte"], 2, &["invalid value 'matte'", "unlit, lit"]),
        (
            &["--material", "lit", "--out", "a.obj"],
            2,
            &["`--material` does not affect .obj files, which have no choice of material", "write .glb"],
        ),
        (&["--frame", "head", "--out", "a.ply"], 2, &["`--frame` does not affect .ply files"]),
        (&["--unit", "cm", "--out", "a.glb"], 2, &["`--unit` does not affect .glb files", "write .obj"]),
        (&["--texture", "64", "--out", "a.ply"], 2, &[".ply files, which have no texture"]),
        (&["--texture", "256", "--out", "a.usdz"], 2, &["`--texture` is 256"]),
        (
            &["--texture", "256"],
            2,
            &["`--texture` is 256", "a texture of 128", "--fresh mesh --set mesh.texture_px=256"],
        ),
        (&["--triangles", "0"], 2, &["invalid value '0'"]),
        (&["--height=-1"], 2, &["above 0"]),
        (&["--measure", "0,0,0", "0,0,0", "1"], 2, &["have no distance"]),
        (&["--measure", "0,0", "0,0,1", "1"], 2, &["`0,0` is no point", "x,y,z"]),
        (&["--measure", "0,0,0", "0,0,1", "0"], 2, &["above 0"]),
        (&["--set", "mesh.resolution=64"], 2, &["`--set` has no effect on `export`"]),
    ] {
        let run = if ["began", "head", "absent"].contains(&words[0]) { &[][..] } else { &["runs/head"] };
        for dry in [&["--dry-run"][..], &[]] {
            let output = tiface(dir.path(), &[&["export"][..], run, words, dry].concat());
            let text = said(&output);
            assert_eq!(output.status.code(), Some(code), "{words:?}: {text}");
            let helps = text.contains("hint: ") || text.contains("try '--help'");
            assert!(text.contains("error: ") && helps, "{words:?}: {text}");
            texts.iter().for_each(|said| assert!(text.contains(said), "{words:?}: {text}"));
        }
    }
    let plan = worked(dir.path(), &["export", "runs/head", "--format", "obj", "--dry-run"]);
    assert!(plan.contains("would write `head.obj`"), "{plan}");
    // one of the formats shows it: the other is named, and written
    let mixed = worked(
        dir.path(),
        &["export", "runs/head", "--format", "glb,ply", "--material", "lit", "--out", "mixed/"],
    );
    assert!(mixed.contains(".ply files, which have no choice of material"), "{mixed}");
    std::fs::remove_dir_all(dir.path().join("mixed")).unwrap();
    assert!(before == files(&run) && here == names(dir.path()), "{:?}", names(dir.path()));
}

#[test]
fn a_mesh_that_was_cut_or_changed_is_not_exported() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &[]);
    let parts = run.join("mesh/parts");
    let export = || tiface(dir.path(), &["export", "runs/head", "--out", "out.glb"]);
    let good = std::fs::read(run.join("mesh/head.glb")).unwrap();
    for file in ["mesh/parts/geometry.safetensors", "mesh/parts/color.png", "cameras.json", "mesh/done.json"]
    {
        let path = run.join(file);
        let whole = std::fs::read(&path).unwrap();
        let mut changed = whole.clone();
        // a byte within the compressed picture, or within the names of tensors
        let at = if file.ends_with("png") { whole.len() / 2 } else { 20 };
        changed[at] ^= 0x55;
        for bytes in [Some(&whole[..whole.len() / 2]), Some(&changed), None] {
            match bytes {
                Some(bytes) => std::fs::write(&path, bytes).unwrap(),
                None => std::fs::remove_file(&path).unwrap(),
            }
            let output = export();
            let text = said(&output);
            assert_eq!(output.status.code(), Some(1), "{file}: {text}");
            assert!(
                text.contains("hint: ") && (text.contains(file) || file.ends_with("done.json")),
                "{file}: {text}"
            );
            assert!(!dir.path().join("out.glb").exists());
        }
        std::fs::write(&path, &whole).unwrap();
    }
    // of the right size, and readable, but not what the stage left: a triangle is turned over
    let geometry = parts.join("geometry.safetensors");
    let whole = std::fs::read(&geometry).unwrap();
    let mut head = HeadMesh::load(&parts).unwrap();
    head.mesh.triangles[7].swap(0, 1);
    head.save(&parts).unwrap();
    assert_eq!(std::fs::read(&geometry).unwrap().len(), whole.len());
    assert!(read_tensors(&geometry, &Limits::default()).is_ok());
    let output = export();
    assert!(
        output.status.code() == Some(1)
            && said(&output).contains("has other contents than the stage `mesh` left"),
        "{}",
        said(&output)
    );
    std::fs::write(&geometry, &whole).unwrap();
    // files that the export does not read are only named
    std::fs::write(run.join("mesh/head.glb"), "cut").unwrap();
    let output = export();
    assert!(output.status.success() && said(&output).contains("head.glb` has 3 bytes"), "{}", said(&output));
    assert!(std::fs::read(dir.path().join("out.glb")).unwrap() == good);
}

#[test]
#[cfg(target_os = "linux")]
fn a_place_that_cannot_be_written_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let run = finished(dir.path(), &[]);
    let before = files(&run);
    let output = tiface(dir.path(), &["export", "runs/head", "--out", "/proc/head.glb"]);
    assert!(output.status.code() == Some(1) && said(&output).contains("`/proc"), "{}", said(&output));
    assert!(before == files(&run));
}
