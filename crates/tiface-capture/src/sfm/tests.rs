use super::commands::{Commands, Mapper};
use super::search::asked;
use super::*;

/// Returns the commands of an attempt, as typed; nothing for one that is not run.
fn typed(
    n: usize,
    is_video: bool,
    shared: bool,
    mapper: Mapper,
    attempt: Attempt,
    spelling: &Spelling,
) -> [String; 4] {
    let sfm = SfmOptions {
        out: "new".into(),
        lens_each: false,
        glomap: !matches!(mapper, Mapper::Incremental),
        limits: Limits::default(),
        say: &|_| (),
        stop: &|| false,
    };
    let programs = Programs { colmap: "colmap".into(), mapper };
    let names = vec![String::new(); n];
    let dir = tempfile::tempdir().unwrap();
    let lock = Lock::take(&dir.path().join(".lock")).unwrap();
    let (output, request) =
        (Output::new(&sfm), Request { source: "photographs".into(), fingerprint: asked(&sfm) });
    let (sfm, warnings, masked) = (&sfm, Vec::new(), true);
    let work = Work { sfm, output, request, lock, programs, names, warnings, shared, masked, is_video };
    let Commands { extractor, matcher, calibrator, mapper } =
        work.commands(attempt, Path::new("w"), spelling);
    [extractor, matcher, calibrator.unwrap_or_default(), mapper]
        .map(|words| words.iter().map(|w| w.to_str().unwrap()).collect::<Vec<_>>().join(" "))
}

#[test]
fn commands_follow_the_photographs_the_attempt_and_the_version() {
    let threads = rayon::current_num_threads();
    let plain = Attempt { masked: false, weak: false };
    let (old, new) = (Spelling::default(), Spelling { has_new_names: true, ..Spelling::default() });
    let [extractor, matcher, calibrator, mapper] = typed(9, false, true, Mapper::Incremental, plain, &old);
    assert_eq!(
        extractor,
        format!(
            "feature_extractor --database_path w/database.db --image_path new/images --SiftExtraction.use_gpu 0 \
             --SiftExtraction.num_threads {threads} --ImageReader.camera_model SIMPLE_RADIAL --ImageReader.single_camera 1"
        )
    );
    assert_eq!(
        matcher,
        format!(
            "exhaustive_matcher --database_path w/database.db --SiftMatching.use_gpu 0 --SiftMatching.num_threads {threads}"
        )
    );
    let paths = "--database_path w/database.db --image_path new/images --output_path w/models";
    assert_eq!(mapper, format!("mapper {paths} --Mapper.num_threads {threads}"));
    assert_eq!(calibrator, "");

    let weak = Attempt { masked: true, weak: true };
    let glomap = Mapper::Glomap("glomap".into());
    let [extractor, matcher, calibrator, mapper] = typed(9, false, false, glomap, weak, &new);
    for option in [
        "--ImageReader.mask_path new/colmap/masks",
        "--FeatureExtraction.use_gpu 0",
        "--SiftExtraction.peak_threshold 0.002",
    ] {
        assert!(extractor.contains(option), "{extractor}");
    }
    assert!(!extractor.contains("single_camera"), "{extractor}");
    assert!(
        matcher.contains("--FeatureMatching.guided_matching 1") && !matcher.contains("Sift"),
        "{matcher}"
    );
    assert!(mapper.starts_with("mapper ") && mapper.ends_with("--output_path w/models"), "{mapper}");
    assert_eq!(calibrator, "");

    // only a long video is matched in its order
    let matcher = |n, is_video| typed(n, is_video, true, Mapper::Incremental, plain, &old)[1].clone();
    assert!(matcher(MAX_EXHAUSTIVE + 1, true).starts_with("sequential_matcher "));
    for (n, is_video) in [(MAX_EXHAUSTIVE, true), (MAX_EXHAUSTIVE + 1, false)] {
        assert!(matcher(n, is_video).starts_with("exhaustive_matcher "), "{n}");
    }
}

#[test]
fn the_global_mapper_gets_the_options_that_it_has_and_calibrated_lenses() {
    let threads = rayon::current_num_threads();
    let plain = Attempt { masked: false, weak: false };
    let global = vec![("--GlobalMapper.num_threads", "threads"), ("--GlobalMapper.gp_use_gpu", "0")];
    let spelling = Spelling { has_new_names: true, global };
    let mapper = Mapper::Global { calibrates: true };
    let [_, _, calibrator, mapper] = typed(9, false, true, mapper, plain, &spelling);
    assert_eq!(calibrator, "view_graph_calibrator --database_path w/database.db");
    let paths = "--database_path w/database.db --image_path new/images --output_path w/models";
    let options = format!("--GlobalMapper.num_threads {threads} --GlobalMapper.gp_use_gpu 0");
    assert_eq!(mapper, format!("global_mapper {paths} {options}"));
    let mapper = Mapper::Global { calibrates: false };
    let [_, _, calibrator, mapper] = typed(9, false, true, mapper, plain, &Spelling::default());
    assert_eq!((calibrator.as_str(), mapper), ("", format!("global_mapper {paths}")));
}

#[test]
fn the_default_folder_is_named_after_the_capture_not_after_the_folder_of_its_photographs() {
    let rows = [
        ("heads/a", "a_cameras"),
        ("heads/a/images", "a_cameras"),
        ("heads/b/Photos/", "b_cameras"),
        ("/heads/c/input/rgb", "c_cameras"),
        ("images", "images_cameras"),
        ("../images", "images_cameras"),
        (".", "capture_cameras"),
    ];
    for (from, to) in rows {
        assert_eq!(default_folder(Path::new(from), false), Path::new(to), "{from}");
    }
    assert_eq!(default_folder(Path::new("a/turn.mp4"), true), Path::new("turn_cameras"));
}
