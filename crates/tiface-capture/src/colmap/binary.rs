//! The binary files: little-endian numbers, counts before lists. Every count is compared with the
//! bytes that are left before anything is reserved.

use super::super::lens_model::LensModel;
use super::{Camera, Image, Model, Rigid};
use glam::DVec3;
use std::collections::HashMap;
use std::path::{Path, PathBuf};
use tiface_base::Result;
use tiface_base::io::{Limits, ReadError};

/// A file with its bytes.
type Source = (PathBuf, Vec<u8>);

/// COLMAP's own limit is that of the file system.
const MAX_NAME_BYTES: usize = 4096;

/// Reads a model; the points are optional.
pub(super) fn read(
    cameras: &Source,
    images: &Source,
    points: Option<&Source>,
    limits: &Limits,
) -> Result<Model> {
    let mut model = Model { cameras: read_cameras(cameras)?, ..Model::default() };
    model.images = read_images(images, limits)?;
    model.points = points.map(|points| Ok::<_, ReadError>(read_points(points)?.positions)).transpose()?;
    Ok(model)
}

/// Bytes that are taken from the front.
struct Cursor<'b> {
    path: &'b Path,
    bytes: &'b [u8],
    at: usize,
}

impl<'b> Cursor<'b> {
    fn new((path, bytes): &'b Source) -> Cursor<'b> {
        Cursor { path, bytes, at: 0 }
    }

    fn bad(&self, problem: impl Into<String>) -> ReadError {
        ReadError::damaged(self.path, "COLMAP", self.at as u64, problem)
    }

    fn left(&self) -> usize {
        self.bytes.len() - self.at
    }

    fn take<const N: usize>(&mut self) -> Result<[u8; N], ReadError> {
        let found = self.bytes[self.at..].first_chunk::<N>();
        let found = *found.ok_or_else(|| self.bad(format!("it ends where {N} bytes should follow")))?;
        self.at += N;
        Ok(found)
    }

    fn u32(&mut self) -> Result<u32, ReadError> {
        self.take().map(u32::from_le_bytes)
    }

    fn i32(&mut self) -> Result<i32, ReadError> {
        self.take().map(i32::from_le_bytes)
    }

    fn u64(&mut self) -> Result<u64, ReadError> {
        self.take().map(u64::from_le_bytes)
    }

    fn f64(&mut self) -> Result<f64, ReadError> {
        self.take().map(f64::from_le_bytes)
    }

    fn rigid(&mut self) -> Result<Rigid, ReadError> {
        let mut values = [0.0; 7];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values.into())
    }

    /// `count` entries of at least `size` bytes each must fit into what is left.
    fn fits(&self, count: u64, size: usize, what: &str) -> Result<usize, ReadError> {
        let most = self.left() / size;
        match usize::try_from(count) {
            Ok(n) if n <= most => Ok(n),
            _ => Err(self
                .bad(format!("it says {count} {what}, but its {} bytes hold {most} at most", self.left()))),
        }
    }

    fn counted(&mut self, size: usize, what: &str) -> Result<usize, ReadError> {
        let count = self.u64()?;
        self.fits(count, size, what)
    }

    fn skip(&mut self, count: usize, size: usize) {
        self.at += count * size; // `fits` has compared it with what is left
    }

    fn name(&mut self) -> Result<String, ReadError> {
        let window = &self.bytes[self.at..][..self.left().min(MAX_NAME_BYTES + 1)];
        let Some(length) = window.iter().position(|&b| b == 0) else {
            return Err(self.bad(format!("a name does not end within {MAX_NAME_BYTES} bytes")));
        };
        let name = std::str::from_utf8(&window[..length]).map_err(|_| self.bad("a name is not UTF-8"))?;
        self.at += length + 1;
        Ok(name.into())
    }

    fn end(&self) -> Result<(), ReadError> {
        match self.left() {
            0 => Ok(()),
            n => Err(self.bad(format!("{n} bytes are left over"))),
        }
    }
}

pub(super) fn read_cameras(source: &Source) -> Result<HashMap<u32, Camera>, ReadError> {
    let mut c = Cursor::new(source);
    // number, model, width, height and two parameters at least: those of EQUIRECTANGULAR, to be
    // refused by name
    let n = c.counted(4 + 4 + 16 + 2 * 8, "cameras")?;
    let mut cameras = HashMap::with_capacity(n);
    for _ in 0..n {
        let start = c.at;
        let (id, model) = (c.u32()?, c.i32()?);
        let model = LensModel::numbered(model).map_err(|text| c.bad(format!("camera {id}: {text}")))?;
        let (width, height) = (c.u64()?, c.u64()?);
        let values = (0..model.count()).map(|_| c.f64()).collect::<Result<_, _>>()?;
        if cameras.insert(id, Camera { model, width, height, values }).is_some() {
            c.at = start;
            return Err(c.bad(format!("camera {id} appears twice")));
        }
    }
    c.end()?;
    Ok(cameras)
}

pub(super) fn read_images(source: &Source, limits: &Limits) -> Result<Vec<Image>, ReadError> {
    let mut c = Cursor::new(source);
    // number, pose, camera, an empty name, no points
    let n = c.counted(4 + 56 + 4 + 1 + 8, "images")?;
    limits.check_views(&source.0, n)?;
    let mut images = Vec::with_capacity(n);
    for _ in 0..n {
        let (id, pose, camera, name) = (c.u32()?, c.rigid()?, c.u32()?, c.name()?);
        let points = c.counted(24, "points in an image")?;
        c.skip(points, 24);
        images.push(Image { id, pose, camera, name });
    }
    c.end()?;
    Ok(images)
}

/// The points of a model.
#[derive(Debug, Default)]
pub(super) struct Points {
    pub positions: Vec<DVec3>,
    /// Sum of their mean reprojection errors, pixels.
    pub error_px: f64,
    /// How often they are seen, in all.
    pub sightings: usize,
}

pub(super) fn read_points(source: &Source) -> Result<Points, ReadError> {
    let mut c = Cursor::new(source);
    // number, position, color, error, no track
    let n = c.counted(8 + 24 + 3 + 8 + 8, "points")?;
    let mut points = Points { positions: Vec::with_capacity(n), ..Points::default() };
    for _ in 0..n {
        c.u64()?;
        points.positions.push(DVec3::new(c.f64()?, c.f64()?, c.f64()?));
        c.take::<3>()?;
        points.error_px += c.f64()?;
        let track = c.counted(8, "observations of a point")?;
        c.skip(track, 8);
        points.sightings += track;
    }
    c.end()?;
    Ok(points)
}
