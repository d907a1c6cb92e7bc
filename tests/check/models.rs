//! COLMAP's models and Metashape's cameras as people have them: left-out lines, rigs, several
//! chunks; and COLMAP's commands in the words of its versions.

use crate::capture_folder::{open, put, refused};
#[cfg(unix)]
use crate::photographs::{cameras, found_by_script, script};
use glam::{DMat3, DMat4, DQuat, DVec3};
use std::fs;
use tempfile::TempDir;
use tiface::capture::{Capture, View};
use tiface::geom::Projection;
use tiface::io;

const SIZE: (u32, u32) = (24, 32);

/// A folder with these photographs in `images/`.
fn photographs(names: &[String]) -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    for (i, name) in names.iter().enumerate() {
        let path = dir.path().join("images").join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        let rgb = vec![[9 * i as u8; 3]; (SIZE.0 * SIZE.1) as usize];
        io::write_png_rgb(&path, SIZE.0, SIZE.1, &rgb).unwrap();
    }
    dir
}

fn says(texts: &[String], words: &[&str]) {
    let all = |text: &String| words.iter().all(|word| text.contains(word));
    assert!(texts.iter().any(all), "{words:?} are missing in: {texts:?}");
}

/// World from camera: right, down, ahead and where it stands.
fn pose(i: usize) -> (DMat3, DVec3) {
    let a = 0.6 * i as f64;
    let ahead = DVec3::new(-a.cos(), -a.sin(), -0.2).normalize();
    let right = ahead.cross(DVec3::Z).normalize();
    (DMat3::from_cols(right, ahead.cross(right), ahead), DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.4))
}

fn list(values: impl IntoIterator<Item = f64>) -> String {
    values.into_iter().map(|v| v.to_string()).collect::<Vec<_>>().join(" ")
}

fn view<'c>(c: &'c Capture, name: &str) -> &'c View {
    c.views.iter().find(|v| v.name == name).unwrap_or_else(|| panic!("`{name}` is missing"))
}

/// Does a view stand there, with axes that point right, down and ahead?
fn stands(view: &View, rotation: DMat3, position: DVec3) {
    let turned = view.camera.rotation - rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    assert!(turned.to_cols_array().iter().all(|v| v.abs() < 1e-9), "{}", view.name);
    assert!(view.camera.position.distance(position) < 1e-9, "{}", view.name);
}

// ----------------------------------------------------------------------------------- COLMAP's text

const CAMERA: &str = "1 PINHOLE 24 32 30.5 30.5 12 16\n";

/// The line of image `i`, numbered from 1.
fn image(i: usize, name: &str) -> String {
    let (rotation, position) = pose(i);
    let q = DQuat::from_mat3(&rotation.transpose());
    let t = -(rotation.transpose() * position);
    format!("{} {} {} 1 {name}\n", i + 1, list([q.w, q.x, q.y, q.z]), list(t.to_array()))
}

fn names(count: usize, name: impl Fn(usize) -> String) -> Vec<String> {
    (0..count).map(name).collect()
}

/// Photographs `00.png` to `05.png` and their model as text.
fn six(cameras: &str, images: &str) -> TempDir {
    let dir = photographs(&names(6, |i| format!("{i:02}.png")));
    put(&dir, "sparse/0/cameras.txt", cameras);
    put(&dir, "sparse/0/images.txt", images);
    dir
}

fn six_images(points: impl Fn(usize) -> &'static str) -> String {
    (0..6).map(|i| image(i, &format!("{i:02}.png")) + points(i)).collect()
}

fn six_stand(c: &Capture) {
    assert_eq!(c.views.len(), 6);
    for i in 0..6 {
        let (rotation, position) = pose(i);
        stands(view(c, &format!("{i:02}")), rotation, position);
    }
}

#[test]
fn colmap_images_of_one_line_each_are_all_read_however_many_words_their_names_have() {
    for words in ["", "head ", "head left ", "the head left "] {
        let names = names(6, |i| format!("{words}{i:02}.png"));
        let dir = photographs(&names);
        let lines: String = names.iter().enumerate().map(|(i, name)| image(i, name)).collect();
        put(&dir, "sparse/0/cameras.txt", CAMERA);
        put(&dir, "sparse/0/images.txt", format!("# Image list\n{lines}"));
        let c = open(&dir).unwrap();
        assert_eq!(c.views.len(), 6, "{words:?}");
        for i in 0..6 {
            let (rotation, position) = pose(i);
            stands(view(&c, &format!("{words}{i:02}")), rotation, position);
        }
        says(&c.reasons, &["`sparse/0/images.txt`", "6 images in lines 2 to 7", "without a second line"]);
    }
}

#[test]
fn empty_lines_that_an_editor_left_out_or_put_in_between_do_not_lose_an_image() {
    let points = |i: usize| if i.is_multiple_of(2) { "1.5 2.5 -1 3.5 4.5 17\n" } else { "" };
    let c = open(&six(CAMERA, &six_images(points))).unwrap();
    six_stand(&c);
    says(&c.reasons, &["3 images in lines 3 to 9", "without a second line"]);
    // nothing is said of a file that is as COLMAP writes it, or has empty lines between all of its
    // lines
    let whole = six_images(|i| if i.is_multiple_of(2) { "1.5 2.5 -1 3.5 4.5 17\n" } else { "\n" });
    for text in [whole.clone(), whole.replace('\n', "\n\n"), whole.replace('\n', "\r\n# a comment\r\n")] {
        let c = open(&six(CAMERA, &text)).unwrap();
        six_stand(&c);
        assert!(c.reasons.iter().all(|r| !r.contains("second line")), "{:?}", c.reasons);
    }
}

#[test]
fn a_line_that_is_neither_points_nor_the_next_image_is_refused_by_its_number() {
    let first = image(0, "00.png");
    let takes = "an image takes two lines";
    for (second, words) in [
        (
            "2 0.5 0.5 0.5 0.5 0 0 2 7 head left 01.png",
            &["line 2", takes, "camera 7 is not in the cameras"][..],
        ),
        ("2 0.5 0.5 0.5 0.6 0 0 2 1 head left 01.png", &["line 2", takes, "quaternion is not of length 1"]),
        ("2 0.5 0.5 0.5 0.5 0 0 2 head left 01.png", &["line 2", takes, "neither"]),
        ("1.5 2.5 -1 3.5", &["line 2", takes, "neither"]),
        ("1.5 2.5 one", &["line 2", takes, "neither"]),
    ] {
        refused(&six(CAMERA, &format!("{first}{second}\n")), words);
    }
    let stray = format!("{first}1 2 3\n1 2 3\n");
    refused(&six(CAMERA, &stray), &["images.txt`: line 3"]);
    let twice = format!("{}\n{}\n", image(0, "00.png"), image(0, "01.png"));
    refused(&six(CAMERA, &twice), &["frame `01.png`", "its number 1 appears twice"]);
}

#[test]
fn colmap_text_of_other_editors_is_read_and_decimal_commas_are_said() {
    let images = six_images(|_| "\n");
    let marked = |text: &str| format!("\u{feff}{text}");
    let tabs = images.replace(' ', "\t");
    for (cameras, images) in [
        (marked(CAMERA), marked(&images)),
        (marked("# Camera list\r\n") + CAMERA, marked("# Image list\r\n") + &images.replace('\n', "\r\n")),
        (CAMERA.replace(' ', "\t"), tabs),
        (CAMERA.replace("30.5", "3.05e+01"), images.clone()),
    ] {
        let c = open(&six(&cameras, &images)).unwrap();
        six_stand(&c);
        assert_eq!(c.views[0].camera.fx, 30.5);
    }
    // names keep their point
    let commas = |text: &str| text.replace('.', ",").replace(",png", ".png");
    let c = open(&six(&commas(CAMERA), &commas(&images))).unwrap();
    six_stand(&c);
    assert_eq!(c.views[0].camera.fx, 30.5);
    says(&c.reasons, &["`sparse/0/images.txt` has decimal commas"]);
    says(&c.reasons, &["`sparse/0/cameras.txt` has decimal commas"]);
    refused(
        &six("1, PINHOLE, 24, 32, 30.5, 30.5, 12, 16\n", &images),
        &["cameras.txt`: line 1", "commas separate its values"],
    );
    refused(&six(&CAMERA.replace("30.5", "1,030.5"), &images), &["`1,030.5` is not a parameter of the lens"]);
}

#[test]
fn a_text_model_of_colmap_4_is_read_beside_its_rigs_and_frames() {
    let names = names(6, |i| format!("left\\{i:02}.png"));
    let dir = photographs(&self::names(6, |i| format!("left/{i:02}.png")));
    let header = "# Image list with two lines of data per image:\n#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, \
                  NAME\n#   POINTS2D[] as (X, Y, POINT3D_ID)\n# Number of images: 6, mean observations per image: 1\n";
    let images: String = names.iter().enumerate().map(|(i, name)| image(i, name) + "1.5 2.5 3\n").collect();
    put(&dir, "sparse/0/cameras.txt", format!("# Camera list\n{CAMERA}"));
    put(&dir, "sparse/0/images.txt", header.to_string() + &images);
    put(&dir, "sparse/0/rigs.txt", "# Rig calib list\n1 1 CAMERA 1\n");
    put(&dir, "sparse/0/frames.txt", "# Frame list\n1 1 1 0 0 0 9 9 9 1 CAMERA 1 1\n");
    let c = open(&dir).unwrap();
    six_stand(&c);
}

#[test]
fn the_lenses_that_colmap_4_added_are_read_or_named() {
    let images = six_images(|_| "\n");
    let fisheye = |camera: &str| {
        let c = open(&six(camera, &images)).unwrap();
        c.views[0].camera.clone()
    };
    let as_known = fisheye("1 OPENCV_FISHEYE 24 32 30 30 12 16 0 0 0 0\n");
    assert_eq!(as_known.distortion.projection, Projection::Fisheye);
    assert_eq!(fisheye("1 SIMPLE_FISHEYE 24 32 30 12 16\n"), as_known);
    assert_eq!(fisheye("1 FISHEYE 24 32 30 30 12 16\n"), as_known);

    let dir = six(CAMERA, &images);
    for name in ["cameras", "images"] {
        fs::remove_file(dir.path().join(format!("sparse/0/{name}.txt"))).unwrap();
    }
    put(&dir, "sparse/0/images.bin", 0u64.to_le_bytes());
    for (model, name, values) in [
        (11, "RAD_TAN_THIN_PRISM_FISHEYE", 16),
        (12, "SIMPLE_DIVISION", 4),
        (13, "DIVISION", 5),
        (16, "EUCM", 6),
        (17, "EQUIRECTANGULAR", 2),
    ] {
        let mut camera = 1u64.to_le_bytes().to_vec();
        camera.extend(1u32.to_le_bytes());
        camera.extend(i32::to_le_bytes(model));
        camera.extend([24u64, 32].map(u64::to_le_bytes).as_flattened());
        camera.extend(vec![0u8; 8 * values]);
        put(&dir, "sparse/0/cameras.bin", camera);
        refused(&dir, &["camera 1: its camera model", &format!("`{name}`"), "image_undistorter"]);
    }
}

// --------------------------------------------------------------------------------------- Metashape

/// Calibration of a sensor with this focal length.
fn calibrated(f: f64) -> String {
    format!(
        r#"<resolution width="24" height="32"/><calibration type="frame" class="adjusted"><f>{f}</f></calibration>"#
    )
}

fn rows(m: DMat3) -> String {
    list((0..3).flat_map(|k| m.row(k).to_array()))
}

/// Camera `i` with a pose of its own.
fn aligned(i: usize, sensor: usize, label: &str) -> String {
    let (rotation, position) = pose(i);
    let rows: Vec<f64> =
        (0..3).flat_map(|k| [rotation.row(k).to_array().to_vec(), vec![position[k]]].concat()).collect();
    format!(
        r#"<camera id="{i}" sensor_id="{sensor}" component_id="0" label="{label}"><transform>{} 0 0 0 1</transform></camera>"#,
        list(rows)
    )
}

fn chunk(attributes: &str, sensors: &str, cameras: &str) -> String {
    format!(
        "<chunk {attributes}><sensors>{sensors}</sensors><components><component id=\"0\"><transform><translation>1 2 3\
         </translation><scale>0.5</scale></transform></component></components><cameras>{cameras}</cameras></chunk>"
    )
}

fn document(inside: &str) -> String {
    format!("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<document version=\"2.0.0\">{inside}</document>")
}

/// A sensor that stands so in its master.
fn master_from_slave() -> DMat4 {
    DMat4::from_rotation_translation(DQuat::from_rotation_y(0.2), DVec3::new(0.3, -0.1, 0.05))
}

fn slave_sensor(inside: &str) -> String {
    let master = calibrated(30.0);
    let slave = calibrated(31.0);
    format!(
        r#"<sensor id="0" type="frame">{master}</sensor><sensor id="1" type="frame" master_id="0">{slave}{inside}</sensor>"#
    )
}

fn offset() -> String {
    let (rotation, position) = (DMat3::from_mat4(master_from_slave()), master_from_slave().w_axis.truncate());
    let position = list(position.to_array());
    format!(
        "<rotation>{}</rotation><location>{position}</location><rotation_covariance>1</rotation_covariance>",
        rows(rotation)
    )
}

/// Three masters `L_0` to `L_2` in one sensor, three slaves `R_0` to `R_2` in the other.
fn pairs(of_masters: usize, sensors: &str) -> TempDir {
    let dir = photographs(
        &["L", "R"].iter().flat_map(|s| (0..3).map(move |i| format!("{s}_{i}.png"))).collect::<Vec<_>>(),
    );
    let pair = |i: usize| {
        let of_slaves = 1 - of_masters;
        aligned(i, of_masters, &format!("L_{i}"))
            + &format!(r#"<camera id="{}" sensor_id="{of_slaves}" master_id="{i}" label="R_{i}"/>"#, 10 + i)
    };
    let cameras: String = (0..3).map(pair).collect();
    put(
        &dir,
        "cameras.xml",
        document(&chunk("id=\"0\" label=\"Chunk 1\" enabled=\"true\"", sensors, &cameras)),
    );
    dir
}

/// Where camera `i`, moved in its own axes, stands in the world of the chunk.
fn moved(i: usize, by: DMat4) -> (DMat3, DVec3) {
    let (rotation, position) = pose(i);
    let chunk_from_camera = DMat4::from_rotation_translation(DQuat::from_mat3(&rotation), position) * by;
    let place = chunk_from_camera.w_axis.truncate();
    (DMat3::from_mat4(chunk_from_camera), 0.5 * place + DVec3::new(1.0, 2.0, 3.0))
}

#[test]
fn slaves_of_a_metashape_rig_stand_where_their_sensor_is_in_their_master() {
    let c = open(&pairs(0, &slave_sensor(&offset()))).unwrap();
    assert_eq!(c.views.len(), 6);
    for i in 0..3 {
        let (rotation, position) = moved(i, DMat4::IDENTITY);
        stands(view(&c, &format!("L_{i}")), rotation, position);
        let (rotation, position) = moved(i, master_from_slave());
        stands(view(&c, &format!("R_{i}")), rotation, position);
        assert_eq!(view(&c, &format!("R_{i}")).camera.fx, 31.0);
    }
    says(&c.reasons, &["3 slave cameras of a rig", "rotation and location"]);
    assert!(c.warnings.iter().all(|w| !w.contains("not aligned")), "{:?}", c.warnings);
    // aligned by the other sensor than the one in which the rig was calibrated
    let c = open(&pairs(1, &slave_sensor(&offset()))).unwrap();
    for i in 0..3 {
        let (rotation, position) = moved(i, master_from_slave().inverse());
        stands(view(&c, &format!("R_{i}")), rotation, position);
    }
    // a part that is fixed at its default is an empty element
    let c = open(&pairs(0, &slave_sensor("<rotation fixed=\"true\"/><location>0.3 0 0</location>"))).unwrap();
    let (rotation, position) = moved(1, DMat4::from_translation(DVec3::new(0.3, 0.0, 0.0)));
    stands(view(&c, "R_1"), rotation, position);
}

#[test]
fn slaves_whose_sensors_say_nothing_are_left_out_as_a_rigs_not_as_unaligned() {
    for inside in ["", "<rotation/><location/>"] {
        let c = open(&pairs(0, &slave_sensor(inside))).unwrap();
        assert_eq!(c.views.len(), 3);
        says(
            &c.warnings,
            &["3 slave cameras of a rig left out", "`R_0`, `R_1`, `R_2`", "Camera Calibration"],
        );
    }
    for (inside, words) in [
        ("<rotation>1 0 0</rotation>", &["frame `R_0`", "`rotation` of its sensor is not 9"][..]),
        ("<rotation>2 0 0 0 2 0 0 0 2</rotation>", &["`rotation` of its sensor", "scales, by 2"]),
        ("<location>1 nan 0</location>", &["`location` of its sensor is not 3 finite numbers"]),
        ("<location>1 x 0</location>", &["`location` of its sensor", "`x` is no number"]),
    ] {
        refused(&pairs(0, &slave_sensor(inside)), words);
    }
    // a slave of nobody, of itself, of another slave, and of a master without a pose
    let dir = pairs(0, &slave_sensor(&offset()));
    let path = dir.path().join("cameras.xml");
    let text = fs::read_to_string(&path).unwrap();
    for master in ["77", "10", "11", "99"] {
        let lost = r#"<camera id="99" sensor_id="0" label="lost"/></cameras>"#;
        let with = text.replace("</cameras>", lost).replacen(
            "master_id=\"0\" label",
            &format!("master_id=\"{master}\" label"),
            1,
        );
        fs::write(&path, with).unwrap();
        let c = open(&dir).unwrap();
        assert_eq!(c.views.len(), 5, "{master}");
        says(&c.warnings, &["2 cameras were not aligned, or are disabled: `R_0`, `lost`"]);
    }
}

/// A chunk whose lens has this focal length, with a photograph `0.png` to `2.png` for each camera.
fn whole_chunk(attributes: &str, f: f64) -> String {
    let sensor = format!("<sensor id=\"0\" type=\"frame\">{}</sensor>", calibrated(f));
    chunk(attributes, &sensor, &(0..3).map(|i| aligned(i, 0, &i.to_string())).collect::<String>())
}

#[test]
fn the_enabled_chunk_of_metashape_is_read_and_the_others_are_named() {
    let dir = photographs(&names(3, |i| format!("{i}.png")));
    let chunks = |states: &[&str]| -> String {
        let chunk = |(i, state): (usize, &&str)| {
            whole_chunk(&format!("id=\"{i}\" label=\"Chunk {i}\" enabled=\"{state}\""), 20.0 + i as f64)
        };
        states.iter().enumerate().map(chunk).collect()
    };
    let focal = |inside: &str| {
        put(&dir, "cameras.xml", document(inside));
        let c = open(&dir).unwrap();
        (c.views[0].camera.fx, c.warnings)
    };
    let (f, warnings) = focal(&chunks(&["false", "true"]));
    assert_eq!(f, 21.0);
    says(&warnings, &["2 chunks", "only `Chunk 1` is read", "`Chunk 0 (disabled)`"]);
    assert_eq!(focal(&chunks(&["0", "false", "1"])).0, 22.0);
    // of several, the first, if none is active
    let (f, warnings) = focal(&chunks(&["true", "true"]));
    assert_eq!(f, 20.0);
    says(&warnings, &["only `Chunk 0` is read, not `Chunk 1`"]);
    let active = format!("<chunks active_id=\"1\">{}</chunks>", chunks(&["true", "true"]));
    assert_eq!(focal(&active).0, 21.0);
    let unaligned =
        chunks(&["true", "true"]).replacen("<cameras>", "<cameras><camera id=\"9\"/></cameras><old>", 1);
    assert_eq!(focal(&unaligned.replacen("</cameras></chunk>", "</old></chunk>", 1)).0, 21.0);
    let (f, warnings) = focal(&chunks(&["false"]));
    assert_eq!(f, 20.0);
    says(&warnings, &["the only chunk", "disabled"]);
    put(&dir, "cameras.xml", document(&chunks(&["false", "false"])));
    refused(&dir, &["all its 2 chunks are disabled: `Chunk 0`, `Chunk 1`"]);
}

#[test]
fn components_that_metashape_aligned_apart_are_not_taken_for_one_world() {
    let dir = photographs(&names(3, |i| format!("{i}.png")));
    let whole = document(&whole_chunk("enabled=\"true\"", 30.0));
    let last = whole.rfind("component_id=\"0\"").unwrap();
    let apart = format!("{}component_id=\"1\"{}", &whole[..last], &whole[last + 16..]);
    // both have their place in the world
    let place = "</component><component id=\"1\"><transform><translation>1 2 3</translation></transform></component></components>";
    put(&dir, "cameras.xml", apart.replace("</component></components>", place));
    assert_eq!(open(&dir).unwrap().views.len(), 3);
    // one has none
    let other = "</component><component id=\"1\"/></components>";
    let without = apart.replace("</component></components>", other);
    put(&dir, "cameras.xml", &without);
    let c = open(&dir).unwrap();
    assert_eq!(c.views.len(), 2);
    says(&c.warnings, &["1 camera left out", "2 components apart", "`2`"]);
    put(&dir, "cameras.xml", without.replace("<components>", "<components active_id=\"1\">"));
    assert_eq!(open(&dir).unwrap().views.len(), 1);
}

#[test]
fn what_a_metashape_lens_has_and_is_not_read_is_named() {
    let dir = photographs(&names(3, |i| format!("{i}.png")));
    let whole = document(&whole_chunk("enabled=\"true\"", 30.0));
    let says_of = |old: &str, new: &str, words: &[&str]| {
        put(&dir, "cameras.xml", whole.replace(old, new));
        refused(&dir, words);
    };
    says_of(
        "</calibration>",
        "<p3>0.01</p3></calibration>",
        &["sensor 0: it has `p3`, which is not supported"],
    );
    says_of("</calibration>", "<k5>1e-3</k5></calibration>", &["`k5`"]);
    says_of("<f>30</f>", "<fx>30</fx><fy>30</fy>", &["`fx`, as PhotoScan before 1.3"]);
    says_of("<f>30</f>", "", &["it has no focal length `f`"]);
    let calibration = calibrated(30.0);
    says_of(
        &format!("type=\"frame\">{calibration}"),
        "type=\"spherical\">",
        &["`spherical` is not supported"],
    );
    says_of(&calibration, "", &["it is not calibrated"]);
    // what says nothing of the lens is passed over; the adjusted calibration counts, wherever it
    // stands
    let more = "<p3>0</p3><covariance><params>f k1</params><coeffs>1 2 3 4</coeffs></covariance></calibration>\
                <calibration type=\"frame\" class=\"initial\"><f>7</f></calibration>";
    put(&dir, "cameras.xml", whole.replace("</calibration>", more));
    assert_eq!(open(&dir).unwrap().views[0].camera.fx, 30.0);
    let rolling = whole
        .replace("</transform></camera>", "</transform><rolling_shutter>1 0 0</rolling_shutter></camera>");
    put(&dir, "cameras.xml", rolling);
    says(&open(&dir).unwrap().warnings, &["rolling shutter of 3 cameras"]);
}

#[test]
fn equal_labels_of_metashape_are_told_apart_by_their_groups() {
    let dir = photographs(&["left/a.png", "right/a.png", "b.png"].map(String::from));
    let group =
        |i: usize, label: &str| format!("<group id=\"{i}\" label=\"{label}\">{}</group>", aligned(i, 0, "a"));
    let cameras = group(0, "left") + &group(1, "right") + &aligned(2, 0, "b.png");
    let sensor = format!("<sensor id=\"0\" type=\"frame\">{}</sensor>", calibrated(30.0));
    put(&dir, "cameras.xml", document(&chunk("enabled=\"true\"", &sensor, &cameras)));
    let c = open(&dir).unwrap();
    assert_eq!(c.views.len(), 3);
    for (i, name) in ["left/a", "right/a", "b"].into_iter().enumerate() {
        let (rotation, position) = moved(i, DMat4::IDENTITY);
        stands(view(&c, name), rotation, position);
    }
}

// ------------------------------------------------------------------------------- COLMAP's commands

/// The commands of a version, and the options that it has of those that are used here.
#[cfg(unix)]
const COLMAP_3_8: &[(&str, &str)] = &[
    (
        "feature_extractor",
        "database_path image_path image_list_path ImageReader.mask_path ImageReader.camera_model ImageReader.single_camera \
         SiftExtraction.use_gpu SiftExtraction.num_threads SiftExtraction.peak_threshold \
         SiftExtraction.estimate_affine_shape SiftExtraction.domain_size_pooling",
    ),
    (
        "exhaustive_matcher",
        "database_path SiftMatching.use_gpu SiftMatching.num_threads SiftMatching.guided_matching",
    ),
    ("mapper", "database_path image_path output_path Mapper.num_threads"),
];

#[cfg(unix)]
const COLMAP_4: &[(&str, &str)] = &[
    (
        "feature_extractor",
        "database_path image_path image_list_path ImageReader.mask_path ImageReader.camera_model ImageReader.single_camera \
         FeatureExtraction.type FeatureExtraction.use_gpu FeatureExtraction.num_threads SiftExtraction.peak_threshold \
         SiftExtraction.estimate_affine_shape SiftExtraction.domain_size_pooling",
    ),
    (
        "exhaustive_matcher",
        "database_path FeatureMatching.type FeatureMatching.use_gpu FeatureMatching.num_threads \
         FeatureMatching.guided_matching SiftMatching.max_ratio",
    ),
    ("view_graph_calibrator", "database_path"),
    ("mapper", "database_path image_path output_path Mapper.num_threads"),
    (
        "global_mapper",
        "database_path image_path output_path GlobalMapper.num_threads GlobalMapper.gp_use_gpu \
         GlobalMapper.ba_ceres_use_gpu",
    ),
];

/// Puts a COLMAP in its place that knows these commands and refuses other options, as the real one
/// does. Its mappers find the model in `model/`.
#[cfg(unix)]
fn colmap(dir: &TempDir, commands: &[(&str, &str)]) {
    let known = |(command, options): &(&str, &str)| format!("{command}) known='{options}' ;;\n");
    let cases: String = commands.iter().map(known).collect();
    let all: Vec<&str> = commands.iter().map(|(command, _)| *command).collect();
    let text = format!(
        r#"command=$1; shift
case $command in
help) for name in {}; do echo "  $name"; done; exit 0 ;;
{cases}*) echo "Command $command not recognized"; exit 1 ;;
esac
if [ "$1" = -h ]; then for name in $known; do echo "  --$name arg (=1)"; done; exit 0; fi
while [ $# -gt 0 ]; do
case " $known " in *" ${{1#--}} "*) ;; *) echo "unrecognised option '$1'"; exit 1 ;; esac
[ "$1" = --output_path ] && out=$2
shift 2
done
case $command in *mapper) [ -d model ] || exit 0; /bin/mkdir -p $out/0; /bin/cp model/*.bin $out/0 ;; esac
exit 0"#,
        all.join(" ")
    );
    script(dir, "colmap", &text);
}

#[test]
#[cfg(unix)]
fn cameras_are_found_with_the_options_of_every_version_of_colmap() {
    for version in [COLMAP_3_8, COLMAP_4] {
        let dir = found_by_script("");
        colmap(&dir, version);
        let (exit, said) = cameras(&dir, &["photographs"]);
        assert!(exit == 0 && said.contains("colmap mapper --database_path"), "{said}");
        let log =
            fs::read_to_string(dir.path().join("photographs_cameras/colmap/tiface_cameras.log")).unwrap();
        assert!(!log.contains("unrecognised"), "{log}");
        // a second attempt knows its own options as well
        fs::remove_dir_all(dir.path().join("model")).unwrap();
        let (exit, said) = cameras(&dir, &["photographs", "--out", "again"]);
        assert!(exit == 1 && said.contains("found cameras for 0 of 9 photographs"), "{said}");
        assert!(said.contains("Matching.guided_matching 1"), "{said}");
    }
}

#[test]
#[cfg(unix)]
fn glomap_is_colmaps_global_mapper_where_that_is_installed() {
    let dir = found_by_script("");
    colmap(&dir, COLMAP_4);
    // which is not asked
    script(&dir, "glomap", "exit 1");
    let (exit, said) = cameras(&dir, &["photographs", "--glomap"]);
    assert!(exit == 0 && !said.contains("glomap mapper"), "{said}");
    for text in [
        "colmap view_graph_calibrator --database_path",
        "colmap global_mapper --database_path",
        "--GlobalMapper.gp_use_gpu 0 --GlobalMapper.ba_ceres_use_gpu 0",
    ] {
        assert!(said.contains(text), "{said}");
    }
    // a version without some of the options, or without calibration, is not asked for them
    let early = [COLMAP_4[0], COLMAP_4[1], ("global_mapper", "database_path image_path output_path")];
    colmap(&dir, &early);
    let (exit, said) = cameras(&dir, &["photographs", "--glomap", "--out", "early"]);
    assert!(exit == 0 && !said.contains("calibrator") && !said.contains("GlobalMapper."), "{said}");
    // lenses that cannot be calibrated keep what was guessed
    let mut broken = COLMAP_4.to_vec();
    broken[2].1 = "other_path";
    colmap(&dir, &broken);
    let (exit, said) = cameras(&dir, &["photographs", "--glomap", "--out", "broken"]);
    assert!(exit == 0 && said.contains("colmap view_graph_calibrator"), "{said}");
}

#[test]
#[cfg(unix)]
fn glomap_is_its_own_program_beside_an_older_colmap() {
    let dir = found_by_script("");
    colmap(&dir, COLMAP_3_8);
    let (exit, said) = cameras(&dir, &["photographs", "--glomap", "--dry-run"]);
    assert!(exit == 1 && said.contains("`glomap` is not installed"), "{said}");
    assert!(said.contains("no `global_mapper`") && said.contains("COLMAP 4"), "{said}");
    let copy = "while [ $# -gt 0 ]; do [ \"$1\" = --output_path ] && out=$2; shift; done\n\
                /bin/mkdir -p $out/0; /bin/cp model/*.bin $out/0";
    script(&dir, "glomap", copy);
    let (exit, said) = cameras(&dir, &["photographs", "--glomap"]);
    assert!(exit == 0 && said.contains("glomap mapper --database_path"), "{said}");
}

#[test]
fn lens_models_of_colmap_in_small_letters_are_those_in_capitals() {
    let text = six_images(|_| "\n");
    for name in ["pinhole", "Pinhole"] {
        six_stand(&open(&six(&CAMERA.replace("PINHOLE", name), &text)).unwrap());
    }
}

#[test]
fn commas_between_the_values_of_a_model_are_named_with_a_command_that_writes_blanks() {
    let text = six_images(|_| "\n");
    for by in [",", ", "] {
        let with = |text: &str| text.replace(' ', by);
        for (cameras, images, file) in
            [(CAMERA.into(), with(&text), "images.txt"), (with(CAMERA), text.clone(), "cameras.txt")]
        {
            let e = open(&six(&cameras, &images)).unwrap_err();
            assert!(e.to_string().contains(file) && e.to_string().contains("commas separate"), "{e}");
            assert!(e.hint().contains("sed -i") && e.hint().contains(file), "{}", e.hint());
        }
    }
}
