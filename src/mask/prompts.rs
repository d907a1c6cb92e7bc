//! `prompts.json`: which pixels a person clicked on, photograph by photograph.
//!
//! ```json
//! {"convention": "…", "frames": [
//!   {"file_path": "images/010.png", "points": [
//!     {"x": 181, "y": 288, "label": 1}, {"x": 32, "y": 51, "label": 0}]}]}
//! ```
//!
//! `x` runs right and `y` down, as pixel indices of the photograph at the size its camera was
//! calibrated for, whatever it is reduced to later; label 1 is the head, 0 is not. The file is
//! untrusted: names are only compared with those of the capture, never opened, and every number is
//! checked.

use super::clicks::Click;
use serde::Deserialize;
use serde::de::IgnoredAny;
use serde_json::{Number, Value, json};
use std::collections::BTreeMap;
use std::path::{Component, Path};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};
use tiface_capture::{Capture, View};

/// Value of `convention` that the writer uses.
const CONVENTION: &str =
    "x right, y down, pixel indices from the top left; label 1 = foreground, 0 = background";
/// A person clicks a dozen times on a photograph.
const MAX_POINTS: usize = 500;
/// Longer names fit no file system.
const MAX_NAME_BYTES: usize = 4096;
/// Maximum size: more than the largest capture needs with ten points a view.
const MAX_BYTES: u64 = 64 << 20;

/// The suggested fix for a file of another shape.
const SHAPE: &str = "write `{\"frames\": [{\"file_path\": …, \"points\": [{\"x\": …, \"y\": …, \"label\": 1}]}]}`, or \
                     click again on the page that `tiface mask CAPTURE --page` writes";

/// The suggested fix for a point that is none.
const POINT_HINT: &str = "correct that point, or remove it";

/// The clicks of a `prompts.json`.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Prompts {
    /// Photographs, in the file's order; none twice.
    pub frames: Vec<PhotoPrompts>,
}

/// The clicks on one photograph.
#[derive(Clone, Debug, PartialEq)]
pub struct PhotoPrompts {
    /// The photograph below the capture, with `/` between folders, with or without its ending.
    pub file_path: String,
    /// Its clicks, in the order they were made.
    pub points: Vec<Click>,
}

/// Reads a `prompts.json`.
///
/// # Errors
/// When the file cannot be read or something in it makes no sense; the message names the file and
/// the place in it.
pub fn read_prompts(path: &Path, limits: &Limits) -> Result<Prompts> {
    parse(path, &io::read_json(path, &at_most(limits))?, limits)
}

/// [`read_prompts`] on bytes; `path` is only for messages.
pub fn parse_prompts(path: &Path, bytes: &[u8], limits: &Limits) -> Result<Prompts> {
    parse(path, &io::parse_json(path, bytes, &at_most(limits))?, limits)
}

fn at_most(limits: &Limits) -> Limits {
    Limits { json_bytes: limits.json_bytes.min(MAX_BYTES), ..limits.clone() }
}

/// One click as written on a command line: `x,y,label`.
pub fn parse_point(text: &str) -> Result<Click> {
    let wrong = |problem: String| {
        Error::cannot(
            format!("the point `{}`: {problem}", shown(text)),
            "write column, row and label: `181,288,1` for the head, `32,51,0` for what is not",
        )
    };
    let parts: Vec<&str> = text.split(',').map(str::trim).collect();
    let [x, y, label] = parts[..] else {
        return Err(wrong(format!("expected three values `x,y,label`, found {}", parts.len())));
    };
    let number = |name: &str, text: &str| {
        let value = text.parse::<f64>().ok().filter(|v| v.is_finite());
        let value = value.ok_or_else(|| wrong(format!("{name} is `{}`, not a number", shown(text))))?;
        coordinate(value).map_err(|problem| wrong(format!("{name} {problem}")))
    };
    let head = match label {
        "1" => true,
        "0" => false,
        other => return Err(wrong(format!("its label is `{}`; known are 1 (head) and 0", shown(other)))),
    };
    Ok(Click { x: number("x", x)?, y: number("y", y)?, head })
}

/// Returns a coordinate that some photograph may have.
fn coordinate(value: f64) -> Result<f32, String> {
    match (-0.5..1e6).contains(&value) {
        true => Ok(value as f32),
        false => Err(format!("is {value}, outside every photograph")),
    }
}

/// Returns a text from a stranger, for a message: short and on one line.
fn shown(text: &str) -> String {
    let plain: String = text.chars().take(80).flat_map(char::escape_debug).collect();
    let cut = if text.chars().nth(80).is_some() { "…" } else { "" };
    plain.replace("\\'", "'").replace("\\\"", "\"") + cut
}

/// Returns the error for a place of a file.
fn wrong(file: &str, place: &str, problem: String, hint: &str) -> Error {
    Error::cannot(format!("`{file}`, {place}: {problem}"), hint)
}

/// The file as it is written; unknown keys are passed over.
#[derive(Deserialize)]
struct PromptsFile {
    frames: Vec<PhotoEntry>,
}

#[derive(Deserialize)]
struct PhotoEntry {
    file_path: String,
    points: Vec<PointEntry>,
}

#[derive(Deserialize)]
struct PointEntry {
    x: f64,
    y: f64,
    label: f64,
}

fn parse(path: &Path, value: &Value, limits: &Limits) -> Result<Prompts> {
    let file = path.to_string_lossy();
    let wrong = |place: &str, problem, hint: &str| wrong(&file, place, problem, hint);
    if let Err([_, found, _]) = io::typed::<BTreeMap<String, IgnoredAny>>(value) {
        let problem = format!("expected an object with a list `frames`, but it is {}", shown(&found));
        return Err(wrong("at the top", problem, SHAPE));
    }
    let PromptsFile { frames } = io::typed(value).map_err(|[key, found, expected]| {
        let hint = if key.contains(".points[") { POINT_HINT } else { SHAPE };
        wrong(&format!("`{key}`"), format!("it is {}, expected {expected}", shown(&found)), hint)
    })?;
    if frames.is_empty() {
        return Err(wrong("`frames`", "it is empty: nothing was clicked on".into(), SHAPE));
    }
    if frames.len() > limits.views {
        let problem = format!("it has {} entries, the limit is {}", frames.len(), limits.views);
        return Err(wrong("`frames`", problem, "keep the photographs that were clicked on"));
    }
    let mut prompts = Prompts::default();
    let mut seen = std::collections::HashMap::new();
    for (i, entry) in frames.into_iter().enumerate() {
        let place = format!("`frames[{i}]`");
        let file_path = below(&entry.file_path).map_err(|why| {
            let problem = format!("its `file_path` `{}` {why}", shown(&entry.file_path));
            wrong(&place, problem, "name the photograph as the camera file does: `images/010.png`")
        })?;
        if let Some(first) = seen.insert(file_path.clone(), i) {
            let problem = format!("`{}` was clicked on in `frames[{first}]` already", shown(&file_path));
            return Err(wrong(&place, problem, "put all points of a photograph into one frame"));
        }
        if entry.points.len() > MAX_POINTS {
            let problem = format!("it has {} points, the limit is {MAX_POINTS}", entry.points.len());
            return Err(wrong(&place, problem, "a dozen clicks are enough"));
        }
        let click = |(j, point): (usize, &PointEntry)| -> Result<Click> {
            let wrong = |key: &str, problem: String| {
                let place = format!("`frames[{i}].points[{j}].{key}`");
                wrong(&place, format!("it {problem}"), POINT_HINT)
            };
            let number = |key: &str, value: f64| coordinate(value).map_err(|problem| wrong(key, problem));
            let (x, y) = (number("x", point.x)?, number("y", point.y)?);
            match point.label {
                0.0 | 1.0 => Ok(Click { x, y, head: point.label == 1.0 }),
                other => Err(wrong("label", format!("is {other}; known are 1 (head) and 0 (not head)"))),
            }
        };
        let points = entry.points.iter().enumerate().map(click).collect::<Result<_>>()?;
        prompts.frames.push(PhotoPrompts { file_path, points });
    }
    Ok(prompts)
}

/// Returns a name below the capture with `/` between its parts, or why it is none.
fn below(name: &str) -> Result<String, &'static str> {
    let text = name.replace('\\', "/");
    if text.len() > MAX_NAME_BYTES {
        return Err("is too long for a name");
    }
    if text.contains('\0') {
        return Err("holds a zero byte");
    }
    if text.starts_with('/') || text.as_bytes().get(1) == Some(&b':') {
        return Err("is absolute; expected one relative to the capture");
    }
    let mut parts = Vec::new();
    for part in Path::new(&text).components() {
        match part {
            Component::Normal(p) => parts.push(p.to_string_lossy().into_owned()),
            Component::CurDir => {}
            _ => return Err("leads out of the capture"),
        }
    }
    if parts.is_empty() { Err("is empty") } else { Ok(parts.join("/")) }
}

/// Returns the name of a view's photograph in `prompts.json` and camera files: its path below the
/// capture.
pub fn file_path(capture: &Capture, view: &View) -> String {
    let path = view.photo.strip_prefix(&capture.root).unwrap_or(&view.photo);
    let parts: Vec<_> = path.components().map(|c| c.as_os_str().to_string_lossy()).collect();
    parts.join("/")
}

/// Returns a name without the ending of a picture.
fn stem(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((stem, ending)) if ["png", "jpg", "jpeg"].iter().any(|e| ending.eq_ignore_ascii_case(e)) => stem,
        _ => name,
    }
}

/// Name and size of a photograph.
struct Photographed<'a> {
    path: String,
    name: &'a str,
    /// The size clicks are in.
    size: (u32, u32),
    /// Whole factor by which it is reduced, and the size after.
    downscale: u32,
    reduced: (u32, u32),
}

impl Photographed<'_> {
    /// Returns whether a file of clicks means this photograph by `name`: with or without ending,
    /// with or without the folder common to all photographs, and in the folder of pictures already
    /// reduced (`images_4/`) as well.
    fn is_called(&self, name: &str) -> bool {
        let bare = stem(name);
        let same = |path: &str| path == name || stem(path) == name || stem(path) == bare;
        let suffixes = [format!("_{}", self.downscale), format!("_{}x", self.downscale)];
        let full = self.path.split_once('/').and_then(|(folder, rest)| {
            let folder = suffixes.iter().find_map(|s| folder.strip_suffix(s.as_str()))?;
            Some(format!("{folder}/{rest}"))
        });
        same(&self.path) || self.name == name || self.name == bare || full.is_some_and(|f| same(&f))
    }
}

impl Prompts {
    /// Returns the clicks of each view of a capture, parallel to its `views`, in pixel indices of
    /// its camera's picture; none where nothing was clicked. `file` is for messages.
    ///
    /// # Errors
    /// For a photograph that is no view, two names of one view, a point beside the photograph, a
    /// view without any click on the head.
    pub fn clicks(&self, file: &str, capture: &Capture) -> Result<Vec<Vec<Click>>> {
        let of = |view| Photographed {
            path: file_path(capture, view),
            name: &view.name,
            size: view.declared,
            downscale: view.downscale,
            reduced: (view.camera.width, view.camera.height),
        };
        self.of_photographs(file, &capture.views.iter().map(of).collect::<Vec<_>>())
    }

    fn of_photographs(&self, file: &str, photos: &[Photographed]) -> Result<Vec<Vec<Click>>> {
        let mut clicks = vec![Vec::new(); photos.len()];
        let mut by = vec![None; photos.len()];
        for (i, frame) in self.frames.iter().enumerate() {
            let place = format!("`frames[{i}]`");
            let name = shown(&frame.file_path);
            let exact = photos.iter().position(|p| p.path == frame.file_path);
            let called = || photos.iter().position(|p| p.is_called(&frame.file_path));
            let view = exact.or_else(called).ok_or_else(|| {
                let such =
                    photos.first().map_or(String::new(), |p| format!(", such as `{}`", shown(&p.path)));
                let hint = format!("name one of its {} photographs{such}", photos.len());
                wrong(file, &place, format!("`{name}` is no photograph of this capture"), &hint)
            })?;
            if let Some(first) = by[view].replace(i) {
                let problem = format!("`{name}` is the photograph of `frames[{first}]`");
                return Err(wrong(file, &place, problem, "put all points of a photograph into one frame"));
            }
            let photo = &photos[view];
            let (w, h) = photo.size;
            if let Some(j) = frame.points.iter().position(|c| !c.is_inside((w, h))) {
                let Click { x, y, .. } = frame.points[j];
                let place = format!("`frames[{i}].points[{j}]`");
                let problem = format!("({x}, {y}) lies outside `{name}`, which is {w} × {h} pixels");
                let hint = "click on the full-size photograph: x from 0 to width − 1, y from 0 to height − 1";
                return Err(wrong(file, &place, problem, hint));
            }
            if !frame.points.is_empty() && !frame.points.iter().any(|p| p.head) {
                let problem = format!("no point of `{name}` is on the head (label 1)");
                return Err(wrong(
                    file,
                    &place,
                    problem,
                    "add a click on face and hair, or remove the frame",
                ));
            }
            // pixel i of the reduced picture averages pixels d i to d i + d − 1; what fills no
            // block is dropped
            let d = photo.downscale.max(1) as f32;
            let scaled = |v: f32, side: u32| ((v + 0.5) / d - 0.5).min(side as f32 - 1.0);
            let (rw, rh) = photo.reduced;
            let reduced = |c: &Click| Click { x: scaled(c.x, rw), y: scaled(c.y, rh), ..*c };
            clicks[view] = frame.points.iter().map(reduced).collect();
        }
        Ok(clicks)
    }

    /// As the text of a `prompts.json`; whole coordinates without a fraction.
    pub fn to_json(&self) -> Value {
        let number = |v: f32| match v.fract() == 0.0 {
            true => Some(Number::from(v as i64)),
            false => Number::from_f64(v as f64),
        };
        let point = |c: &Click| json!({"x": number(c.x), "y": number(c.y), "label": c.head as u8});
        let frame = |frame: &PhotoPrompts| {
            let points: Vec<Value> = frame.points.iter().map(point).collect();
            json!({"file_path": frame.file_path, "points": points})
        };
        json!({"convention": CONVENTION, "frames": self.frames.iter().map(frame).collect::<Vec<_>>()})
    }

    /// Writes a `prompts.json`.
    pub fn write(&self, path: &Path) -> Result<()> {
        let text = format!("{:#}\n", self.to_json());
        Ok(io::write_atomic(path, text.as_bytes())?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parsed(text: &str) -> Result<Prompts> {
        parse_prompts(Path::new("p.json"), text.as_bytes(), &Limits::default())
    }

    fn frame(path: &str, points: &str) -> String {
        format!("{{\"file_path\": {}, \"points\": {points}}}", json!(path))
    }

    fn one(path: &str, points: &str) -> String {
        format!("{{\"frames\": [{}]}}", frame(path, points))
    }

    const POINT: &str = r#"[{"x": 3, "y": 4.5, "label": 1}]"#;

    fn photograph<'a>(path: &str, name: &'a str, size: (u32, u32), downscale: u32) -> Photographed<'a> {
        Photographed {
            path: path.into(),
            name,
            size,
            downscale,
            reduced: (size.0 / downscale, size.1 / downscale),
        }
    }

    #[test]
    fn what_is_written_is_read_back() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("prompts.json");
        let click = |x, y, head| Click { x, y, head };
        let points = vec![click(181.0, 288.0, true), click(0.5, 51.25, false)];
        let prompts =
            Prompts { frames: vec![PhotoPrompts { file_path: "images/a </script>.png".into(), points }] };
        prompts.write(&path).unwrap();
        assert_eq!(read_prompts(&path, &Limits::default()).unwrap(), prompts);
        let text = std::fs::read_to_string(&path).unwrap();
        assert!(
            text.contains("\"x\": 181,") && text.contains("51.25") && text.contains("foreground"),
            "{text}"
        );
    }

    #[test]
    fn whatever_is_wrong_is_named_with_its_place() {
        let twice = format!("{{\"frames\": [{}, {}]}}", frame("a.png", POINT), frame("./a.png", POINT));
        let cases = [
            ("[]".into(), "at the top", "expected an object with a list `frames`, but it is a list"),
            ("{\"frame\": []}".into(), "`frames`", "missing"),
            ("{\"frames\": 3}".into(), "`frames`", "is 3, expected a list"),
            ("{\"frames\": []}".into(), "`frames`", "is empty"),
            ("{\"frames\": [7]}".into(), "`frames[0]`", "is 7"),
            ("{\"frames\": [{\"file_path\": 7}]}".into(), "`frames[0].file_path`", "is 7, expected text"),
            ("{\"frames\": [{\"file_path\": \"a\"}]}".into(), "`frames[0].points`", "missing"),
            (one("a", "{}"), "`frames[0].points`", "is an object, expected a list"),
            (one("a", "[1]"), "`frames[0].points[0]`", "is 1"),
            (one("a", r#"[{"x": "3", "y": 4, "label": 1}]"#), "points[0].x`", "is \"3\", expected a number"),
            (one("a", r#"[{"x": 3, "y": null, "label": 1}]"#), "points[0].y`", "null"),
            (one("a", r#"[{"x": 3, "y": 4}]"#), "points[0].label`", "missing"),
            (one("a", r#"[{"x": 3, "y": 4, "label": 2}]"#), "points[0].label`", "it is 2"),
            (one("a", r#"[{"x": 3, "y": 4, "label": true}]"#), "points[0].label`", "true"),
            (one("a", r#"[{"x": 3, "y": 4, "label": 0.5}]"#), "points[0].label`", "0.5"),
            (one("a", r#"[{"x": -3, "y": 4, "label": 1}]"#), "points[0].x`", "-3, outside every"),
            (one("a", r#"[{"x": 3, "y": 1e300, "label": 1}]"#), "points[0].y`", "outside every"),
            (one("/etc/passwd", POINT), "`frames[0]`", "is absolute"),
            (one("C:\\a.png", POINT), "`frames[0]`", "is absolute"),
            (one("images/../../a.png", POINT), "`frames[0]`", "leads out"),
            (one("..\\a.png", POINT), "`frames[0]`", "leads out"),
            (one("", POINT), "`frames[0]`", "is empty"),
            (one("./", POINT), "`frames[0]`", "is empty"),
            (one("a\0b", POINT), "`frames[0]`", "zero byte"),
            (one(&"a/".repeat(3000), POINT), "`frames[0]`", "too long"),
            (twice, "`frames[1]`", "in `frames[0]` already"),
        ];
        for (text, place, problem) in cases {
            let error = parsed(&text).expect_err(&text);
            let said = error.to_string();
            assert!(
                said.starts_with("`p.json`, ") && said.contains(place) && said.contains(problem),
                "{said}"
            );
            assert!(said.len() < 400 && !error.hint().is_empty(), "{said}");
        }
    }

    #[test]
    fn sizes_and_numbers_beyond_reason_are_refused_by_the_reader() {
        let many = format!("[{}]", vec![r#"{"x":1,"y":1,"label":1}"#; MAX_POINTS + 1].join(","));
        assert!(parsed(&one("a", &many)).unwrap_err().to_string().contains("the limit is 500"));
        let few = Limits { views: 1, ..Limits::default() };
        let two = format!("{{\"frames\": [{}, {}]}}", frame("a", POINT), frame("b", POINT));
        let error = parse_prompts(Path::new("p.json"), two.as_bytes(), &few).unwrap_err();
        assert!(error.to_string().contains("2 entries, the limit is 1"), "{error}");
        for text in [one("a", r#"[{"x": NaN}]"#), one("a", r#"[{"x": 1e999}]"#), "{".into(), String::new()] {
            let error = parsed(&text).unwrap_err();
            assert!(error.to_string().contains("p.json") && !error.hint().is_empty(), "{text}: {error}");
        }
        let tight = Limits { json_bytes: 10, ..Limits::default() };
        let error = parse_prompts(Path::new("p.json"), one("a", POINT).as_bytes(), &tight).unwrap_err();
        assert!(error.to_string().contains("p.json") && error.to_string().contains("10"), "{error}");
    }

    #[test]
    fn photographs_are_found_by_several_names_and_by_no_wrong_one() {
        let full = photograph("images/left/010.JPG", "left/010", (40, 30), 1);
        for name in
            ["images/left/010.JPG", "images/left/010", "images/left/010.png", "left/010", "left/010.jpg"]
        {
            assert!(full.is_called(name), "{name}");
        }
        for name in
            ["010", "images/010.JPG", "images/left/01", "images/left/010.JPG.png", "images/left/010.txt"]
        {
            assert!(!full.is_called(name), "{name}");
        }
        let reduced = photograph("images_4/a.b.png", "a.b", (40, 30), 4);
        assert!(reduced.is_called("images/a.b.png") && reduced.is_called("images/a.b"));
        assert!(!reduced.is_called("images_2/a.b.png") && !reduced.is_called("images/a"));
    }

    #[test]
    fn clicks_come_in_the_pixels_of_the_reduced_picture() {
        let text = r#"[{"x": 0, "y": 1.5, "label": 1}, {"x": 41, "y": 29, "label": 0}]"#;
        let photos =
            [photograph("images/b.png", "b", (42, 30), 4), photograph("images/a.png", "a", (42, 30), 4)];
        let clicks = parsed(&one("images/a.png", text)).unwrap().of_photographs("p.json", &photos).unwrap();
        // (0 + ½) / 4 − ½ = −3/8 and (1.5 + ½) / 4 − ½ = 0; (29 + ½) / 4 − ½ = 6.875, of 7 rows
        // 6 at most; column 41 lies in the two that fill no block of four: the last of 10 takes it
        assert!(clicks[0].is_empty());
        let found: Vec<_> = clicks[1].iter().map(|c| (c.x, c.y, c.head)).collect();
        assert_eq!(found, [(-0.375, 0.0, true), (9.0, 6.0, false)]);
    }

    #[test]
    fn clicks_that_fit_no_photograph_are_named() {
        let photos =
            [photograph("images/a.png", "a", (42, 30), 1), photograph("images/b.png", "b", (42, 30), 1)];
        let of = |text: String| parsed(&text).unwrap().of_photographs("p.json", &photos).unwrap_err();
        let error = of(one("images/c.png", POINT));
        assert!(error.to_string().contains("`images/c.png` is no photograph of this capture"), "{error}");
        assert!(error.hint().contains("`images/a.png`"), "{}", error.hint());
        let error = of(one("a", r#"[{"x": 1, "y": 2, "label": 1}, {"x": 41.5, "y": 2, "label": 0}]"#));
        assert!(error.to_string().contains("`frames[0].points[1]`: (41.5, 2) lies outside `a`"), "{error}");
        let error = of(format!("{{\"frames\": [{}, {}]}}", frame("a", POINT), frame("images/a.jpg", POINT)));
        assert!(error.to_string().contains("is the photograph of `frames[0]`"), "{error}");
        let error = of(one("b", r#"[{"x": 1, "y": 2, "label": 0}]"#));
        assert!(error.to_string().contains("no point of `b` is on the head"), "{error}");
        // nothing clicked is no error: the page keeps such frames out, a person may not
        let empty = parsed(&one("b", "[]")).unwrap().of_photographs("p.json", &photos).unwrap();
        assert!(empty.iter().all(Vec::is_empty));
    }

    #[test]
    fn a_point_of_the_command_line_is_three_numbers() {
        assert_eq!(parse_point(" 181, 288.5 ,1").unwrap(), Click { x: 181.0, y: 288.5, head: true });
        assert!(!parse_point("0,0,0").unwrap().head);
        for (text, word) in [
            ("1,2", "found 2"),
            ("1,2,1,3", "found 4"),
            ("a,2,1", "x is `a`"),
            ("1,NaN,1", "y is `NaN`"),
            ("1,inf,1", "not a number"),
            ("-4,2,1", "outside every"),
            ("1,2,head", "`head`"),
            ("1,2,-1", "known are 1"),
        ] {
            let error = parse_point(text).unwrap_err();
            assert!(error.to_string().contains(word), "{text}: {error}");
        }
    }

    #[test]
    fn the_clicks_of_the_shared_captures_are_read() {
        let shared = std::env::var("TIFACE_SHARED")
            .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../shared").into());
        for name in ["lps", "nefertiti"] {
            let folder = Path::new(&shared).join("data/captures").join(name);
            if !folder.is_dir() {
                eprintln!("skipped: the capture `{name}` is not at {}", folder.display());
                continue;
            }
            let prompts = read_prompts(&folder.join("prompts.json"), &Limits::default()).unwrap();
            assert_eq!(prompts.frames.len(), 3);
            let capture = tiface_capture::open(&folder, &Default::default()).unwrap();
            let clicks = prompts.clicks("prompts.json", &capture).unwrap();
            let clicked = |v: &&Vec<Click>| v.len() == 6 && v.iter().filter(|c| c.head).count() == 3;
            assert_eq!(clicks.iter().filter(clicked).count(), 3, "{name}");
            for frame in &prompts.frames {
                let view =
                    capture.views.iter().position(|v| file_path(&capture, v) == frame.file_path).unwrap();
                assert_eq!(clicks[view], frame.points);
            }
        }
    }
}
