//! The text files: a line of numbers for each entry, two for an image, `#` before comments.
//!
//! An image's second line holds the points that it shows (x, y, number), and is empty where there
//! are none. Scripts and editors leave empty lines out: then the next image follows at once, which
//! its numbers and its name tell from points.

use super::super::folder::{in_file, shortened};
use super::super::lens_model::LensModel;
use super::{Camera, Image, Model, Rigid};
use glam::DVec3;
use std::cell::Cell;
use std::collections::HashMap;
use std::path::Path;
use std::str::{FromStr, SplitWhitespace};
use tiface_base::io::Limits;
use tiface_base::{Error, Result};

/// Greatest difference from 1 of the length of a quaternion that tells an image's line from points.
const UNIT: f64 = 1e-2;

/// A text file.
pub(super) struct Source {
    /// Its name, for messages.
    file: String,
    text: String,
    /// Whether a number with a decimal comma was read.
    commas: Cell<bool>,
}

impl Source {
    pub fn new(file: String, text: String) -> Source {
        Source { file, text, commas: Cell::new(false) }
    }

    /// Returns the lines, without the mark that some editors put before the first.
    fn lines(&self) -> impl Iterator<Item = Line<'_>> {
        let text = self.text.trim_start_matches('\u{feff}');
        text.lines().enumerate().map(|(i, line)| Line::new(self, i + 1, line.trim()))
    }

    /// Returns the lines that are neither empty nor comments.
    fn entries(&self) -> impl Iterator<Item = Line<'_>> {
        self.lines().filter(|line| !line.text.is_empty() && !line.is_comment())
    }

    /// Returns what to say of its numbers.
    fn note(&self) -> Option<String> {
        let file = &self.file;
        self.commas.get().then(|| format!("`{file}` has decimal commas, which are read as decimal points"))
    }
}

/// Reads a model; the points are optional.
pub(super) fn read(
    cameras: &Source,
    images: &Source,
    points: Option<&Source>,
    limits: &Limits,
) -> Result<Model> {
    let mut model = Model { cameras: read_cameras(cameras)?, ..Model::default() };
    let (found, alone) = read_images(images, &model.cameras, limits)?;
    model.images = found;
    if let Some(source) = points {
        model.points = Some(source.entries().map(point).collect::<Result<_>>()?);
    }
    let sources = [Some(cameras), Some(images), points];
    model.notes = sources.into_iter().flatten().filter_map(Source::note).collect();
    model.notes.extend(note_alone(&images.file, &alone));
    Ok(model)
}

/// Returns what to say of images without a second line, which stand in these lines.
fn note_alone(file: &str, alone: &[usize]) -> Option<String> {
    let (first, last) = (alone.first()?, alone.last()?);
    let stand = match alone.len() {
        1 => format!("the image in line {first} stands"),
        n => format!("{n} images in lines {first} to {last} stand"),
    };
    Some(format!(
        "`{file}`: {stand} without a second line, of points; what follows is read as the next image"
    ))
}

/// One line, taken word by word.
#[derive(Clone)]
struct Line<'s> {
    source: &'s Source,
    number: usize,
    text: &'s str,
    words: SplitWhitespace<'s>,
}

impl<'s> Line<'s> {
    fn new(source: &'s Source, number: usize, text: &'s str) -> Line<'s> {
        Line { source, number, text, words: text.split_whitespace() }
    }

    fn is_comment(&self) -> bool {
        self.text.starts_with('#')
    }

    /// Returns whether it holds points in an image: triples of numbers.
    fn is_points(&self) -> bool {
        let count = self.words.clone().try_fold(0, |n, word| decimal(word).map(|_| n + 1));
        count.is_some_and(|n: usize| n.is_multiple_of(3))
    }

    /// Returns whether commas separate its values, as in a table; decimal commas are single.
    fn is_of_commas(&self) -> bool {
        let first = self.text.split_whitespace().next().unwrap_or_default();
        let is_joined = first.ends_with(',') || first.matches(',').count() > 1;
        is_joined && self.text.matches(',').count() >= 4
    }

    fn bad(&self, problem: impl std::fmt::Display) -> Error {
        if self.is_of_commas() {
            let (file, number) = (&self.source.file, self.number);
            let hint = format!("write blanks in place of the commas: `sed -i 's/, */ /g' {file}`");
            let text = format!("line {number}: commas separate its values, where COLMAP has blanks");
            return in_file(file, text, hint);
        }
        let hint = "export the model again as text, or correct that line";
        in_file(&self.source.file, format_args!("line {}: {problem}", self.number), hint)
    }

    fn word(&mut self, what: &str) -> Result<&'s str> {
        self.words.next().ok_or_else(|| self.bad(format_args!("it ends where {what} should follow")))
    }

    fn number<T: FromStr>(&mut self, what: &str) -> Result<T> {
        let word = self.word(what)?;
        word.parse().map_err(|_| self.bad(format_args!("`{}` is not {what}", shortened(word))))
    }

    fn decimal(&mut self, what: &str) -> Result<f64> {
        let word = self.word(what)?;
        let value = decimal(word);
        let value = value.ok_or_else(|| self.bad(format_args!("`{}` is not {what}", shortened(word))))?;
        if word.contains(',') {
            self.source.commas.set(true);
        }
        Ok(value)
    }

    fn rigid(&mut self) -> Result<Rigid> {
        let mut values = [0.0; 7];
        for value in &mut values {
            *value = self.decimal("a number of a pose")?;
        }
        Ok(values.into())
    }

    /// Reads the line of an image.
    fn image(mut self) -> Result<Image> {
        let (id, pose) = (self.number("the number of an image")?, self.rigid()?);
        let camera = self.number("the number of a camera")?;
        // the rest of the line: names have spaces
        let mut rest = self.text;
        for _ in 0..9 {
            rest = rest.trim_start().split_once(char::is_whitespace).map_or("", |(_, rest)| rest);
        }
        let name = rest.trim().to_string();
        if name.is_empty() {
            return Err(self.bad("it ends where a photograph's name should follow"));
        }
        Ok(Image { id, pose, camera, name })
    }

    fn end(&mut self) -> Result<()> {
        match self.words.next() {
            None => Ok(()),
            Some(word) => Err(self.bad(format_args!("`{}` is left over", shortened(word)))),
        }
    }
}

/// Returns the number that a word is; a single comma between digits is a decimal point.
fn decimal(word: &str) -> Option<f64> {
    let with_point = || {
        let (whole, fraction) = word.split_once(',')?;
        let is_digit = |c: Option<char>| c.is_some_and(|c| c.is_ascii_digit());
        let is_decimal = is_digit(whole.chars().next_back()) && is_digit(fraction.chars().next());
        is_decimal.then(|| format!("{whole}.{fraction}").parse().ok())?
    };
    word.parse().ok().or_else(with_point)
}

fn read_cameras(source: &Source) -> Result<HashMap<u32, Camera>> {
    let mut cameras = HashMap::new();
    for mut line in source.entries() {
        let id = line.number("the number of a camera")?;
        let model = line.word("a camera model")?;
        let model = LensModel::named(model).map_err(|text| line.bad(format_args!("camera {id}: {text}")))?;
        let (width, height) = (line.number("a width")?, line.number("a height")?);
        let values = (0..model.count()).map(|_| line.decimal("a parameter of the lens"));
        let values = values.collect::<Result<Vec<f64>>>()?;
        line.end()?;
        if cameras.insert(id, Camera { model, width, height, values }).is_some() {
            return Err(line.bad(format_args!("camera {id} appears twice")));
        }
    }
    Ok(cameras)
}

/// Returns the images, and the numbers of the lines of those that the next image follows at once.
fn read_images(
    source: &Source,
    cameras: &HashMap<u32, Camera>,
    limits: &Limits,
) -> Result<(Vec<Image>, Vec<usize>)> {
    let (mut images, mut alone) = (Vec::new(), Vec::new());
    // an empty line stands where points may follow: some editors put one after each line
    let mut is_open = false;
    let mut lines = source.lines().filter(|line| !line.is_comment()).peekable();
    while let Some(line) = lines.next() {
        if line.text.is_empty() {
            continue;
        } else if is_open && line.is_points() && check_image(&line, cameras).is_err() {
            is_open = false;
            continue;
        }
        let number = line.number;
        images.push(line.image()?);
        limits.check_views(Path::new(&source.file), images.len())?;
        let second = lines.next_if(Line::is_points);
        is_open = second.as_ref().is_some_and(|line| line.text.is_empty());
        match lines.peek() {
            Some(next) if second.is_none() => {
                check_image(next, cameras)?;
                alone.push(number);
            }
            // the last of such a file
            None if second.is_none() && !alone.is_empty() => alone.push(number),
            _ => {}
        }
    }
    Ok((images, alone))
}

/// Refuses the line after an image that is neither its points nor the next image.
fn check_image(line: &Line, cameras: &HashMap<u32, Camera>) -> Result<()> {
    let takes = "an image takes two lines, the second of points (x, y, number) or empty";
    let image = line.clone().image().map_err(|_| line.bad(format_args!("{takes}; this is neither")))?;
    let [w, x, y, z] = image.pose.quaternion;
    if !cameras.contains_key(&image.camera) {
        let camera = image.camera;
        return Err(line.bad(format_args!(
            "{takes}; this would be the next image, but its camera {camera} is not in the cameras file"
        )));
    } else if ((w * w + x * x + y * y + z * z).sqrt() - 1.0).abs() > UNIT {
        return Err(line.bad(format_args!(
            "{takes}; this would be the next image, but its quaternion is not of length 1"
        )));
    }
    Ok(())
}

fn point(mut line: Line) -> Result<DVec3> {
    line.number::<u64>("the number of a point")?;
    let mut coordinate = || line.decimal("a coordinate of a point");
    Ok(DVec3::new(coordinate()?, coordinate()?, coordinate()?))
}
