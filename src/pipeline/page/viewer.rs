//! The head to turn, for a page: a copy of `head.glb` that is small enough, and where the photographs were taken from.

use super::views;
use crate::Result;
use crate::config::{MeshFormat, MeshFrame, Stage};
use crate::geom::Similarity;
use crate::image::Photo;
use crate::io::{self, Limits};
use crate::mesh::files::{ExportOptions, HeadMesh, HeadTexture, compact_glb, open_mesh, to_glb, weld};
use crate::mesh::{SimplifyConfig, simplify};
use crate::pipeline::export::{Export, center};
use crate::pipeline::line::Line;
use crate::pipeline::mesh::{finished_mesh, head_mesh};
use crate::report::{ViewRow, Viewer, ViewerCamera, viewer_html};
use crate::run::{Record, read_record};
use crate::{Error, Quiet};
use glam::Vec3;
use std::cell::RefCell;
use std::path::Path;

/// Bytes of a mesh inside a page at most: 200,000 triangles with a texture.
const MOST_BYTES: usize = 4_600_000;
/// Triangles of a copy of a larger mesh, which has colors at its vertices.
const FEWER: usize = 100_000;

/// The head of a run, without cameras, and from the dataset's world to its coordinates; `None` before the stage `mesh`.
pub(super) fn viewer(line: &Line) -> Result<Option<(Viewer, Similarity)>> {
    match read_record(&line.run.path(Stage::Mesh)) {
        Ok(Some(record)) => shown(line, &record).map(Some),
        _ => Ok(None),
    }
}

/// The head of a run whose mesh is done.
fn shown(line: &Line, mesh: &Record) -> Result<(Viewer, Similarity)> {
    mesh.require_products(&line.run.path(Stage::Mesh))?;
    let (file, export) = (line.run.path("mesh/head.glb"), Export::new(&line.capture, line.config));
    let head = head_mesh(line)?;
    let as_glb = |head: &HeadMesh| Ok(export.files(head, MeshFormat::Glb, "head")?.files.swap_remove(0).1);
    let bytes = if io::is_file(&file) { io::read_bytes(&file, &Limits::default())? } else { as_glb(&head)? };
    let file_from_world = export.file_from_world(&head)?;
    let front = match export.frame {
        MeshFrame::Head => Vec3::Z,
        MeshFrame::Dataset => {
            let front = export.front(center(&head.mesh, &head.world_from_scene)).unwrap_or(Vec3::ZERO);
            file_from_world.direction(front)
        }
    };
    let (glb, note) = small(&bytes, &file, || Ok(head), as_glb)?;
    let name = line.capture.name.clone();
    let viewer = Viewer { name, note, front: front.to_array(), glb, cameras: Vec::new() };
    Ok((viewer, file_from_world))
}

/// Where the photographs of these rows were taken from.
pub(super) fn cameras(line: &Line, rows: &[ViewRow], file_from_world: &Similarity) -> Vec<ViewerCamera> {
    let camera = |(i, row): (usize, &ViewRow)| {
        let view = line.capture.views.iter().find(|v| v.name == row.name)?;
        let c = view.camera.resized(row.width, row.height).transformed(file_from_world);
        Some(ViewerCamera {
            name: row.name.clone(),
            width: c.width,
            height: c.height,
            fx: c.fx,
            fy: c.fy,
            cx: c.cx,
            cy: c.cy,
            position: c.position.to_array(),
            axes: c.rotation.to_cols_array_2d(),
            picture: format!("photo-{i}"),
        })
    };
    rows.iter().enumerate().filter_map(camera).collect()
}

/// Returns a page with the head of a run to turn, and its held-out photographs if they are there.
///
/// # Errors
///
/// The run has no mesh yet, or it is damaged.
pub fn head_page(line: &Line) -> Result<String> {
    let (mut viewer, file_from_world) = shown(line, &finished_mesh(line.run.dir())?)?;
    let most = super::MOST_BYTES.saturating_sub(viewer.glb.len().div_ceil(3) * 4);
    // without photographs there is still the head
    let (mut rows, _) = if line.gone.is_none() { views::rows(line, most)? } else { Default::default() };
    rows.iter_mut().for_each(|row| row.pictures.clear());
    viewer.cameras = cameras(line, &rows, &file_from_world);
    viewer_html(&viewer, &rows)
}

/// Returns a page with the mesh of a GLB, OBJ or PLY file to turn, and what of it cannot be shown. `up` is where its up is.
///
/// # Errors
///
/// The file cannot be read, or shows what a page cannot.
pub fn viewer_of_file(path: &Path, up: Vec3) -> Result<(String, Vec<String>)> {
    let bytes = io::read_bytes(path, &Limits::default())?;
    let warnings = RefCell::new(Vec::new());
    let open = || {
        let opened = open_mesh(path)?;
        warnings.replace(opened.warnings);
        Ok(opened.head)
    };
    let as_glb = |head: &HeadMesh| {
        let options =
            ExportOptions { world_from_mesh: head.world_from_scene, up, ..ExportOptions::default() };
        to_glb(&head.mesh, head.texture.as_ref(), head.shells.as_ref(), &options)
    };
    // as it is, with all that a GLB can say, unless it must be turned
    let is_glb = bytes.starts_with(b"glTF");
    let glb = if is_glb && up == Vec3::Y { bytes } else { as_glb(&open()?)? };
    if is_glb && up != Vec3::Y {
        let what =
            "turned by `--up`, it has lost its soft layers and what depends on the view, if there were any";
        warnings.borrow_mut().push(what.into());
    }
    let (glb, note) = small(&glb, path, open, as_glb)?;
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let html = viewer_html(&Viewer { name, note, front: [0.0, 0.0, 1.0], glb, cameras: Vec::new() }, &[])?;
    Ok((html, warnings.into_inner()))
}

/// A copy for a page, and how it differs. Of one that is too large, `head` gives the mesh and `as_glb` the file again.
fn small(
    glb: &[u8],
    path: &Path,
    head: impl FnOnce() -> Result<HeadMesh>,
    as_glb: impl Fn(&HeadMesh) -> Result<Vec<u8>>,
) -> Result<(Vec<u8>, String)> {
    let copy = compact_glb(glb, path)?;
    if copy.len() <= MOST_BYTES {
        return Ok((copy, String::new()));
    }
    let HeadMesh { mut mesh, texture, world_from_scene, .. } = head()?;
    if let Some(HeadTexture { atlas, color, .. }) = &texture {
        mesh.colors = vec![[0.5; 3]; mesh.positions.len()];
        for (triangle, corners) in mesh.triangles.iter().zip(&atlas.triangles) {
            for (&vertex, &uv) in triangle.iter().zip(corners) {
                mesh.colors[vertex as usize] = texel(color, atlas.uvs[uv as usize].to_array());
            }
        }
    }
    let mut mesh = weld(&mesh);
    let before = mesh.triangles.len();
    simplify(&mut mesh, None, &SimplifyConfig { triangles: FEWER, ..SimplifyConfig::default() }, &Quiet)?;
    let after = mesh.triangles.len();
    let head = HeadMesh { mesh, world_from_scene, texture: None, harmonics: None, shells: None };
    let copy = compact_glb(&as_glb(&head)?, path)?;
    if copy.len() > MOST_BYTES {
        let hint = "simplify it first, and make its texture smaller";
        return Err(Error::cannot(format!("`{}` is too large for a page", path.display()), hint));
    }
    Ok((copy, format!("A copy of {after} of the {before} triangles, with colors at its vertices.")))
}

/// The nearest texel, coded.
fn texel(photo: &Photo, [u, v]: [f32; 2]) -> [f32; 3] {
    let at = |t: f32, n: u32| ((t - t.floor()) * n as f32).min(n as f32 - 1.0) as usize;
    let i = at(v, photo.height) * photo.width as usize + at(u, photo.width);
    photo.rgb[i].map(|c| c as f32 / 255.0)
}
