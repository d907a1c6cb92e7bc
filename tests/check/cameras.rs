//! Cameras of NeuS, Metashape and RealityCapture: where a known point lands, and every hostile file
//! refused by name.

use crate::capture_folder::{open, put, refused};
use glam::{DMat3, DVec3, Vec3};
use std::fs;
use std::io::Write;
use std::path::Path;
use tempfile::TempDir;
use tiface::capture::{self, Capture, CaptureOptions, Split, ViewMask};
use tiface::geom::Projection;
use tiface::io;

const SIZE: (u32, u32) = (160, 120);

fn photographs(dir: &Path, folder: &str, count: usize) {
    fs::create_dir_all(dir.join(folder)).unwrap();
    for i in 0..count {
        let rgb = vec![[i as u8; 3]; (SIZE.0 * SIZE.1) as usize];
        io::write_png_rgb(&dir.join(format!("{folder}/{i:02}.png")), SIZE.0, SIZE.1, &rgb).unwrap();
    }
}

/// OpenCV camera in the world (columns right, down, ahead) and its position.
fn pose(i: usize) -> (DMat3, DVec3) {
    let a = 0.6 * i as f64;
    let ahead = DVec3::new(-a.cos(), -a.sin(), -0.2).normalize();
    let right = ahead.cross(DVec3::Z).normalize();
    (DMat3::from_cols(right, ahead.cross(right), ahead), DVec3::new(2.0 * a.cos(), 2.0 * a.sin(), 0.4))
}

/// Where a pinhole camera of OpenCV's axes sees a point; pixel centers at +0.5.
fn lands(i: usize, focal: [f64; 2], center: [f64; 2], point: DVec3) -> [f64; 2] {
    let (rotation, position) = pose(i);
    let p = rotation.transpose() * (point - position);
    [0, 1].map(|k| focal[k] * p[k] / p.z + center[k])
}

fn sees(c: &Capture, focal: [f64; 2], center: [f64; 2]) {
    for (i, view) in c.views.iter().enumerate() {
        for point in [DVec3::ZERO, DVec3::new(0.2, -0.1, 0.3)] {
            let (pixel, _) = view.camera.project(point.as_vec3()).unwrap();
            let [x, y] = lands(i, focal, center, point);
            let off = (pixel.x as f64 - x).hypot(pixel.y as f64 - y);
            assert!(off < 1e-3, "{}: {off} pixels off", view.name);
        }
        assert!(view.camera.position.distance(pose(i).1) < 1e-9, "{}", view.name);
    }
}

// -------------------------------------------------------------------------------------------- NeuS

fn npy(shape: &str, values: &[f64]) -> Vec<u8> {
    let header = format!("{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}\n");
    let mut b = b"\x93NUMPY\x01\x00".to_vec();
    b.extend((header.len() as u16).to_le_bytes());
    b.extend(header.as_bytes());
    values.iter().for_each(|v| b.extend(v.to_le_bytes()));
    b
}

fn npz(arrays: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    let stored = zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (name, bytes) in arrays {
        zip.start_file(format!("{name}.npy"), stored).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn world_mat(i: usize) -> Vec<f64> {
    let k = DMat3::from_cols_array(&[200.0, 0.0, 0.0, 0.0, 210.0, 0.0, 79.0, 61.0, 1.0]);
    let (rotation, position) = pose(i);
    let m = k * rotation.transpose();
    let t = -(m * position);
    let mut rows: Vec<f64> = (0..3).flat_map(|r| [m.row(r).x, m.row(r).y, m.row(r).z, t[r]]).collect();
    rows.extend([0.0, 0.0, 0.0, 1.0]);
    rows
}

fn neus() -> (TempDir, Vec<(String, Vec<u8>)>) {
    let dir = tempfile::tempdir().unwrap();
    photographs(dir.path(), "image", 5);
    photographs(dir.path(), "mask", 5);
    let scale = [0.5, 0.0, 0.0, 0.1, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.5, 0.2, 0.0, 0.0, 0.0, 1.0];
    let mut arrays: Vec<_> =
        (0..5).map(|i| (format!("world_mat_{i}"), npy("(4, 4)", &world_mat(i)))).collect();
    arrays.extend((0..5).map(|i| (format!("scale_mat_{i}"), npy("(4, 4)", &scale))));
    put(&dir, "cameras_sphere.npz", npz(&arrays));
    (dir, arrays)
}

#[test]
fn neus_scenes_keep_their_world_and_know_their_sphere() {
    let (dir, arrays) = neus();
    let c = open(&dir).unwrap();
    assert_eq!((c.format.as_str(), c.views.len()), ("NeuS", 5));
    sees(&c, [200.0, 210.0], [79.5, 61.5]);
    assert!(
        c.views.iter().all(|v| matches!(&v.mask, ViewMask::File(p) if p.to_string_lossy().contains("mask/")))
    );
    let focus = c.focus.unwrap();
    assert!((focus.min - Vec3::new(-0.4, -0.5, -0.3)).abs().max_element() < 1e-6, "{focus:?}");
    // IDR's and H3DS's name
    fs::rename(dir.path().join("cameras_sphere.npz"), dir.path().join("cameras.npz")).unwrap();
    assert_eq!(open(&dir).unwrap().views.len(), 5);

    let with = |change: &dyn Fn(&mut Vec<(String, Vec<u8>)>)| {
        let mut changed = arrays.clone();
        change(&mut changed);
        put(&dir, "cameras.npz", npz(&changed));
    };
    with(&|a| drop(a.remove(4)));
    refused(&dir, &["4 cameras for the 5 photographs"]);
    with(&|a| a[2].1 = npy("(4, 4)", &[f64::NAN; 16]));
    refused(&dir, &["frame `image/02.png`", "not finite"]);
    with(&|a| a[2].1 = npy("(4, 4)", &[0.0; 16]));
    refused(&dir, &["flattens space"]);
    with(&|a| a[2].1 = npy("(2, 8)", &[0.0; 16]));
    refused(&dir, &["shape [2, 8]"]);
    with(&|a| a[5].1 = npy("(4, 4)", &[0.0; 16]));
    refused(&dir, &["`scale_mat_0`", "radius 0"]);
    with(&|a| a.clear());
    refused(&dir, &["no array `world_mat_0`"]);
    with(&|_| ());
    let whole = fs::read(dir.path().join("cameras.npz")).unwrap();
    for cut in (0..whole.len()).step_by(7) {
        put(&dir, "cameras.npz", &whole[..cut]);
        refused(&dir, &["cameras.npz"]);
    }
    for at in (0..whole.len()).step_by(5) {
        let mut flipped = whole.clone();
        flipped[at] ^= 0x81;
        put(&dir, "cameras.npz", &flipped);
        let _ = open(&dir);
    }
}

// --------------------------------------------------------------------------------------- Metashape

fn list(values: &[f64]) -> String {
    values.iter().map(|v| v.to_string()).collect::<Vec<_>>().join(" ")
}

/// Cameras of a chunk that is turned about X by a quarter, twice as small and elsewhere.
fn metashape(sensor: &str, count: usize) -> String {
    let world_from_chunk = DMat3::from_rotation_x(std::f64::consts::FRAC_PI_2);
    let (scale, origin) = (0.5, DVec3::new(1.0, 2.0, 3.0));
    let camera = |i: usize| {
        let (rotation, position) = pose(i);
        let r = world_from_chunk.transpose() * rotation;
        let p = world_from_chunk.transpose() * (position - origin) / scale;
        let rows: Vec<f64> = (0..3).flat_map(|k| [r.row(k).x, r.row(k).y, r.row(k).z, p[k]]).collect();
        format!(
            r#"<camera id="{i}" sensor_id="0" component_id="0" label="{i:02}"><transform>{} 0 0 0 1</transform></camera>"#,
            list(&rows)
        )
    };
    let cameras: String = (0..count).map(camera).collect();
    let r = world_from_chunk;
    let rows: Vec<f64> = (0..3).flat_map(|k| r.row(k).to_array()).collect();
    format!(
        r#"<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="0" label="unknown" type="frame"><resolution width="160" height="120"/>
{sensor}</sensor></sensors>
<components next_id="1" active_id="0"><component id="0"><transform><rotation locked="true">{}</rotation>
<translation>1 2 3</translation><scale>0.5</scale></transform></component></components>
<cameras><group id="0">{cameras}</group>
<camera id="77" sensor_id="0" label="lost"/><camera id="78" sensor_id="0" enabled="false" label="off"><transform>1</transform></camera>
</cameras></chunk></document>"#,
        list(&rows)
    )
}

const PLAIN: &str = r#"<calibration type="frame" class="initial"><f>7</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="160" height="120"/><f>210</f><cx>1.5</cx><cy>-2</cy><b1>-10</b1></calibration>"#;

#[test]
fn metashape_cameras_stand_in_the_world_of_their_chunk() {
    let dir = tempfile::tempdir().unwrap();
    photographs(dir.path(), "images", 6);
    put(&dir, "cameras.xml", metashape(PLAIN, 6));
    let c = open(&dir).unwrap();
    assert_eq!((c.format.as_str(), c.views.len()), ("Metashape", 6));
    sees(&c, [200.0, 210.0], [81.5, 58.0]);
    assert!(
        c.warnings.iter().any(|w| w.contains("2 cameras were not aligned, or are disabled: `lost`, `off`"))
    );

    let bent = PLAIN.replace("<b1>-10</b1>", "<k1>-0.1</k1><k2>0.02</k2><p1>0.001</p1><p2>-0.002</p2>");
    put(&dir, "cameras.xml", metashape(&bent, 6));
    let lens = open(&dir).unwrap().views[0].camera.distortion;
    // P1 is the one of x²
    assert_eq!((lens.k1, lens.k2, lens.p1, lens.p2), (-0.1, 0.02, -0.002, 0.001));
    let fisheye = bent.replace("type=\"frame\" class=\"adjusted\"", "type=\"fisheye\" class=\"adjusted\"");
    put(&dir, "cameras.xml", metashape(&fisheye.replace("<k2>", "<k4>0.001</k4><k2>"), 6));
    let lens = open(&dir).unwrap().views[0].camera.distortion;
    assert_eq!((lens.projection, lens.k4), (Projection::Fisheye, 0.001));
    put(
        &dir,
        "cameras.xml",
        metashape(PLAIN, 6).replace("<translation>1 2 3", "<translation>4000000 2e6 4e6"),
    );
    let c = open(&dir).unwrap();
    assert!(c.warnings.iter().any(|w| w.contains("geocentric")), "{:?}", c.warnings);
    assert!(c.views[1].camera.position.distance(pose(1).1 - DVec3::new(1.0, 2.0, 3.0)) < 1e-9);
}

#[test]
fn hostile_metashape_files_are_refused_by_name() {
    let dir = tempfile::tempdir().unwrap();
    photographs(dir.path(), "images", 3);
    let sound = metashape(PLAIN, 3);
    let says = |text: &str, words: &[&str]| {
        put(&dir, "cameras.xml", text);
        refused(&dir, words);
    };
    says(&metashape("", 3), &["sensor 0: it is not calibrated"]);
    says(&sound.replace("<f>210", "<f>-1"), &["focal length `f` is -1"]);
    says(&sound.replace("<f>210", "<f>NaN"), &["`f` is not a finite number"]);
    says(&sound.replace("<cx>", "<k4>0.1</k4><cx>"), &["k4", "optimize"]);
    says(&sound.replace("<cx>", "<b2>5</b2><cx>"), &["b2"]);
    says(&sound.replace("frame\" class=\"adj", "spherical\" class=\"adj"), &["`spherical` is not supported"]);
    says(&sound.replace("160", "0"), &["its width is `0`"]);
    says(&sound.replace("<scale>0.5", "<scale>0"), &["scale of its transform is 0"]);
    says(&sound.replace("<translation>1 2 3", "<translation>1 2"), &["`translation`"]);
    says(&sound.replace(" 0 0 0 1</transform>", "</transform>"), &["frame `00`", "not 16 numbers"]);
    says(&sound.replace("sensor_id=\"0\"", "sensor_id=\"9\""), &["sensor `9` is not in the file"]);
    says(&sound.replace("label=\"01\"", "label=\"../../01\""), &["outside the capture"]);
    says(&sound.replace("<cameras>", "<others>").replace("</cameras>", "</others>"), &["no `cameras`"]);
    let bomb = format!(
        "<!DOCTYPE d [<!ENTITY a \"aaaa\"><!ENTITY b \"&a;&a;\">]>{}",
        sound.split_once("?>").unwrap().1
    );
    says(&bomb, &["cameras.xml", "not a valid XML file"]);
    let deep = format!("<document><chunk>{}", "<a>".repeat(300_000));
    says(&deep, &["cameras.xml", "not a valid XML file"]);
    for cut in (200..sound.len() - 11).step_by(37) {
        put(&dir, "cameras.xml", &sound[..cut]);
        assert!(open(&dir).is_err(), "cut at {cut}");
    }
    put(&dir, "cameras.xml", [b"<document><chunk>\xFF\xFE", sound.as_bytes()].concat());
    refused(&dir, &["not UTF-8"]);
}

// ---------------------------------------------------------------------------------- RealityCapture

#[test]
fn more_views_than_are_allowed_are_refused_whatever_lists_them() {
    let (neus, _) = neus();
    let table = tempfile::tempdir().unwrap();
    photographs(table.path(), "images", 5);
    put(&table, "registration.csv", csv(5));
    for dir in [neus, table] {
        let limits = io::Limits { views: 4, ..io::Limits::default() };
        let options = CaptureOptions { limits, ..CaptureOptions::default() };
        let e = capture::open(dir.path(), &options).unwrap_err().to_string();
        assert!(e.contains("the number of views is 5, the limit is 4"), "{e}");
    }
}

/// Heading, pitch and roll of a camera: Rz(−heading) Rx(pitch) Ry(roll) in OpenGL axes.
fn angles(i: usize) -> [f64; 3] {
    let (rotation, _) = pose(i);
    let m = rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let pitch = m.y_axis.z.asin();
    let heading = m.y_axis.x.atan2(m.y_axis.y);
    let roll = (-m.x_axis.z).atan2(m.z_axis.z);
    [heading, pitch, roll].map(f64::to_degrees)
}

fn csv(count: usize) -> String {
    let line = |i: usize| {
        let ([h, p, r], at) = (angles(i), pose(i).1);
        // 45 · 160 / 36 = 200 pixels
        format!(
            "{i:02}.png,{},{},{},{h},{p},{r},45,0.0125,-0.00625,-0.1,0.02,0,0,0.001,0.002\n",
            at.x, at.y, at.z
        )
    };
    let header = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2\n";
    header.to_string() + &(0..count).map(line).collect::<String>()
}

#[test]
fn realitycapture_tables_and_sidecars_say_the_same() {
    let dir = tempfile::tempdir().unwrap();
    photographs(dir.path(), "images", 9);
    put(&dir, "registration.csv", csv(9).replace(",-0.1,0.02,0,0,0.001,0.002", ",0,0,0,0,0,0"));
    let c = open(&dir).unwrap();
    assert_eq!((c.format.as_str(), c.views.len(), c.up), ("RealityCapture", 9, Vec3::Z));
    assert_eq!(c.split(Split::Test).count(), 2);
    sees(&c, [200.0; 2], [82.0, 59.0]);
    put(&dir, "registration.csv", csv(9));
    let table = open(&dir).unwrap();
    let lens = table.views[0].camera.distortion;
    assert_eq!((lens.k1, lens.k2, lens.p1, lens.p2), (-0.1, 0.02, 0.001, 0.002));

    let xmp = |i: usize| {
        let (rotation, at) = pose(i);
        // columns of one are rows of the other
        let camera_from_world: Vec<f64> = rotation.to_cols_array().to_vec();
        format!(
            r#"<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
<rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute" xcr:DistortionModel="brown3t2"
 xcr:FocalLength35mm="45" xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="0.0125" xcr:PrincipalPointV="-0.00625"
 xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#"><xcr:Rotation>{}</xcr:Rotation><xcr:Position>{}</xcr:Position>
<xcr:DistortionCoeficients>-0.1 0.02 0 0 0.001 0.002</xcr:DistortionCoeficients></rdf:Description></rdf:RDF></x:xmpmeta>"#,
            list(&camera_from_world),
            list(&at.to_array())
        )
    };
    let beside = tempfile::tempdir().unwrap();
    photographs(beside.path(), "images", 9);
    for i in 0..8 {
        put(&beside, &format!("images/{i:02}.xmp"), xmp(i));
    }
    let c = open(&beside).unwrap();
    assert_eq!(c.views.len(), 8);
    assert!(c.warnings[0].contains("1 photographs have no camera"), "{:?}", c.warnings);
    for (a, b) in c.views.iter().zip(&table.views) {
        let (a, b) = (&a.camera, &b.camera);
        assert!(a.position.distance(b.position) < 1e-9 && (a.fx, a.cx, a.cy) == (b.fx, b.cx, b.cy));
        assert!((a.rotation - b.rotation).to_cols_array().iter().all(|v| v.abs() < 1e-9));
        assert_eq!(a.distortion, b.distortion);
    }
    for (old, new, words) in [
        ("brown3t2", "division", &["images/03.xmp", "`division` is not supported"][..]),
        ("0 0 0.001", "0 1 0.001", &["k4"]),
        ("Skew=\"0\"", "Skew=\"0.1\"", &["skewed"]),
        ("FocalLength35mm=\"45\"", "FocalLength35mm=\"inf\"", &["`FocalLength35mm` is not 1 finite"]),
        ("</rdf:RDF>", "", &["not a valid XMP file"]),
        ("<xcr:Position>", "<xcr:Position>7 ", &["`Position` is not 3"]),
    ] {
        put(&beside, "images/03.xmp", xmp(3).replace(old, new));
        refused(&beside, words);
    }
}

#[test]
fn hostile_tables_are_refused_with_their_line() {
    let dir = tempfile::tempdir().unwrap();
    photographs(dir.path(), "images", 3);
    let says = |text: &str, words: &[&str]| {
        put(&dir, "a.csv", text);
        refused(&dir, words);
    };
    let sound = csv(3);
    says(&sound.replace(",45,", ",wide,"), &["a.csv", "line 2", "`f` is `wide`"]);
    says(&sound.replace(",45,", ",NaN,"), &["`f` is `NaN`"]);
    says(&sound.replace(",45,", ",-45,"), &["focal length"]);
    says(&sound.replace(",heading", ",course"), &["it has no `heading`"]);
    says(&sound.replace("0,0,0.001", "0,1,0.001"), &["k4"]);
    says(&sound.replace("01.png", "../../01.png"), &["outside the capture"]);
    says(sound.lines().next().unwrap(), &["lists no photographs"]);
    says(&sound.replace("01.png", "00.png"), &["would both be called `00`"]);
    put(&dir, "a.csv", sound.replace("01.png", "\"01.png\""));
    assert_eq!(open(&dir).unwrap().views.len(), 3);
    for cut in (40..sound.len()).step_by(11) {
        put(&dir, "a.csv", &sound[..cut]);
        let _ = open(&dir);
    }
}
