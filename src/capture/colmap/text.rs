//! The text files: a line of numbers for each entry, two for an image, `#` before comments.

use super::super::folder::{in_file, shortened};
use super::super::frame::LensModel;
use super::{Camera, Image, Model, Rigid};
use crate::io::Limits;
use crate::{Error, Result};
use glam::DVec3;
use std::collections::HashMap;
use std::path::Path;
use std::str::{FromStr, SplitWhitespace};

/// A file's name for messages, with its text.
type Source = (String, String);

/// Reads a model; the points are optional.
pub(super) fn read(
    cameras: &Source,
    images: &Source,
    points: Option<&Source>,
    limits: &Limits,
) -> Result<Model> {
    let mut model = Model { cameras: read_cameras(cameras)?, ..Model::default() };
    model.images = read_images(images, limits)?;
    if let Some(source) = points {
        model.points = Some(entries(source).map(|line| point(line?)).collect::<Result<_>>()?);
    }
    Ok(model)
}

/// One line, taken word by word.
struct Line<'s> {
    file: &'s str,
    number: usize,
    text: &'s str,
    words: SplitWhitespace<'s>,
}

impl<'s> Line<'s> {
    fn new(file: &'s str, index: usize, text: &'s str) -> Line<'s> {
        Line { file, number: index + 1, text, words: text.split_whitespace() }
    }

    fn bad(&self, problem: impl std::fmt::Display) -> Error {
        let hint = "export the model again as text, or correct that line";
        in_file(self.file, format_args!("line {}: {problem}", self.number), hint)
    }

    fn word(&mut self, what: &str) -> Result<&'s str> {
        self.words.next().ok_or_else(|| self.bad(format_args!("it ends where {what} should follow")))
    }

    fn number<T: FromStr>(&mut self, what: &str) -> Result<T> {
        let word = self.word(what)?;
        word.parse().map_err(|_| self.bad(format_args!("`{}` is not {what}", shortened(word))))
    }

    fn rigid(&mut self) -> Result<Rigid> {
        let mut values = [0.0; 7];
        for value in &mut values {
            *value = self.number("a number of a pose")?;
        }
        Ok(values.into())
    }

    fn end(&mut self) -> Result<()> {
        match self.words.next() {
            None => Ok(()),
            Some(word) => Err(self.bad(format_args!("`{}` is left over", shortened(word)))),
        }
    }
}

/// Lines that are neither empty nor comments.
fn entries((file, text): &Source) -> impl Iterator<Item = Result<Line<'_>>> {
    let lines = text.lines().enumerate().map(|(i, line)| Line::new(file, i, line.trim()));
    lines.filter(|l| !l.text.is_empty() && !l.text.starts_with('#')).map(Ok)
}

fn read_cameras(source: &Source) -> Result<HashMap<u32, Camera>> {
    let mut cameras = HashMap::new();
    for line in entries(source) {
        let mut line = line?;
        let id = line.number("the number of a camera")?;
        let model = line.word("a camera model")?;
        let model = LensModel::named(model).map_err(|text| line.bad(format_args!("camera {id}: {text}")))?;
        let (width, height) = (line.number("a width")?, line.number("a height")?);
        let values = (0..model.count()).map(|_| line.number("a parameter of the lens"));
        let values = values.collect::<Result<Vec<f64>>>()?;
        line.end()?;
        if cameras.insert(id, Camera { model, width, height, values }).is_some() {
            return Err(line.bad(format_args!("camera {id} appears twice")));
        }
    }
    Ok(cameras)
}

fn read_images((file, text): &Source, limits: &Limits) -> Result<Vec<Image>> {
    let mut images = Vec::new();
    let mut lines = text.lines().enumerate();
    while let Some((i, text)) = lines.next() {
        let text = text.trim();
        if text.is_empty() || text.starts_with('#') {
            continue;
        }
        let mut line = Line::new(file, i, text);
        let (id, pose) = (line.number("the number of an image")?, line.rigid()?);
        let camera = line.number("the number of a camera")?;
        // the rest of the line: names have spaces
        let mut rest = text;
        for _ in 0..9 {
            rest = rest.trim_start().split_once(char::is_whitespace).map_or("", |(_, rest)| rest);
        }
        let name = rest.trim().to_string();
        if name.is_empty() {
            return Err(line.bad("it ends where a photograph's name should follow"));
        }
        images.push(Image { id, pose, camera, name });
        limits.check_views(Path::new(file), images.len())?;
        // the second line holds points (x, y, number) and is empty where there are none
        if let Some((i, points)) = lines.next()
            && points.split_whitespace().count() % 3 != 0
        {
            let problem =
                "an image takes two lines, the second of points (x, y, number) or empty; this is neither";
            return Err(Line::new(file, i, points).bad(problem));
        }
    }
    Ok(images)
}

fn point(mut line: Line) -> Result<DVec3> {
    line.number::<u64>("the number of a point")?;
    let mut coordinate = || line.number("a coordinate of a point");
    Ok(DVec3::new(coordinate()?, coordinate()?, coordinate()?))
}
