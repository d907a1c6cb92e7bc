//! The command line as a user sees it: exit codes, messages, streams.

use crate::command::{code, command, err, out, tiface};
use crate::kept::photographed;
use std::path::{Path, PathBuf};
use std::process::Command;
use tiface::capture::synthetic::{SyntheticOptions, write_borders};
use tiface::io::{Limits, read_gray, write_png_gray};

#[test]
fn help_and_version_end_with_0_and_nonsense_with_2() {
    let dir = tempfile::tempdir().unwrap();
    for words in [&["--help"][..], &["-h"], &["--version"], &["help", "mesh"], &["mesh", "--help"]] {
        assert_eq!(code(&tiface(dir.path(), words)), 0, "{words:?}");
    }
    for words in [&["frobnicate"][..], &["run", "--no-such-option"], &[]] {
        assert_eq!(code(&tiface(dir.path(), words)), 2, "{words:?}");
    }
    assert!(out(&tiface(dir.path(), &["--help"])).contains("Exit codes"));
    let o = tiface(dir.path(), &["run", "head", "--fresh", "tfaec"]);
    assert!(code(&o) == 2 && err(&o).contains("mask, baseline, tface, iface, mesh, render"), "{}", err(&o));
}

#[test]
fn a_wrong_key_is_refused_with_2_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("my.toml"), "[iface]\nstep = 5\n").unwrap();
    let o = tiface(dir.path(), &["config", "-c", "my.toml"]);
    assert_eq!(code(&o), 2);
    assert_eq!(
        err(&o),
        "error: `my.toml`, line 2: there is no key `iface.step`\n\nhint: did you mean `iface.steps`? `tiface config` lists all keys\n"
    );
    let o = tiface(dir.path(), &["config", "--device", "toaster"]);
    assert_eq!(code(&o), 2);
    assert!(err(&o).contains("`--device toaster`: `device`: unknown device `toaster`"), "{}", err(&o));
}

#[test]
fn the_preset_of_the_environment_is_a_default_that_a_run_wins_over() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("run")).unwrap();
    let saved = tiface(dir.path(), &["config", "--preset", "draft", "--set", "mesh.resolution=77"]);
    std::fs::write(dir.path().join("run/config.toml"), &saved.stdout).unwrap();
    let with = |preset: &str, words: &[&str]| {
        command(dir.path(), words).env("TIFACE_PRESET", preset).output().unwrap()
    };
    assert_eq!(out(&with("paper", &["config", "run"])), out(&saved));
    let paper = tiface(dir.path(), &["config", "--preset", "paper"]);
    assert_eq!(out(&with("paper", &["config"])), out(&paper));
    assert_eq!(out(&with("draft", &["config", "run", "--preset", "paper"])), out(&paper));
    let o = with("papper", &["config"]);
    assert!(code(&o) == 2 && err(&o).contains("`TIFACE_PRESET`"), "{}", err(&o));
}

#[test]
fn the_effective_configuration_is_printed_and_accepted_again() {
    let dir = tempfile::tempdir().unwrap();
    let first = tiface(dir.path(), &["config", "--preset", "draft", "--set", "mesh.resolution=77"]);
    assert_eq!(code(&first), 0);
    std::fs::write(dir.path().join("a.toml"), &first.stdout).unwrap();
    let again = tiface(dir.path(), &["config", "-c", "a.toml"]);
    assert_eq!(out(&first), out(&again));
    assert!(out(&again).contains("resolution = 77"));
    let explained = tiface(dir.path(), &["config", "--explain", "iface.steps"]);
    assert!(out(&explained).contains("allowed: 1 to"), "{}", out(&explained));
}

#[test]
fn a_folder_that_is_no_capture_ends_with_1_and_a_hint() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("empty")).unwrap();
    for words in [["run", "empty"], ["inspect", "empty"], ["run", "absent"]] {
        let o = tiface(dir.path(), &words);
        assert_eq!(code(&o), 1, "{words:?}: {}", err(&o));
        assert!(!dir.path().join("runs").exists());
    }
    assert!(err(&tiface(dir.path(), &["run", "empty"])).contains("hint: "));
    let o = tiface(dir.path(), &["mesh"]);
    assert_eq!(code(&o), 2, "{}", err(&o));
}

#[test]
fn a_dry_run_names_only_the_stages_a_command_needs() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let stages = |words: &[&str]| {
        let o = tiface(dir.path(), &[words, &["head", "--dry-run"]].concat());
        assert_eq!(code(&o), 0, "{words:?}: {}", err(&o));
        let first = |l: &str| l.split(' ').next().unwrap_or_default().to_string();
        // the last row is all of them together
        out(&o).lines().map(first).filter(|word| word != "all").collect::<Vec<_>>().join(" ")
    };
    assert_eq!(stages(&["tface", "--set", "tface.mask_loss=ce"]), "mask tface");
    assert_eq!(stages(&["run"]), "mask tface iface mesh render ensemble metrics");
    // the others without masks, whose check takes as long as all else
    for (words, expected) in [
        (&["baseline"][..], "mask baseline"),
        (&["mesh"], "mask iface mesh"),
        (&["render", "--with", "tface"], "mask tface render"),
        (&["render", "--with", "iface"], "mask iface render"),
        (&["run", "--preset", "paper"], "mask baseline tface iface mesh render ensemble metrics"),
    ] {
        assert_eq!(stages(&[words, &["--set", "mask.source=none"]].concat()), expected);
    }
    assert!(!dir.path().join("runs").exists());
}

/// A capture of eight photographs and a held-out one in `folder/head`.
fn small_head(folder: &Path) -> PathBuf {
    let options = SyntheticOptions { width: 32, height: 40, train: 8, test: 1, seed: 1 };
    photographed(&folder.join("head"), &options);
    folder.join("head")
}

/// A capture of this many photographs of the synthetic head and a held-out one, large enough that
/// masks which contradict each other show.
fn head_of(folder: &Path, train: usize) -> PathBuf {
    let options = SyntheticOptions { width: 48, height: 60, train, test: 1, seed: 1 };
    photographed(&folder.join("head"), &options);
    folder.join("head")
}

/// A capture of 12 + 1 photographs.
fn head(folder: &Path) -> PathBuf {
    head_of(folder, 12)
}

/// Rewrites the mask of a view, value by value.
fn remask(head: &Path, view: usize, value: impl Fn(u8) -> u8) {
    let file = head.join(format!("masks/{view:03}.png"));
    let mut mask = read_gray(&file, None, &Limits::default()).unwrap();
    mask.values.iter_mut().for_each(|v| *v = value(*v));
    write_png_gray(&file, &mask).unwrap();
}

/// Returns what `inspect` prints of the capture `head`, and whether it finds no problem.
fn inspected(folder: &Path, set: &[&str]) -> (String, bool) {
    let set: Vec<&str> = set.iter().flat_map(|set| ["--set", set]).collect();
    let found = tiface(folder, &[&["inspect", "head"][..], &set].concat());
    let sound = out(&found).contains("no problems found");
    assert_eq!(code(&found), i32::from(!sound), "{}", out(&found));
    (out(&found), sound)
}

/// [`inspected`] of a capture of which a training would be planned exactly if it has no problem.
fn inspected_as_planned(folder: &Path, set: &[&str]) -> (String, bool) {
    let (text, sound) = inspected(folder, set);
    let set: Vec<&str> = set.iter().flat_map(|set| ["--set", set]).collect();
    let planned = tiface(folder, &[&["run", "head", "--dry-run"][..], &set].concat());
    assert_eq!(code(&planned), i32::from(!sound), "{text}\n{}", err(&planned));
    (text, sound)
}

#[test]
fn a_sound_capture_gives_no_warning_and_its_head_has_the_size_of_one() {
    let dir = tempfile::tempdir().unwrap();
    head(dir.path());
    let (text, sound) = inspected_as_planned(dir.path(), &[]);
    assert!(sound && !text.contains("warning"), "{text}");
    assert!(text.contains(" units high: 0.") && !text.contains("unit_m"), "{text}");
}

#[test]
fn inverted_masks_are_a_problem_and_nothing_is_trained_on_them() {
    let dir = tempfile::tempdir().unwrap();
    let head = head(dir.path());
    (0..13).for_each(|view| remask(&head, view, |v| 255 - v));
    let (text, sound) = inspected_as_planned(dir.path(), &[]);
    assert!(!sound, "{text}");
    assert!(text.contains("problem   13 times, the first: the mask of view `000` looks inverted"), "{text}");
    assert!(text.contains("mask.trust=true"), "{text}");
    let o = tiface(dir.path(), &["iface", "head"]);
    assert!(code(&o) == 1 && err(&o).contains("looks inverted"), "{}", err(&o));
    assert!(!dir.path().join("runs/head/iface").exists());
    let (text, sound) = inspected_as_planned(dir.path(), &["mask.trust=true"]);
    assert!(sound && text.contains("warning   13 times, the first: the mask of view"), "{text}");
}

#[test]
fn a_mask_that_shows_nothing_or_everything_among_good_ones_is_a_problem() {
    for (value, words) in [(0, "shows too little"), (255, "the mask of view `007`")] {
        let dir = tempfile::tempdir().unwrap();
        let head = head(dir.path());
        remask(&head, 7, |_| value);
        let (text, sound) = inspected_as_planned(dir.path(), &[]);
        let problems: Vec<&str> = text.lines().filter(|line| line.contains("problem ")).collect();
        assert!(!sound && problems.len() == 1, "{value}: {text}");
        assert!(problems[0].contains("`007`") && problems[0].contains(words), "{text}");
        let (text, sound) = inspected(dir.path(), &["mask.trust=true"]);
        assert!(sound && text.contains(words), "{text}");
    }
}

#[test]
fn masks_of_other_photographs_are_a_problem() {
    let dir = tempfile::tempdir().unwrap();
    let masks = head_of(dir.path(), 24).join("masks");
    std::fs::rename(&masks, masks.with_file_name("old")).unwrap();
    std::fs::create_dir(&masks).unwrap();
    for view in 0..25 {
        let from = masks.with_file_name("old").join(format!("{view:03}.png"));
        std::fs::rename(from, masks.join(format!("{:03}.png", (view + 11) % 25))).unwrap();
    }
    let (text, sound) = inspected_as_planned(dir.path(), &[]);
    assert!(!sound && text.contains("problem "), "{text}");
}

#[test]
fn a_camera_turned_away_from_the_head_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let head = head(dir.path());
    let file = head.join("transforms_train.json");
    let mut json: serde_json::Value = serde_json::from_slice(&std::fs::read(&file).unwrap()).unwrap();
    for row in 0..3 {
        for column in [0, 2] {
            let v = &mut json["frames"][5]["transform_matrix"][row][column];
            *v = (-v.as_f64().unwrap()).into();
        }
    }
    std::fs::write(&file, json.to_string()).unwrap();
    let (text, sound) = inspected_as_planned(dir.path(), &[]);
    assert!(!sound && text.contains("problem   the mask of view `005` contradicts its camera"), "{text}");
}

#[test]
fn a_black_photograph_under_a_mask_that_shows_the_head_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let head = head(dir.path());
    write_png_gray(
        &head.join("images/003.png"),
        &tiface::image::Gray { width: 48, height: 60, values: vec![3; 48 * 60] },
    )
    .unwrap();
    let (text, sound) = inspected_as_planned(dir.path(), &[]);
    assert!(!sound && text.contains("problem   the photograph of view `003` is black"), "{text}");
}

#[test]
fn a_head_of_six_meters_is_doubted() {
    let dir = tempfile::tempdir().unwrap();
    head(dir.path());
    let (text, sound) = inspected_as_planned(dir.path(), &["capture.unit_m=20"]);
    assert!(sound && text.contains(" units high: 7.") && text.contains("capture.unit_m=METERS"), "{text}");
}

#[test]
fn inspect_says_of_what_is_no_capture_what_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let head = small_head(dir.path());
    let says = |path: &str, words: &[&str]| {
        let o = tiface(dir.path(), &["inspect", path]);
        assert_eq!(code(&o), 1);
        for word in words {
            assert!(out(&o).contains(word), "{path}: {word} is missing in {}", out(&o));
        }
        assert!(!out(&o).contains("not recognized"), "{}", out(&o));
    };
    says("absent", &["`absent` does not exist", "hint: "]);
    let o = tiface(dir.path(), &["run", "head", "--run", "a run", "--dry-run"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    std::fs::create_dir(dir.path().join("a run")).unwrap();
    let settings = format!("[capture]\npath = \"{}\"\n", head.display());
    std::fs::write(dir.path().join("a run/config.toml"), settings).unwrap();
    let o = tiface(dir.path(), &["convert", "a run", "--to", "colmap"]);
    assert!(code(&o) == 1 && err(&o).contains("it is the folder of a run"), "{}", err(&o));
    assert!(err(&o).contains(&format!("inspect its capture, `{}`", head.display())), "{}", err(&o));
    let o = tiface(dir.path(), &["inspect", "a run"]);
    assert!(code(&o) == 0 && out(&o).starts_with(&head.display().to_string()), "{}", out(&o));
    std::fs::write(head.join("transforms_train.json"), "{\n\"frames\": [,\n").unwrap();
    says("head", &["format    transforms.json", "transforms_train.json`, line 2"]);
}

#[test]
fn a_blend_that_cannot_be_made_is_refused_before_anything_is_learned() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let o = tiface(dir.path(), &["ensemble", "head", "--set", "capture.tiles=0"]);
    assert_eq!(code(&o), 2);
    assert!(
        err(&o).contains("nothing to fit them on") && err(&o).contains("capture.tiles=0.04"),
        "{}",
        err(&o)
    );
    let o = tiface(dir.path(), &["run", "head", "--set", "render.method=volume"]);
    assert_eq!(code(&o), 2);
    assert!(err(&o).contains("names tface, which render.method does not make"), "{}", err(&o));
    assert!(!dir.path().join("runs").exists());
}

#[test]
fn an_open_mesh_is_below_the_bar() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("t.obj"), "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").unwrap();
    assert_eq!(code(&tiface(dir.path(), &["check", "t.obj"])), 0);
    let o = tiface(dir.path(), &["check", "t.obj", "--require", "watertight"]);
    assert_eq!(code(&o), 3, "{}", err(&o));
    assert_eq!(code(&tiface(dir.path(), &["check", "t.obj", "--require", "beauty"])), 2);
}

/// A cube around a point, each coordinate of its corners with all its digits.
fn cube(center: [f64; 3], half: f64) -> ([[f64; 3]; 8], [[usize; 4]; 6]) {
    let corner = |i: usize| [0, 1, 2].map(|k| center[k] + if i >> k & 1 == 1 { half } else { -half });
    let quads = [[0, 4, 6, 2], [1, 3, 7, 5], [0, 1, 5, 4], [2, 6, 7, 3], [0, 2, 3, 1], [4, 5, 7, 6]];
    ([0, 1, 2, 3, 4, 5, 6, 7].map(corner), quads)
}

#[test]
fn a_head_far_from_the_origin_is_checked_and_measured_like_one_near_it() {
    let dir = tempfile::tempdir().unwrap();
    for center in [[0.0, 0.0, 0.0], [1e6, -1e6, 0.0], [1e7, 1e7, 1e7]] {
        let (corners, quads) = cube(center, 0.1);
        let mut obj: String = corners.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n")).collect();
        quads.iter().for_each(|q| {
            let [a, b, c, d] = q.map(|i| i + 1);
            obj += &format!("f {a} {b} {c} {d}\n");
        });
        std::fs::write(dir.path().join("head.obj"), obj).unwrap();
        // a millimeter larger on all sides
        let (corners, quads) = cube(center, 0.101);
        let mut ply = String::from(
            "ply\nformat ascii 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty double z\n\
             element face 6\nproperty list uchar int vertex_indices\nend_header\n",
        );
        corners.iter().for_each(|[x, y, z]| ply += &format!("{x} {y} {z}\n"));
        quads.iter().for_each(|[a, b, c, d]| ply += &format!("4 {a} {b} {c} {d}\n"));
        std::fs::write(dir.path().join("truth.ply"), ply).unwrap();
        let args = ["check", "head.obj", "--against", "truth.ply", "--require", "watertight"];
        let o = tiface(dir.path(), &args);
        assert_eq!(code(&o), 0, "{center:?} {}{}", out(&o), err(&o));
        // from every point of the cube it is a millimeter to the other
        let expected = "distance to the other   mean 1.000, median 1.000, 90 % below 1.000, worst 1.00 mm";
        assert!(out(&o).contains(expected), "{center:?} {}", out(&o));
        assert!(out(&o).contains("8.0000 liters") && out(&o).contains("0.2000 × 0.2000 × 0.2000 m"));
    }
}

#[test]
fn empty_settings_and_an_empty_material_are_no_damage() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("empty.toml"), "").unwrap();
    let o = tiface(dir.path(), &["config", "-c", "empty.toml"]);
    assert_eq!(out(&o), out(&tiface(dir.path(), &["config"])), "{}", err(&o));
    let obj = "mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    std::fs::write(dir.path().join("t.obj"), obj).unwrap();
    std::fs::write(dir.path().join("t.mtl"), "").unwrap();
    let o = tiface(dir.path(), &["preview", "t.obj", "--size", "16"]);
    assert!(code(&o) == 0 && err(&o).is_empty(), "{}", err(&o));
}

#[test]
fn a_textured_mesh_has_its_colors_from_a_texture() {
    let dir = tempfile::tempdir().unwrap();
    let obj = "mtllib t.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n";
    std::fs::write(dir.path().join("t.obj"), obj).unwrap();
    image::RgbImage::new(2, 2).save(dir.path().join("t.png")).unwrap();
    // a gray material is no color, and a picture that is not there no texture
    for (mtl, colors, json) in [
        ("newmtl a\nmap_Kd gone.png\n", "colors               NO\n", "\"has_texture\":false"),
        ("newmtl a\nKd 1 1 1\n", "colors               NO\n", "\"has_texture\":false"),
        ("newmtl a\nmap_Kd t.png\n", "colors               yes, a texture\n", "\"has_texture\":true"),
    ] {
        std::fs::write(dir.path().join("t.mtl"), mtl).unwrap();
        let o = tiface(dir.path(), &["check", "t.obj"]);
        assert!(out(&o).contains(colors), "{}", out(&o));
        let o = tiface(dir.path(), &["check", "t.obj", "--json"]);
        assert!(out(&o).contains(json), "{}", out(&o));
    }
}

#[test]
#[cfg(unix)]
fn a_closed_stdout_is_not_an_error() {
    use std::process::Stdio;
    let mut child = Command::new(env!("CARGO_BIN_EXE_tiface"))
        .args(["completions", "bash"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    let output = child.wait_with_output().unwrap();
    assert_eq!((code(&output), err(&output)), (0, String::new()));
}

#[test]
fn shells_get_their_completions() {
    let dir = tempfile::tempdir().unwrap();
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let o = tiface(dir.path(), &["completions", shell]);
        assert!(code(&o) == 0 && out(&o).contains("tiface"), "{shell}");
    }
    assert_eq!(code(&tiface(dir.path(), &["completions", "bash", "--out", "x/"])), 2);
}

/// What a shell is offered for the last of these words.
fn offered(shell: &str, words: &[&str]) -> Vec<String> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_tiface"));
    command.env("TIFACE_COMPLETE", shell).args(["--", "tiface"]).args(words);
    let index = words.len().to_string();
    let o = command.env("_CLAP_COMPLETE_INDEX", index).env("_CLAP_IFS", "\n").output().unwrap();
    assert_eq!((code(&o), err(&o)), (0, String::new()));
    out(&o).lines().map(str::to_string).collect()
}

#[test]
fn keys_and_values_of_settings_complete() {
    let keys = offered("bash", &["mesh", "runs/a", "--set", "mesh.tex"]);
    assert_eq!(keys, ["mesh.texture_px="]);
    assert_eq!(offered("bash", &["run", "--set", "mesh.hair="]), ["mesh.hair=shells", "mesh.hair=none"]);
    assert_eq!(offered("bash", &["run", "--set", "mesh.cap=f"]), ["mesh.cap=false"]);
    assert_eq!(offered("bash", &["run", "--set", "mesh.format=glb,p"]), ["mesh.format=glb,ply"]);
    assert!(offered("bash", &["run", "--set", "mesh.resolution="]).is_empty());
    assert!(offered("bash", &["run", "--set", "mesh.nothing="]).is_empty());
    // the other shells show what a key means
    for shell in ["zsh", "fish"] {
        let keys = offered(shell, &["config", "--explain", "mesh.texture_p"]);
        assert!(
            keys.len() == 1 && keys[0].starts_with("mesh.texture_px") && keys[0].contains("texel"),
            "{shell}: {keys:?}"
        );
    }
    assert!(offered("bash", &["ru"]).contains(&"run".to_string()));
}

#[test]
#[cfg(target_os = "linux")]
fn bash_completes_with_the_printed_script() {
    let program = Path::new(env!("CARGO_BIN_EXE_tiface"));
    let script = r#"
        source <(tiface completions bash)
        COMP_WORDS=(tiface run --set mesh.hair=s) COMP_CWORD=3 COMP_TYPE=9
        [[ $COMP_WORDBREAKS == *=* ]] && exit 3
        _clap_complete_tiface tiface mesh.hair=s --set
        echo "${COMPREPLY[@]}""#;
    let path = format!("{}:{}", program.parent().unwrap().display(), std::env::var("PATH").unwrap());
    let o = Command::new("bash").args(["-c", script]).env("PATH", path).output().unwrap();
    assert_eq!((code(&o), out(&o).trim()), (0, "mesh.hair=shells"), "{}", err(&o));
}

#[test]
fn what_was_probably_meant_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 24, height: 30, train: 3, test: 1, seed: 1 };
    photographed(&dir.path().join("captures/002_00"), &options);
    let run = dir.path().join("runs/head");
    std::fs::create_dir_all(&run).unwrap();
    let saved = tiface(dir.path(), &["config", "--set", "capture.path=captures/002_00"]);
    std::fs::write(run.join("config.toml"), &saved.stdout).unwrap();
    std::fs::write(dir.path().join("scan.ply"), "").unwrap();
    for (words, meant) in [
        (&["run", "captures/002_0"][..], Some("`captures/002_00`")),
        (&["mask", "capture/002_00", "--dry-run"], Some("`captures/002_00`")),
        (&["mask", "capture/003", "--dry-run"], None),
        (&["preview", "head"], Some("`runs/head`")),
        (&["verify", "runs/haed"], Some("`runs/head`")),
        (&["check", "scna.ply"], Some("`scan.ply`")),
        (&["check", "quite_another.ply"], None),
        (&["convert", "captures/02_00", "--to", "colmap"], Some("`captures/002_00`")),
    ] {
        let o = tiface(dir.path(), words);
        let hint = err(&o).split_once("hint: ").unwrap().1.to_string();
        assert!(code(&o) != 0, "{words:?}");
        match meant {
            Some(path) => assert!(hint.starts_with(&format!("did you mean {path}? ")), "{words:?}: {hint}"),
            None => assert!(!hint.contains("did you mean"), "{words:?}: {hint}"),
        }
    }
    let o = tiface(dir.path(), &["inspect", "captures/002_0"]);
    assert!(out(&o).contains("did you mean `captures/002_00`?"), "{}", out(&o));
    // two heads at once
    let o = tiface(dir.path(), &["run", "captures/002_00", "runs/head"]);
    assert!(code(&o) == 2 && err(&o).contains("for head in captures/*"), "{}", err(&o));
    let o = tiface(dir.path(), &["run", "captures/002_00", "--nothing"]);
    assert!(code(&o) == 2 && !err(&o).contains("for head in"), "{}", err(&o));
    // a run stands for its capture, and for its mesh
    let o = tiface(dir.path(), &["inspect", "runs/head"]);
    assert!(code(&o) == 0 && out(&o).contains("002_00"), "{}{}", out(&o), err(&o));
    let o = tiface(dir.path(), &["check", "runs/head"]);
    assert!(code(&o) == 1 && err(&o).contains("`runs/head` has no exported mesh"), "{}", err(&o));
    std::fs::create_dir(run.join("mesh")).unwrap();
    let triangle = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";
    std::fs::write(run.join("mesh/head.obj"), triangle).unwrap();
    assert_eq!(code(&tiface(dir.path(), &["check", "runs/head"])), 0);
    assert_eq!(code(&tiface(dir.path(), &["check", "runs/head", "--require", "watertight"])), 3);
}

#[test]
fn the_configuration_as_json_is_json_and_a_key_is_explained_with_its_value_in_preset_quick() {
    let dir = tempfile::tempdir().unwrap();
    let json = |words: &[&str]| -> serde_json::Value {
        let o = tiface(dir.path(), words);
        assert_eq!(code(&o), 0, "{}", err(&o));
        serde_json::from_str(&out(&o)).unwrap()
    };
    let config = json(&["config", "--preset", "draft", "--json"]);
    assert_eq!((&config["preset"], &config["mesh"]["resolution"]), (&"draft".into(), &256.into()));
    let explained = json(&["config", "--explain", "iface.steps", "--json"]);
    assert_eq!(
        (&explained[0]["key"], &explained[0]["values"]["quick"]),
        (&"iface.steps".into(), &900.into())
    );
    let text = out(&tiface(dir.path(), &["config", "--explain", "mesh.resolution"]));
    assert!(text.contains("quick: 256   draft: 256   standard: 512"), "{text}");
}

#[test]
fn what_a_command_cannot_do_is_answered_with_what_can_be_done() {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 24, height: 30, train: 3, test: 1, seed: 1 };
    photographed(&dir.path().join("captures/a"), &options);
    // runs, one of them called as the demo head is
    for name in ["runs/a", "demo"] {
        std::fs::create_dir_all(dir.path().join(name).join("mesh")).unwrap();
        std::fs::write(dir.path().join(name).join("config.toml"), "").unwrap();
    }
    for (words, expected, said) in [
        (&["inspect", "captures/a", "--fresh", "mesh"][..], 2, "`--fresh` has no effect on `inspect`"),
        (&["status", "--set", "iface.steps=5"], 2, "`--set` has no effect on `status`"),
        (&["run", "captures/a", "--watch"], 2, "`tiface status --watch`"),
        (&["preview", "captures/a", "--watch"], 2, "name its run, `runs/a`"),
        (&["check", "captures/a"], 1, "`captures/a` is a folder, but not that of a run"),
        (&["experiment", "demo", "--dry-run"], 2, "photographs of the demo head are not rendered yet"),
    ] {
        let o = tiface(dir.path(), words);
        assert!(code(&o) == expected && err(&o).contains(said), "{words:?}: {} {}", code(&o), err(&o));
    }
    // the exported head of a run may be turned, so its surface is compared
    let ply = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n\
        element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n";
    std::fs::write(dir.path().join("runs/a/mesh/surface.ply"), ply).unwrap();
    std::fs::write(dir.path().join("other.ply"), ply).unwrap();
    let turned = "v 0 0 5\nv 1 0 5\nv 0 1 5\nf 1 2 3\n";
    std::fs::write(dir.path().join("runs/a/mesh/head.obj"), turned).unwrap();
    let o = tiface(dir.path(), &["check", "runs/a", "--against", "other.ply"]);
    assert!(out(&o).contains("distance to the other   mean 0.000,"), "{}{}", out(&o), err(&o));
}

#[test]
fn a_page_to_click_on_is_one_file_without_a_run() {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 32, height: 40, train: 3, test: 1, seed: 1 };
    photographed(&dir.path().join("head"), &options);
    let o = tiface(dir.path(), &["mask", "head", "--page"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    let page = std::fs::read_to_string(dir.path().join("head_clicks.html")).unwrap();
    // the name of a namespace is no address that anything is loaded from
    let page = page.replace("http://www.w3.org/2000/svg", "");
    assert!(page.contains("data:image/jpeg;base64,") && !page.contains("http:") && !page.contains("https:"));
    assert!(!dir.path().join("runs").exists());
    std::fs::create_dir(dir.path().join("a")).unwrap();
    let o = tiface(dir.path(), &["mask", "head", "--page", "--out", "a/b.html", "--json"]);
    assert!(out(&o).contains("b.html") && dir.path().join("a/b.html").is_file(), "{}", err(&o));
}

#[test]
fn clicks_that_cannot_be_used_are_named_with_the_way_out() {
    let dir = tempfile::tempdir().unwrap();
    let options = SyntheticOptions { width: 32, height: 40, train: 3, test: 1, seed: 1 };
    photographed(&dir.path().join("head"), &options);
    for (words, expected) in [
        (&["mask", "head", "--prompts", "none.json"][..], "none.json"),
        // as the option was spelled once
        (&["mask", "head", "--points", "none.json"], "none.json"),
        (&["mask", "head", "--point", "1,2"], "`1,2`"),
        (&["mask", "head", "--point", "500,2,1"], "500"),
        (&["mask", "head", "--point", "16,20,1", "--view", "nobody"], "nobody"),
        (&["mask", "head", "--point", "16,20,0"], "head"),
    ] {
        let o = tiface(dir.path(), words);
        assert!([1, 2].contains(&code(&o)), "{words:?}: {}", err(&o));
        assert!(err(&o).contains(expected) && err(&o).contains("hint: "), "{words:?}: {}", err(&o));
        assert!(!dir.path().join("runs/head/mask/done.json").exists());
    }
    let o = tiface(dir.path(), &["mask", "head", "--prompts", "a", "--point", "1,2,1"]);
    assert_eq!(code(&o), 2);
}

#[test]
fn a_damaged_status_hides_no_other_run() {
    let dir = tempfile::tempdir().unwrap();
    for run in ["bad", "good"] {
        std::fs::create_dir_all(dir.path().join(run).join("mask")).unwrap();
    }
    std::fs::write(dir.path().join("bad/mask/status.json"), "{\"state\": ").unwrap();
    std::fs::create_dir_all(dir.path().join("bad/render/paths/orbit")).unwrap();
    std::fs::write(dir.path().join("bad/render/paths/orbit/done.json"), "").unwrap();
    std::fs::write(dir.path().join("notes"), "no run").unwrap();
    let o = tiface(dir.path(), &["status", "bad", "absent", "notes", "good"]);
    assert_eq!(code(&o), 1);
    let text = out(&o);
    let rows = |run: &str| text.lines().filter(|l| l.starts_with(run)).count();
    assert_eq!((rows("bad "), rows("absent "), rows("notes "), rows("good ")), (1, 1, 1, 1), "{text}");
    assert_eq!(text.matches("UNREADABLE: ").count(), 3, "{text}");
    assert!(text.contains("bad       ?.......  mask UNREADABLE: `bad/mask/status.json`"), "{text}");
    assert!(text.ends_with("4 runs: 1 not begun, 3 UNREADABLE\n"), "{text}");
    assert!(err(&o).contains("3 of 4 runs could not be read"), "{}", err(&o));
    let alone = out(&tiface(dir.path(), &["status", "bad"]));
    assert_eq!((alone.lines().count(), alone.matches("UNREADABLE: ").count()), (9, 2), "{alone}");
    let o = tiface(dir.path(), &["status", "bad", "good", "--json"]);
    assert_eq!(
        (code(&o), out(&o).lines().filter(|l| l.contains("\"state\":\"unreadable\"")).count()),
        (1, 1)
    );
}

#[test]
#[cfg(target_os = "linux")]
fn status_fails_for_a_killed_run_and_an_unreadable_one_hides_no_failed_one() {
    let dir = tempfile::tempdir().unwrap();
    let stage = |run: &str, status: &str| {
        std::fs::create_dir_all(dir.path().join(run).join("mask")).unwrap();
        std::fs::write(dir.path().join(run).join("mask/status.json"), status).unwrap();
    };
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap();
    // no process has this number
    let killed = serde_json::json!({"state": "running", "step": 1, "steps": 2, "rate": null, "eta_s": null,
        "elapsed_s": 1, "device": "cpu", "pid": u32::MAX, "host": host.trim(), "error": null, "updated": 0,
        "fingerprint": {"format": 1, "settings": {}, "inputs": {}}});
    let mut failed = killed.clone();
    (failed["state"], failed["error"]) = ("failed".into(), "no light".into());
    stage("killed", &killed.to_string());
    stage("failed", &failed.to_string());
    stage("bad", "{");
    let o = tiface(dir.path(), &["status", "killed"]);
    assert!(code(&o) == 3 && err(&o).contains("1 of 1 run was killed"), "{}", err(&o));
    let o = tiface(dir.path(), &["status", "bad", "killed", "failed"]);
    let all = "1 of 3 runs failed, 1 was killed, 1 could not be read";
    assert!(code(&o) == 3 && err(&o).contains(all), "{}", err(&o));
    let help = out(&tiface(dir.path(), &["status", "--help"]));
    for state in ["done ", "failed ", "damaged: ", "killed: ", "not readable "] {
        assert!(help.contains(state), "{state}: {help}");
    }
}

#[test]
fn a_record_that_a_crash_left_empty_counts_as_none() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    std::fs::create_dir_all(dir.path().join("runs/head/mask")).unwrap();
    for file in ["done.json", ".lock"] {
        std::fs::write(dir.path().join("runs/head/mask").join(file), "").unwrap();
    }
    let o = tiface(dir.path(), &["mask", "head", "--dry-run"]);
    assert_eq!((code(&o), out(&o).contains("to do")), (0, true), "{}", err(&o));
    let o = tiface(dir.path(), &["mask", "head"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
}

#[test]
fn escape_sequences_out_of_files_do_not_reach_the_terminal() {
    let dir = tempfile::tempdir().unwrap();
    let foul = "v 0 0 0\nv 1 0 0\nv 0 1 0\nmtllib \u{1b}[2J\u{9b}31m.mtl\nv \u{1b}]0;x\u{7}\nf 1 2 3\n";
    std::fs::write(dir.path().join("t.obj"), foul).unwrap();
    std::fs::create_dir_all(dir.path().join("run/mask")).unwrap();
    let status = r#"{"state": "failed", "step": 1, "steps": 2, "rate": null, "eta_s": null, "elapsed_s": 1,
        "device": "cpu", "pid": 1, "host": "h\u001b[31m", "error": "no\nrun  tface  done\u001b[1A", "updated": 0,
        "fingerprint": {"format": 1, "settings": {}, "inputs": {}}}"#;
    std::fs::write(dir.path().join("run/mask/status.json"), status).unwrap();
    for words in [&["check", "t.obj"][..], &["status", "run"], &["check", "\u{1b}[2J.obj"]] {
        let o = tiface(dir.path(), words);
        let both = out(&o) + &err(&o);
        let acts = |c: &char| c.is_control() && *c != '\n';
        assert_eq!(both.chars().find(acts), None, "{both:?}");
    }
    let text = out(&tiface(dir.path(), &["status", "run"]));
    assert!(text.contains(r"failed: no\nrun  tface  done\u001b[1A"), "{text}");
    assert_eq!(text.lines().count(), 8, "{text}");
    // somebody has to look after it
    assert_eq!(code(&tiface(dir.path(), &["status", "run"])), 3);
}

#[test]
fn an_out_or_a_device_that_cannot_be_is_refused_before_anything_begins() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    for (words, expected, said) in [
        (&["mesh", "head", "--out", "head.fbx"][..], 2, "end it in .glb, .obj, .ply, .usdz, or in `/`"),
        (&["run", "head", "--out", "head.stl"], 2, ".json"),
        (&["metrics", "head", "--out", "m.glb"], 2, "end it in .json"),
        (&["render", "head", "--out", "turn"], 2, "with `/` at its end"),
        (&["mesh", "head", "--out", "absent/head.glb"], 1, "the folder `absent` does not exist"),
        (
            &["run", "head", "--out", "h.glb", "--set", "render.method=tface", "--set", "ensemble.members="],
            2,
            "no mesh",
        ),
        (&["iface", "head", "--device", "wgpu:99"], 2, "device `wgpu"),
        (&["demo", "--device", "wgpu:99"], 2, "device `wgpu"),
        (&["demo", "--out", "head.fbx"], 2, "head.fbx"),
        (&["check", "head.glb", "--out", "x/"], 2, "`check` has no product"),
    ] {
        for dry in [&["--dry-run"][..], &[]] {
            let o = tiface(dir.path(), &[words, dry].concat());
            assert_eq!(code(&o), expected, "{words:?}: {}", err(&o));
            assert!(err(&o).contains(said), "{words:?}: {}", err(&o));
        }
    }
    let o = tiface(dir.path(), &["mesh", "head", "--out", "new/", "--dry-run"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    let left: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left, ["head"]);
    // what computes nothing on a device needs none, and nor does what is done
    for _ in 0..2 {
        let o = tiface(dir.path(), &["mask", "head", "--device", "wgpu:99"]);
        assert_eq!(code(&o), 0, "{}", err(&o));
    }
    let o = tiface(dir.path(), &["report", "runs/head"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
}

#[test]
fn the_tables_say_what_they_need_and_are_collected_without_making_it() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let experiment = |more: &[&str]| {
        let words = ["experiment", "head", "--tables", "components", "--scale", "0.01", "--out", "tables/"];
        tiface(dir.path(), &[&words[..], more].concat())
    };
    let o = experiment(&["--dry-run"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    let said = out(&o);
    let lines: Vec<&str> = said.lines().collect();
    assert!(lines[0].starts_with("head/paper ") && lines[0].contains("to do  about "), "{said}");
    assert!(lines[1].starts_with("all ") && lines.len() == 2, "{said}");
    let o = experiment(&["--dry-run", "--json"]);
    let run: serde_json::Value = serde_json::from_str(out(&o).trim()).unwrap();
    assert_eq!((&run["run"], &run["done"]), (&"head/paper".into(), &false.into()));
    assert!(run["estimate"]["cpu_s"].as_f64().unwrap() > 0.0);
    // nor can its runs be made on a device that is not here
    let o = experiment(&["--dry-run", "--device", "wgpu:99"]);
    assert!(out(&o).contains("cannot be made: device `wgpu"), "{}{}", out(&o), err(&o));
    for wrong in [["--preset", "draft"], ["--run", "runs/other"], ["--fresh", "iface"]] {
        let o = experiment(&wrong);
        assert_eq!(code(&o), 2, "{}", err(&o));
        assert!(err(&o).contains("cannot be used with `experiment`"), "{}", err(&o));
    }
    assert!(!dir.path().join("tables").exists());
    let o = experiment(&["--collect"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    let table = std::fs::read_to_string(dir.path().join("tables/experiment.md")).unwrap();
    assert!(table.contains("not made yet") && !dir.path().join("tables/head").exists(), "{table}");
}

#[test]
fn what_out_received_is_told_and_nothing_else_is_written_there() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let o = tiface(dir.path(), &["mask", "head", "--out", "masks/"]);
    assert_eq!(code(&o), 0, "{}", err(&o));
    assert!(out(&o).contains("out       masks/\n"), "{}", out(&o));
    assert!(dir.path().join("masks/scene.json").is_file() && !dir.path().join("masks/done.json").exists());
    let o = tiface(dir.path(), &["mask", "runs/head", "--out", "runs/head/copy/"]);
    assert_eq!(code(&o), 2, "{}", err(&o));
    assert!(!dir.path().join("runs/head/copy").exists());
}

#[test]
fn a_capture_is_converted_into_a_new_folder_only() {
    let dir = tempfile::tempdir().unwrap();
    let small = SyntheticOptions { width: 16, height: 20, train: 4, test: 1, seed: 1 };
    photographed(&dir.path().join("head"), &small);
    let o = tiface(dir.path(), &["convert", "head", "--to", "colmap"]);
    assert_eq!((code(&o), out(&o).trim()), (0, "head_colmap"), "{}", err(&o));
    let o = tiface(dir.path(), &["convert", "head_colmap", "--to", "transforms", "--out", "back", "--json"]);
    assert!(code(&o) == 0 && out(&o).contains("\"views\":5"), "{} {}", out(&o), err(&o));
    let o = tiface(dir.path(), &["convert", "back", "--to", "colmap", "--dry-run"]);
    assert!(code(&o) == 0 && !dir.path().join("back_colmap").exists(), "{}", err(&o));
    for (words, expected, text) in [
        (&["convert", "head", "--to", "transforms", "--out", "head_colmap"][..], 1, "already exists"),
        (&["convert", "head", "--to", "nerf"], 2, "`--to nerf` is not a camera format"),
        (&["convert", "absent", "--to", "colmap"], 1, "absent"),
        (&["demo", "--size", "large"], 2, "`--size large` is not a size in pixels"),
        (&["demo", "--size", "9x9", "--run", "tiny"], 1, "9 × 9 pixels"),
    ] {
        let o = tiface(dir.path(), words);
        assert!(code(&o) == expected && err(&o).contains(text), "{words:?}: {} {}", code(&o), err(&o));
    }
}

#[test]
fn a_conversion_that_was_killed_is_completed_by_the_same_command() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let words = ["convert", "head", "--to", "transforms", "--out", "copy"];
    assert_eq!(code(&tiface(dir.path(), &words)), 0);
    let whole = std::fs::read(dir.path().join("copy/transforms.json")).unwrap();
    // the cameras are written last
    std::fs::remove_file(dir.path().join("copy/transforms.json")).unwrap();
    std::fs::remove_file(dir.path().join("copy/images/003.png")).unwrap();
    let o = tiface(dir.path(), &words);
    assert_eq!(code(&o), 0, "{}", err(&o));
    assert!(std::fs::read(dir.path().join("copy/transforms.json")).unwrap() == whole);
    assert!(dir.path().join("copy/images/003.png").is_file());
    // a complete folder, and one with other files, are left as they are
    assert_eq!(code(&tiface(dir.path(), &words)), 1);
    std::fs::remove_file(dir.path().join("copy/transforms.json")).unwrap();
    for (file, found) in [("copy/images/003.png", "mine"), ("copy/notes.txt", "mine")] {
        let before = std::fs::read(dir.path().join(file)).unwrap_or_default();
        std::fs::write(dir.path().join(file), found).unwrap();
        let o = tiface(dir.path(), &words);
        assert!(code(&o) == 1 && err(&o).contains("already exists"), "{file}: {}", err(&o));
        assert_eq!(std::fs::read_to_string(dir.path().join(file)).unwrap(), found);
        std::fs::write(dir.path().join(file), before).unwrap();
    }
}

#[test]
fn the_same_demo_command_continues_and_only_other_photographs_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let capture = dir.path().join("run/capture");
    let options = SyntheticOptions { width: 32, height: 40, train: 6, test: 2, seed: 42 };
    photographed(&capture, &options);
    write_borders(&capture, &options, 4).unwrap();
    let demo = |words: &[&str]| tiface(dir.path(), &[&["demo", "--run", "run", "--dry-run"], words].concat());
    for words in [&["--size", "32x40", "--views", "8", "--border", "4"][..], &["--size", "32x40"], &[]] {
        let o = demo(words);
        assert!(code(&o) == 0 && out(&o).contains("to do"), "{words:?}: {}{}", out(&o), err(&o));
    }
    for words in [["--size", "40x32"], ["--views", "12"], ["--border", "5"]] {
        let o = demo(&words);
        let hint = format!("leave out {}", words[0]);
        assert!(code(&o) == 2 && err(&o).contains(&hint), "{words:?}: {}", err(&o));
    }
}

#[test]
fn what_stopped_a_run_before_its_first_stage_is_told_by_its_folder_until_it_is_mended() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let frames = dir.path().join("head/transforms_train.json");
    let sound = std::fs::read_to_string(&frames).unwrap();
    std::fs::write(&frames, &sound[..sound.len() / 2]).unwrap();
    // a dry run leaves nothing, and neither does a name that was mistyped
    for words in [&["mask", "head", "--run", "runs/a", "--dry-run"][..], &["mask", "head"]] {
        assert_eq!(code(&tiface(dir.path(), words)), 1);
        assert!(!dir.path().join("runs").exists());
    }
    assert_eq!(code(&tiface(dir.path(), &["mask", "head", "--run", "runs/a"])), 1);
    let o = tiface(dir.path(), &["status", "runs/a"]);
    assert!(
        code(&o) == 3 && out(&o).contains("failed: ") && out(&o).contains("transforms_train.json"),
        "{}",
        out(&o)
    );
    let o = tiface(dir.path(), &["status", "--failed"]);
    assert!(code(&o) == 3 && out(&o).starts_with("a         ........  failed: "), "{}", out(&o));
    std::fs::write(&frames, &sound).unwrap();
    assert_eq!(code(&tiface(dir.path(), &["mask", "head", "--run", "runs/a"])), 0);
    // one that broke after it began is told, too, but not what was asked for by mistake
    let mask = ["mask", "head", "--run", "runs/a"];
    for (broken, more, failed) in
        [(false, &["--set", "mask.mask_dir=x"][..], 0), (true, &[], 3), (false, &[], 0)]
    {
        std::fs::write(&frames, if broken { "{" } else { &sound }).unwrap();
        let o = tiface(dir.path(), &[&mask[..], more].concat());
        assert_eq!(code(&o) == 0, !broken && more.is_empty(), "{}", err(&o));
        let o = tiface(dir.path(), &["status", "--failed"]);
        assert_eq!(code(&o), failed, "{}", out(&o));
        assert_eq!(out(&o).contains("transforms_train.json"), broken, "{}", out(&o));
    }
    let o = tiface(dir.path(), &["status", "--json"]);
    let run: serde_json::Value = serde_json::from_str(&out(&o)).unwrap();
    assert_eq!((code(&o), &run["state"], &run["error"]), (0, &"begun".into(), &serde_json::Value::Null));
    assert!(run["left_s"].as_f64().unwrap() > 1.0 && run["stages"][0]["cpu_s"].as_f64().is_some(), "{run}");
    assert!(!out(&o).contains("settings"));
}

#[test]
fn a_dry_run_says_about_how_long_and_how_much() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    let total = |more: &[&str]| {
        let words = ["run", "head", "--dry-run", "--json", "--set", "mask.source=none"];
        let o = tiface(dir.path(), &[&words[..], more].concat());
        assert_eq!(code(&o), 0, "{}", err(&o));
        let stages: Vec<serde_json::Value> =
            out(&o).lines().map(|l| serde_json::from_str(l).unwrap()).collect();
        let sum = |key: &str| stages.iter().map(|s| s["estimate"][key].as_f64().unwrap()).sum::<f64>();
        (sum("cpu_s"), sum("memory_bytes"), sum("disk_bytes"))
    };
    let (draft, twice) =
        (total(&["--preset", "draft"]), total(&["--preset", "draft", "--set", "iface.steps=6000"]));
    assert!(twice.0 > 1.3 * draft.0 && twice.1 == draft.1 && draft.2 > 1e7, "{draft:?}, {twice:?}");
    let text = out(&tiface(dir.path(), &["run", "head", "--dry-run"]));
    let last = text.lines().last().unwrap();
    assert!(last.starts_with("all      about ") && last.contains("GiB of memory, "), "{text}");
}

#[test]
fn a_hundred_heads_stand_on_one_screen() {
    let dir = tempfile::tempdir().unwrap();
    let cost = r#"{"cpu_s": 100, "memory_bytes": 1, "disk_bytes": 1}"#;
    for i in 0..100 {
        let run = dir.path().join(format!("runs/head_{i:03}"));
        std::fs::create_dir_all(&run).unwrap();
        std::fs::write(run.join("estimate.json"), format!("{{\"mask\": {cost}, \"metrics\": {cost}}}"))
            .unwrap();
        if i == 42 {
            std::fs::write(run.join("failed.json"), r#"{"error": "no light", "hint": "", "exit": 1}"#)
                .unwrap();
        }
    }
    let o = tiface(dir.path(), &["status"]);
    let text = out(&o);
    assert!(code(&o) == 3 && text.lines().count() <= 24, "{text}");
    assert!(text.contains("head_042  ..  failed: no light") && text.contains(" head_099"), "{text}");
    assert!(text.contains("100 runs: 99 not begun, 1 failed; about "), "{text}");
    assert_eq!(out(&tiface(dir.path(), &["status", "-v"])).lines().count(), 101);
}

#[test]
fn masks_that_are_refused_clear_nothing_that_was_made_with_others() {
    let dir = tempfile::tempdir().unwrap();
    let head = head(dir.path());
    assert_eq!(code(&tiface(dir.path(), &["mask", "head"])), 0);
    (0..12).for_each(|view| remask(&head, view, |v| 255 - v));
    let words = ["mask", "head", "--fresh", "mask"];
    for words in [&words[..], &["mask", "head", "--fresh", "mask", "--dry-run"]] {
        let o = tiface(dir.path(), words);
        assert_eq!(code(&o), 1, "{words:?}: {}{}", out(&o), err(&o));
        assert!(err(&o).contains("inverted") && err(&o).contains("mask.trust"), "{}", err(&o));
        assert!(dir.path().join("runs/head/mask/done.json").is_file());
    }
}

#[test]
fn a_dry_run_ends_as_the_command_itself_would() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    assert_eq!(code(&tiface(dir.path(), &["mask", "head"])), 0);
    let other = ["mask", "head", "--set", "capture.downscale=2"];
    for words in [&other[..], &["mask", "head", "--set", "capture.downscale=2", "--dry-run"]] {
        let o = tiface(dir.path(), words);
        assert_eq!(code(&o), 1, "{words:?}: {}{}", out(&o), err(&o));
        assert!(err(&o).contains("capture.downscale: was 1, is 2"), "{}", err(&o));
        assert_eq!(out(&o).contains("would stop"), words.contains(&"--dry-run"), "{}", out(&o));
    }
    let afresh = [&other[..], &["--fresh", "mask", "--dry-run"]].concat();
    let o = tiface(dir.path(), &afresh);
    assert!(code(&o) == 0 && out(&o).contains("to do again"), "{}{}", out(&o), err(&o));
}

#[test]
fn what_a_stage_made_again_puts_out_of_date_is_named_before_it_goes() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    assert_eq!(code(&tiface(dir.path(), &["mask", "head"])), 0);
    // as if it had been begun
    let mesh = dir.path().join("runs/head/mesh");
    std::fs::create_dir(&mesh).unwrap();
    for (file, found) in
        [(".lock", "tiface holds this lock while it works on this stage\n"), ("surface.ply", "x")]
    {
        std::fs::write(mesh.join(file), found).unwrap();
    }
    let words = ["mask", "head", "--fresh", "mask"];
    let o = tiface(dir.path(), &[&words[..], &["--dry-run"]].concat());
    let said = out(&o);
    assert!(code(&o) == 0 && said.contains("mesh     would be removed"), "{said}{}", err(&o));
    // the lock is no content of the folder
    assert!(said.contains("out of date: 1 file, 0.0 MB\n"), "{said}");
    let masks = said.lines().find(|line| line.starts_with("mask     to do again: removes "));
    let masks = masks.and_then(|line| line.split_once("removes ")?.1.split("  ").next()).unwrap();
    assert!(masks.ends_with(" MB") && masks.contains(" files, "), "{said}");
    assert!(mesh.join("surface.ply").is_file());
    let o = tiface(dir.path(), &words);
    let named = format!("out of date: `mask` ({masks}), `mesh` (1 file, 0.0 MB)");
    assert!(code(&o) == 0 && err(&o).contains(&named), "{}", err(&o));
    assert!(!mesh.join("surface.ply").exists());
}

#[test]
#[cfg(not(feature = "wgpu"))]
fn what_only_gpus_have_is_refused_with_the_feature_that_it_needs() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    for words in [
        &["iface", "head", "--memory", "2"][..],
        &["iface", "head", "--memory", "2", "--dry-run"],
        &["iface", "head", "--set", "device=cpu+2GiB"],
        &["demo", "--memory", "2"],
    ] {
        let o = tiface(dir.path(), words);
        assert_eq!(code(&o), 2, "{words:?}: {}{}", out(&o), err(&o));
        assert!(err(&o).contains("--features wgpu"), "{words:?}: {}", err(&o));
    }
    assert!(!dir.path().join("runs").exists());
}

#[test]
fn a_file_of_the_capture_that_changed_under_a_run_is_named() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    assert_eq!(code(&tiface(dir.path(), &["mask", "head"])), 0);
    let image = |name: &str| dir.path().join("head/images").join(name);
    let sound = std::fs::read(image("003.png")).unwrap();
    std::fs::copy(image("001.png"), image("003.png")).unwrap();
    for words in [&["mask", "runs/head"][..], &["mask", "runs/head", "--dry-run"]] {
        let o = tiface(dir.path(), words);
        assert!(code(&o) == 1 && err(&o).contains("`images/003.png` has changed"), "{}", err(&o));
        assert!(!err(&o).contains("more differ"), "{}", err(&o));
    }
    std::fs::write(image("003.png"), &sound).unwrap();
    let frames = dir.path().join("head/transforms.json");
    for file in [frames, dir.path().join("head/transforms_train.json")] {
        let text = std::fs::read_to_string(&file).unwrap();
        std::fs::write(&file, text.replace("\"cx\": 16.0", "\"cx\": 16.5")).unwrap();
    }
    let o = tiface(dir.path(), &["mask", "runs/head"]);
    assert!(code(&o) == 1 && err(&o).contains("the camera of view `"), "{}", err(&o));
    assert!(err(&o).contains("more differ"), "{}", err(&o));
    // as runs from before it was kept
    std::fs::remove_file(dir.path().join("runs/head/mask/inputs.json")).unwrap();
    let o = tiface(dir.path(), &["mask", "runs/head"]);
    assert!(code(&o) == 1 && err(&o).contains("other photographs, masks or cameras\n"), "{}", err(&o));
}

#[test]
fn settings_of_a_run_that_nothing_can_be_made_of_are_named_by_its_status() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir_all(dir.path().join("runs/a/mask")).unwrap();
    std::fs::write(dir.path().join("runs/a/config.toml"), "seed = 7\n[iface]\nsteps = \n").unwrap();
    for words in [&["status"][..], &["status", "runs/a"], &["status", "--json"], &["status", "--failed"]] {
        let o = tiface(dir.path(), words);
        assert_eq!(code(&o), 1, "{words:?}: {}{}", out(&o), err(&o));
        assert!(out(&o).contains("a/config.toml`, line 3"), "{words:?}: {}", out(&o));
    }
}

#[test]
#[cfg(target_os = "linux")]
fn a_mesh_in_the_making_is_no_reason_to_make_one() {
    let dir = tempfile::tempdir().unwrap();
    let mesh = dir.path().join("run/mesh");
    std::fs::create_dir_all(&mesh).unwrap();
    std::fs::write(dir.path().join("run/config.toml"), "").unwrap();
    let preview = || tiface(dir.path(), &["preview", "run"]);
    assert!(code(&preview()) == 1 && err(&preview()).contains("make one: `tiface mesh run`"));
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap();
    let (host, pid) = (host.trim(), std::process::id());
    let status = format!(
        r#"{{"state": "running", "step": 1, "steps": 2, "rate": null, "eta_s": null, "elapsed_s": 1, "device": "cpu",
        "pid": {pid}, "host": "{host}", "error": null, "updated": 0,
        "fingerprint": {{"format": 1, "settings": {{}}, "inputs": {{}}}}}}"#
    );
    std::fs::write(mesh.join("status.json"), status).unwrap();
    let _held = std::fs::File::create(mesh.join(".lock")).unwrap();
    let o = preview();
    assert_eq!(code(&o), 75, "{}", err(&o));
    assert!(err(&o).contains(&format!("right now, by process {pid} on {host}")), "{}", err(&o));
    assert!(err(&o).contains("hint: wait for it"), "{}", err(&o));
}

#[test]
fn a_demo_that_cannot_be_is_refused_before_a_photograph_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    for (words, expected, said) in [
        (["--size", "9x9"], 1, "9 × 9 pixels"),
        (["--views", "2000"], 1, "1..=999 views"),
        (["--views", "2"], 2, "`--views 2` leaves 1 to train on"),
        (["--border", "128"], 2, "`--border 128` leaves no pixels"),
    ] {
        for dry in [&["--dry-run"][..], &[]] {
            let o = tiface(dir.path(), &[&["demo"], &words[..], dry].concat());
            assert!(code(&o) == expected && err(&o).contains(said), "{words:?}: {} {}", code(&o), err(&o));
            assert!(!err(&o).contains("photograph"), "{}", err(&o));
        }
    }
    assert!(!dir.path().join("runs").exists());
}

#[test]
#[cfg(not(feature = "matting"))]
fn a_network_that_this_build_cannot_run_is_refused_before_a_run_is_begun() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    std::fs::write(dir.path().join("net.onnx"), "weights").unwrap();
    for more in [&[][..], &["--run", "named"], &["--dry-run"]] {
        let o = tiface(dir.path(), &[&["mask", "head", "--alpha-net", "net.onnx"], more].concat());
        assert!(code(&o) == 2 && err(&o).contains("--features matting"), "{}", err(&o));
    }
    assert!(!dir.path().join("runs").exists() && !dir.path().join("named").exists());
}

#[test]
fn a_refused_command_leaves_nothing_in_somebodys_own_folder() {
    let dir = tempfile::tempdir().unwrap();
    small_head(dir.path());
    std::fs::create_dir_all(dir.path().join("thesis/mask")).unwrap();
    std::fs::write(dir.path().join("thesis/mask/costume.png"), "mine").unwrap();
    // nor is a folder ours for what a file is called
    for lock in [None, Some("mask/.lock")] {
        lock.iter().for_each(|lock| std::fs::write(dir.path().join("thesis").join(lock), "").unwrap());
        for more in [&["--fresh", "mask"][..], &[]] {
            let o = tiface(dir.path(), &[&["mask", "head", "--run", "thesis"], more].concat());
            assert!(code(&o) == 1 && err(&o).contains("mask/costume.png"), "{}", err(&o));
            let left: Vec<_> = std::fs::read_dir(dir.path().join("thesis")).unwrap().collect();
            assert_eq!(left.len(), 1, "{left:?}");
        }
    }
}
