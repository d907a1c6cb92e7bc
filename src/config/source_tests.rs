//! Which value wins, and what is said of a wrong one.

use super::{Config, Fallback, MeshFormat, Preset, Sources};
use tiface_base::Result;

fn from(file: &str, set: &[&str]) -> Result<Config> {
    let files = vec![("tiface.toml".to_string(), file.to_string())];
    Config::resolve(&Sources {
        files,
        set: set.iter().map(|s| s.to_string()).collect(),
        ..Sources::default()
    })
}

#[test]
fn the_settings_of_a_run_are_read_again_unless_they_are_not_understood() {
    let dir = tempfile::tempdir().unwrap();
    assert!(Config::of_run(dir.path()).is_none());
    let config = from("preset = \"draft\"", &["mesh.resolution=301"]).unwrap();
    std::fs::write(dir.path().join("config.toml"), config.to_toml()).unwrap();
    assert_eq!(Config::of_run(dir.path()), Some(config));
    std::fs::write(dir.path().join("config.toml"), "mesh.resolution = 'fine'").unwrap();
    assert!(Config::of_run(dir.path()).is_none());
}

#[test]
fn later_wins_default_preset_file_set() {
    let c = from("preset = \"draft\"\n[mesh]\nresolution = 300\n", &["mesh.resolution=301"]).unwrap();
    assert_eq!((c.preset, c.mesh.resolution), (Preset::Draft, 301));
    let c = from("[mesh]\nresolution = 300\npreset_is_below = 1", &[]);
    assert!(c.is_err());
    // the order of lines is no matter
    let c = from("mesh.resolution = 300\npreset = \"draft\"", &[]).unwrap();
    assert_eq!((c.mesh.resolution, c.iface), (300, Config::preset(Preset::Draft).iface));
    let c = Config::resolve(&Sources {
        preset: Some(Preset::Paper),
        files: vec![("f".into(), "preset = \"draft\"".into())],
        ..Sources::default()
    });
    assert_eq!(c.unwrap(), Config::preset(Preset::Paper));
}

#[test]
fn a_fallback_holds_until_a_source_names_a_preset() {
    let with = |file: &str, set: &[&str]| {
        let change = |c: &mut Config| (c.mesh.resolution, c.iface.steps) = (99, 7);
        let fallback: Option<Fallback> = Some((Preset::Draft, change));
        let set = set.iter().map(|s| s.to_string()).collect();
        let files = vec![("f".into(), file.into())];
        let c = Config::resolve(&Sources { fallback, files, set, ..Sources::default() }).unwrap();
        (c.preset, c.mesh.resolution, c.iface.steps)
    };
    let standard = Config::preset(Preset::Standard);
    // a file that names other keys leaves the preset, and wins over what goes with it
    assert_eq!(with("mesh.resolution = 300", &[]), (Preset::Draft, 300, 7));
    assert_eq!(with("", &["seed=1"]), (Preset::Draft, 99, 7));
    let named = (Preset::Standard, standard.mesh.resolution, standard.iface.steps);
    assert_eq!(with("preset = \"standard\"", &[]), named);
    assert_eq!(with("", &["preset=standard"]), named);
}

#[test]
fn an_unknown_key_names_its_line_and_the_nearest_known_one() {
    let e = from("seed = 1\n\n[iface]\nstep = 5\n", &[]).unwrap_err();
    assert_eq!(e.to_string(), "`tiface.toml`, line 4: there is no key `iface.step`");
    assert!(e.hint().contains("`iface.steps`"), "{}", e.hint());
    let e = from("", &["resolution=9"]).unwrap_err();
    assert_eq!(e.to_string(), "`--set resolution=9`: there is no key `resolution`");
    assert!(e.hint().contains("`mesh.resolution`"));
    // one that is an option now
    let e = from("[mesh]\nmaterial = \"lit\"\n", &[]).unwrap_err();
    assert!(e.hint().contains("`--material` of `tiface export`"), "{}", e.hint());
    assert!(from("[iface.steps]\nx = 1", &[]).unwrap_err().to_string().contains("iface.steps.x"));
    assert!(from("[nonsense]", &[]).unwrap_err().to_string().contains("nonsense"));
    assert!(from("\"iface.steps\" = 3", &[]).is_err());
}

#[test]
fn a_number_out_of_range_names_the_range() {
    let e = from("[mesh]\nresolution = 1", &[]).unwrap_err();
    assert_eq!(e.to_string(), "`tiface.toml`, line 2: `mesh.resolution` is 1, allowed is 16 to 4096");
    for bad in
        ["iface.steps=0", "iface.rays=1000000000", "capture.unit_m=nan", "capture.unit_m=inf", "seed=-1"]
    {
        assert!(from("", &[bad]).unwrap_err().to_string().contains("allowed is "), "{bad}");
    }
}

#[test]
fn a_wrong_type_and_a_wrong_word_say_what_is_expected() {
    let e = from("[mesh]\nresolution = \"fine\"", &[]).unwrap_err();
    assert_eq!(e.to_string(), "`tiface.toml`, line 2: `mesh.resolution` is an integer, found \"fine\"");
    let e = from("", &["mask.source=guess"]).unwrap_err();
    assert!(e.to_string().contains("unknown variant `guess`, expected one of `auto`, `alpha`"), "{e}");
    let e = from("", &["capture.mask_dir=~/masks"]).unwrap_err();
    assert!(e.to_string().contains("write the whole path"), "{e}");
    let e = from("", &["device=gpu"]).unwrap_err();
    assert!(e.to_string().contains("expected auto, cpu, wgpu, vulkan, metal or dx12"), "{e}");
    assert!(from("", &["device=wgpu:1"]).is_ok());
    assert!(from("preset = \"best\"", &[]).is_err());
    let e = from("", &["mesh.resolution"]).unwrap_err();
    assert_eq!(e.to_string(), "`--set mesh.resolution`: expected KEY=VALUE");
    let e = from("seed = 1\nmesh = = 2", &[]).unwrap_err();
    assert!(e.to_string().starts_with("`tiface.toml`, line 2: ") && e.hint().contains("key = value"), "{e}");
}

#[test]
fn set_needs_neither_quotes_nor_brackets() {
    let c = from("", &["mesh.format=glb,obj", "iface.steps=2e4", "capture.unit_m=1", "capture.path=a b"])
        .unwrap();
    assert_eq!(c.mesh.format, [MeshFormat::Glb, MeshFormat::Obj]);
    assert_eq!((c.iface.steps, c.capture.unit_m, c.capture.path.to_str()), (20_000, 1.0, Some("a b")));
    let c = from("", &["mesh.format=[\"ply\"]", "mask.source=\"none\""]).unwrap();
    assert_eq!(c.mesh.format, [MeshFormat::Ply]);
}

#[test]
fn constants_of_a_preset_are_no_keys_and_come_with_it() {
    let paper = Config::preset(Preset::Paper);
    let text = paper.to_toml();
    assert!(!text.contains("lr_grid") && !text.contains("step_ratio"), "{text}");
    let back = from(&text, &["tface.steps=7"]).unwrap();
    // 0.5 as published, 1.0 or more in the other presets
    assert_eq!((back.tface.steps, back.tface.step_ratio, back.iface.radius), (7, 0.5, 0.3));
    // quick has some of its own
    let quick = from(&Config::preset(Preset::Quick).to_toml(), &["tface.steps=7"]).unwrap().tface;
    let of_draft = Config::preset(Preset::Draft).tface;
    assert_eq!((quick.steps, quick.lr_network, quick.lr_final), (7, 0.002, 0.1));
    assert_eq!((of_draft.lr_network, of_draft.lr_final), (0.001, 0.01));
    assert!(from("", &["tface.step_ratio=1"]).unwrap_err().to_string().contains("there is no key"));
}

#[test]
fn the_baseline_is_tface_without_masks() {
    use crate::config::{MaskLoss, MaskUse};
    let c = from("", &["tface.voxels_final=1000000", "baseline.steps=9", "tface.fields=4"]).unwrap();
    let b = c.baseline.field(&c.tface);
    assert_eq!((b.steps, b.voxels_final, b.fields), (9, 1_000_000, 1));
    assert_eq!((b.masks, b.mask_loss), (MaskUse::None, MaskLoss::None));
}

#[test]
fn there_are_no_more_settings_than_a_person_can_survey() {
    let count = super::all_keys().count();
    assert!(count <= 110, "{count} keys");
}
