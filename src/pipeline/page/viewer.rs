//! The 3D viewer of a page: a copy of the head that is small enough, and the cameras of the
//! photographs.

use super::views::rows_of_run;
use crate::config::{MeshFormat, Stage};
use crate::pipeline::frames::center;
use crate::pipeline::mesh::{head_mesh, read_finished, seen_note};
use crate::pipeline::mesh_files::Export;
use crate::pipeline::session::Session;
use crate::report::{ViewRow, Viewer, ViewerCamera, viewer_html};
use crate::run::{Record, read_record};
use glam::Vec3;
use std::path::Path;
use tiface_base::geom::Similarity;
use tiface_base::image::Photo;
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Quiet, Result};
use tiface_surface::bake::seen_shares;
use tiface_surface::files::{ExportOptions, HeadMesh, HeadTexture, OpenedMesh, open_mesh, to_glb, weld};
use tiface_surface::{SimplifyConfig, simplify};

/// Maximum size of a mesh inside a page, bytes: 100,000 triangles with a texture.
const MAX_GLB_BYTES: usize = 4_600_000;

/// Longest side of a base color in a page, and of a function of view-dependent color, which is
/// smooth.
const COLOR_PX: u32 = 2048;

const LOBE_PX: u32 = 512;

/// Mark of a GLB that this program wrote.
const GENERATOR: &[u8] = b"\"generator\":\"tiface ";

/// Number of triangles of a larger mesh's copy, which has colors at its vertices.
const REDUCED_TRIANGLES: usize = 100_000;

/// Returns the head of a run without cameras, and the transform from the dataset's world to its
/// coordinates; `None` before the stage `mesh`.
pub(super) fn viewer(session: &Session) -> Result<Option<(Viewer, Similarity)>> {
    match read_record(&session.run.path(Stage::Mesh)) {
        Ok(Some(record)) => shown(session, &record).map(Some),
        _ => Ok(None),
    }
}

/// Returns the head of a run whose mesh is done.
fn shown(session: &Session, mesh: &Record) -> Result<(Viewer, Similarity)> {
    mesh.require_products(&session.run.path(Stage::Mesh))?;
    let export = Export { jpeg: true, ..Export::new(&session.capture, session.config) };
    let head = head_mesh(session.run)?;
    let as_glb = |head: &HeadMesh| Ok(export.files(head, MeshFormat::Glb, "head")?.files.swap_remove(0).1);
    let file_from_world = export.frames(&head.mesh, &head.world_from_scene)?.file_from_world();
    let front = export.front(center(&head.mesh, &head.world_from_scene)).unwrap_or(Vec3::ZERO);
    let front = file_from_world.direction(front);
    let unseen = seen_note(seen_shares(&head.mesh)).map(|said| said + ".");
    let (glb, note) = small(head, &session.run.path("mesh/parts"), as_glb)?;
    let note = unseen.into_iter().chain((!note.is_empty()).then_some(note)).collect::<Vec<_>>().join(" ");
    let name = session.capture.name.clone();
    Ok((Viewer { name, note, front: front.to_array(), glb, ..Viewer::default() }, file_from_world))
}

/// Returns the cameras of these rows' photographs.
pub(super) fn cameras(
    session: &Session,
    rows: &[ViewRow],
    file_from_world: &Similarity,
) -> Vec<ViewerCamera> {
    let camera = |(i, row): (usize, &ViewRow)| {
        let view = session.capture.views.iter().find(|v| v.name == row.name)?;
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

/// Returns a page with a 3D viewer of a run's head, and its held-out photographs if they can be
/// opened.
///
/// # Errors
///
/// Fails if the run has no mesh yet, or if it is damaged, or being made again.
pub fn head_page(session: &Session) -> Result<String> {
    let (mut viewer, file_from_world) = read_finished(session.run.dir(), |record| shown(session, record))?;
    let most = super::MAX_BYTES.saturating_sub(viewer.glb.len().div_ceil(3) * 4);
    // without photographs the page still shows the head
    let (mut rows, _) = match session.inputs.missing_capture {
        None => rows_of_run(session, most)?,
        Some(_) => Default::default(),
    };
    rows.iter_mut().for_each(|row| row.pictures.clear());
    viewer.cameras = cameras(session, &rows, &file_from_world);
    viewer_html(&viewer, &rows)
}

/// Returns a page with a 3D viewer of a GLB, OBJ, PLY or STL file, and the features of it that
/// cannot be shown. `up` is its up direction.
///
/// # Errors
///
/// Fails if the file cannot be read, or uses features that a page cannot show.
pub fn viewer_of_file(path: &Path, up: Vec3) -> Result<(String, Vec<String>)> {
    let bytes = io::read_bytes(path, &Limits::default())?;
    let opened = open_mesh(path)?;
    let mut warnings = opened.warnings();
    let OpenedMesh { head, .. } = opened;
    let as_glb = |head: &HeadMesh| {
        let options = ExportOptions {
            world_from_mesh: head.world_from_scene,
            up,
            jpeg_quality: Some(92),
            ..ExportOptions::default()
        };
        to_glb(&head.mesh, head.texture.as_ref(), head.shells.as_ref(), &options)
    };
    // a file of ours is shown unchanged, with soft layers and what depends on the view
    let is_ours = bytes.starts_with(b"glTF") && bytes.windows(GENERATOR.len()).any(|w| w == GENERATOR);
    let (glb, note) = if is_ours && up == Vec3::Y && bytes.len() <= MAX_GLB_BYTES {
        (bytes, String::new())
    } else {
        if is_ours {
            let why = if up == Vec3::Y { "too large to be shown as it is" } else { "turned by `--up`" };
            warnings.push(format!(
                "{why}, it has lost its soft layers and what depends on the view, if there were any"
            ));
        }
        small(head, path, as_glb)?
    };
    let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let html = viewer_html(&Viewer { name, note, front: [0.0, 0.0, 1.0], glb, ..Viewer::default() }, &[])?;
    Ok((html, warnings))
}

/// Returns a head as a GLB for a page, and how it differs: with smaller pictures, then without soft
/// layers and what depends on the view, then with fewer triangles that are colored at their
/// vertices. `path` is for messages only.
fn small(
    mut head: HeadMesh,
    path: &Path,
    as_glb: impl Fn(&HeadMesh) -> Result<Vec<u8>>,
) -> Result<(Vec<u8>, String)> {
    head.texture = head.texture.map(|t| HeadTexture { normal: None, ..t }.reduced(COLOR_PX, LOBE_PX));
    let copy = as_glb(&head)?;
    if copy.len() <= MAX_GLB_BYTES {
        return Ok((copy, String::new()));
    }
    head.shells = None;
    head.texture.iter_mut().for_each(|texture| texture.lobes = None);
    let copy = as_glb(&head)?;
    if copy.len() <= MAX_GLB_BYTES {
        return Ok((copy, "A copy without soft layers and what depends on the view.".into()));
    }
    let HeadMesh { mut mesh, texture, world_from_scene, .. } = head;
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
    simplify(
        &mut mesh,
        None,
        &SimplifyConfig { triangles: REDUCED_TRIANGLES, ..SimplifyConfig::default() },
        &Quiet,
    )?;
    let after = mesh.triangles.len();
    let head = HeadMesh { mesh, world_from_scene, texture: None, harmonics: None, shells: None };
    let copy = as_glb(&head)?;
    if copy.len() > MAX_GLB_BYTES {
        let hint = "simplify it first, and make its texture smaller";
        return Err(Error::cannot(format!("`{}` is too large for a page", path.display()), hint));
    }
    Ok((copy, format!("A copy of {after} of the {before} triangles, with colors at its vertices.")))
}

/// Returns the nearest texel, coded.
fn texel(photo: &Photo, [u, v]: [f32; 2]) -> [f32; 3] {
    let at = |t: f32, n: u32| ((t - t.floor()) * n as f32).min(n as f32 - 1.0) as usize;
    let i = at(v, photo.height) * photo.width as usize + at(u, photo.width);
    photo.rgb[i].map(|c| c as f32 / 255.0)
}
