//! Which stages a changed setting makes again: what the rows of the tables say, and what the plans
//! do.

use super::inputs::capture_options;
use super::renderer::shows_head;
use super::tests::{demo_head, draft, quiet, words};
use super::*;
use crate::config::{Config, HairViews, Key, Method, Product, Sources, all_keys, key};
use crate::mask::prompts::{PhotoPrompts, Prompts, file_path, parse_point};
use std::collections::BTreeSet;
use std::path::Path;
use tiface_capture as capture;

/// Another value of a key, as `--set` takes it; of a file the same content elsewhere. `None` if the
/// key names no file.
fn another(key: &str, config: &Config, dir: &Path) -> Option<String> {
    let listed = [
        (key!(device), "cpu"),
        (key!(capture.box), "ilsh"),
        (key!(capture.mask_dir), "masks"),
        (key!(mask.source), "none"),
        (key!(mask.alpha_input), "512,imagenet"),
        (key!(tface.upsample_at), "0.1,0.2"),
        (key!(tface.mask_at), "0.2"),
        (key!(tface.density_rank), "8,8,7"),
        (key!(tface.color_rank), "24,24,23"),
        (key!(mesh.format), "glb,obj"),
        (key!(mesh.lobes), "1"),
        (key!(render.cameras), "orbit"),
        (key!(render.method), "tface,raycast"),
        (key!(ensemble.members), "raycast"),
        (key!(ensemble.weights), "0.5,0.5"),
    ];
    if let Some((_, value)) = listed.iter().find(|(name, _)| *name == key) {
        return Some(value.to_string());
    }
    let inside = dir.join("").to_str().unwrap().to_string();
    let table: toml::Table = toml::from_str(&config.to_toml()).unwrap();
    let value = key.split('.').fold(&toml::Value::Table(table), |value, part| &value[part]).clone();
    match value {
        toml::Value::Boolean(is_on) => Some((!is_on).to_string()),
        toml::Value::Integer(count) => Some((count + 1).to_string()),
        toml::Value::Float(0.0) => Some("0.01".into()),
        toml::Value::Float(number) => Some((0.99 * number).to_string()),
        toml::Value::String(_) if key == key!(capture.path) => Some(inside + "copy"),
        toml::Value::String(_) if key == key!(mask.view) => {
            let photos = capture::open(&config.capture.path, &capture_options(config)).unwrap();
            Some(photos.split(capture::Split::Train).next().unwrap().name.clone())
        }
        toml::Value::String(old) if old.starts_with(&inside) => Some(old.replace("/a.", "/b.")),
        toml::Value::String(old) => crate::config::known_words(key).into_iter().find(|word| *word != old),
        // the same click
        toml::Value::Array(list) if key == key!(mask.point) => {
            (!list.is_empty()).then(|| "[\"16.0,20,1\"]".into())
        }
        other => panic!("no other value of {key}: {other}"),
    }
}

/// Returns whether a row says that a product changes with its key, or with what the product is made
/// of.
fn is_said(row: &Key, product: Product, config: &Config) -> bool {
    let read = |stage: Stage| match stage {
        Stage::Mesh if shows_head(config, &config.render.method) => Product::Head,
        Stage::Mesh => Product::Surface,
        stage => Product::of(stage),
    };
    let mut needs = product.stage().needs(config).into_iter();
    row.affects(product, config) || needs.any(|stage| is_said(row, read(stage), config))
}

/// Settings, each with the keys that are changed there; at the first, all of which it has another
/// value.
fn cases(dir: &Path) -> Vec<(Config, Vec<&'static str>)> {
    let root = dir.join("head");
    demo_head(&root, (32, 40), (8, 2));
    demo_head(&dir.join("copy"), (32, 40), (8, 2));
    for name in ["sam", "sam_decoder", "vitmatte", "alpha_net", "lpips", "baseline", "tface"] {
        for copy in ["a", "b"] {
            std::fs::create_dir_all(dir.join(name)).unwrap();
            std::fs::write(dir.join(name).join(format!("{copy}.{name}")), name).unwrap();
        }
    }
    let file = |name: &str| dir.join(name).join(format!("a.{name}")).to_str().unwrap().to_string();
    let mut base = draft(&root);
    base.render.method = vec![Method::Baseline, Method::Tface, Method::Raycast];
    let with = |change: &dyn Fn(&mut Config)| {
        let mut config = base.clone();
        change(&mut config);
        config
    };
    let photo = &capture::open(&root, &capture_options(&base)).unwrap();
    let clicks = || PhotoPrompts {
        file_path: file_path(photo, &photo.views[0]),
        points: vec![parse_point("16,20,1").unwrap()],
    };
    for copy in ["a.json", "b.json"] {
        Prompts { frames: vec![clicks()] }.write(&dir.join(copy)).unwrap();
    }
    let clicked = with(&|c| {
        c.mask.prompts = dir.join("a.json").to_str().unwrap().into();
        (c.mask.sam, c.mask.sam_decoder) = (file("sam"), file("sam_decoder"));
        c.mask.vitmatte = file("vitmatte");
    });
    let of_clicks = vec![
        key!(mask.prompts),
        key!(mask.cut),
        key!(mask.matting),
        key!(mask.sam),
        key!(mask.sam_decoder),
        key!(mask.vitmatte),
        key!(mask.vitmatte_colors),
        key!(mask.memory_gib),
        key!(mask.side_px),
        key!(mask.band),
        key!(mask.kernel),
        key!(mask.iterations),
        key!(mask.head),
        key!(mask.trust),
    ];
    let imports = with(&|c| (c.baseline.import, c.tface.import) = (file("baseline"), file("tface")));
    let fitted_to_views = with(&|c| c.mesh.hair_views = HairViews::Tface);
    vec![
        (base.clone(), Vec::new()),
        (fitted_to_views, vec![key!(mesh.hair_views), key!(tface.steps), key!(mesh.resolution)]),
        (clicked, of_clicks),
        (with(&|c| c.mask.point = vec!["16,20,1".into()]), vec![key!(mask.point), key!(mask.view)]),
        (with(&|c| c.mask.alpha_net = file("alpha_net")), vec![key!(mask.alpha_net), key!(mask.alpha_input)]),
        (imports, vec![key!(baseline.import), key!(tface.import), key!(capture.tiles)]),
        (with(&|c| c.metrics.lpips = file("lpips")), vec![key!(metrics.lpips)]),
    ]
}

#[test]
fn every_key_makes_the_stages_again_that_its_row_says_and_no_other() {
    let dir = tempfile::tempdir().unwrap();
    let run = quiet(dir.path());
    let digests = |config: &Config| -> Vec<String> {
        let session = Session::open(config, &run).unwrap_or_else(|e| panic!("{e:?}"));
        Stage::ALL.iter().map(|stage| session.plan(*stage).fingerprint.digest()).collect()
    };
    let mut seen = BTreeSet::new();
    for (i, (config, keys)) in cases(dir.path()).iter().enumerate() {
        let before = digests(config);
        for (name, row) in all_keys().filter(|(name, _)| i == 0 || keys.contains(&name.as_str())) {
            let Some(value) = another(&name, config, dir.path()) else { continue };
            let files = vec![("before".into(), config.to_toml())];
            let set = vec![format!("{name}={value}")];
            let changed = Config::resolve(&Sources { files, set, ..Sources::default() }).unwrap();
            assert_eq!(changed.differences(config).len(), 1, "{name} is {value}");
            let after = digests(&changed);
            let made = Stage::ALL.into_iter().filter(|s| before[*s as usize] != after[*s as usize]);
            let said = Stage::ALL.into_iter().filter(|stage| {
                [config, &changed].into_iter().any(|config| is_said(row, Product::of(*stage), config))
            });
            assert_eq!(
                words(&made.collect::<Vec<_>>()),
                words(&said.collect::<Vec<_>>()),
                "{name}, case {i}"
            );
            seen.insert(name);
        }
    }
    let missed: Vec<String> = all_keys().map(|(name, _)| name).filter(|name| !seen.contains(name)).collect();
    assert!(missed.is_empty(), "{missed:?}");
}

/// What rows say, said once more of the keys whose effect is the least obvious.
#[test]
fn files_intervals_and_limits_make_nothing_again() {
    let config = Config::preset(crate::config::Preset::Draft);
    let nothing: Vec<String> =
        all_keys().filter(|(_, row)| row.affects.is_empty()).map(|(name, _)| name).collect();
    let expected = [
        key!(device),
        key!(capture.path),
        key!(mask.trust),
        key!(mask.prompts),
        key!(mask.point),
        key!(mask.view),
        key!(mask.sam),
        key!(mask.sam_decoder),
        key!(mask.vitmatte),
        key!(mask.alpha_net),
        key!(mask.memory_gib),
        key!(baseline.import),
        key!(tface.import),
        key!(tface.checkpoint_s),
        key!(iface.checkpoint_s),
        key!(metrics.lpips),
    ];
    assert_eq!(nothing, expected);
    // held-out views do not depend on the cameras of paths, and paths have no float views
    let said = |key: &str, product: Product| {
        let (_, row) = all_keys().find(|(name, _)| name == key).unwrap();
        row.affects(product, &config)
    };
    let both = |key: &str| [Product::HeldOut, Product::Path].map(|product| said(key, product));
    assert_eq!(both(key!(render.cameras)), [false, true]);
    assert_eq!(both(key!(render.float)), [true, false]);
    assert_eq!(both(key!(render.samples)), [true, true]);
    assert_eq!(both(key!(render.orbit_views)), [false, false]);
}

/// The parts of stage `mesh` that each of its keys makes again, as they were worked out by hand: a
/// view shows the head, and neither its files nor what is only in them.
#[test]
fn keys_of_the_mesh_make_its_surface_its_head_or_its_files_again() {
    let mut config = Config::preset(crate::config::Preset::Draft);
    config.mesh.hair_views = HairViews::Tface;
    let innermost = |row: &Key| {
        let parts = [(Product::Surface, "surface"), (Product::Head, "head"), (Product::Files, "files")];
        parts
            .into_iter()
            .find(|(product, _)| row.affects(*product, &config))
            .map_or("nothing", |(_, part)| part)
    };
    let of_mesh = all_keys().filter(|(name, _)| name.starts_with("mesh."));
    let found: Vec<(String, &str)> = of_mesh.map(|(name, row)| (name, innermost(row))).collect();
    let expected = [
        (key!(mesh.resolution), "surface"),
        (key!(mesh.genus), "surface"),
        (key!(mesh.cap), "surface"),
        (key!(mesh.triangles), "head"),
        (key!(mesh.max_error), "head"),
        (key!(mesh.color), "surface"),
        (key!(mesh.texture_px), "head"),
        (key!(mesh.lobes), "head"),
        (key!(mesh.hair), "head"),
        (key!(mesh.hair_views), "head"),
        (key!(mesh.normal_map), "head"),
        (key!(mesh.exr), "files"),
        (key!(mesh.format), "files"),
    ];
    let expected: Vec<(String, &str)> = expected.map(|(name, part)| (name.to_string(), part)).to_vec();
    assert_eq!(found, expected);
}
