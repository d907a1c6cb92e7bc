//! Opening of mesh files with the materials and pictures beside them: the one reader of `check`,
//! `preview` and `metrics`.
//!
//! A texture that cannot be shown never stops a mesh from being opened: why it is not shown, and
//! what was read otherwise than it is written, is returned with the mesh.

use super::beside::{self, Beside, unquoted};
use super::color_range::{at_vertices, bring_into_range};
use super::gltf_text::as_glb;
use super::head_texture::{HeadTexture, Lobes};
use super::mtl::{Material, materials_of_mtl};
use super::obj_read::MAX_LIBRARIES;
use super::read::read_with;
use super::source::{LobeSource, PictureSource, ReadMesh, ReadOptions, Source};
use super::stored::HeadMesh;
use glam::Mat3;
use std::collections::{BTreeMap, BTreeSet, HashMap};
use std::path::{Path, PathBuf};
use tiface_base::geom::{Atlas, Similarity};
use tiface_base::image::{Photo, linear_from_srgb, quantize, srgb_from_linear};
use tiface_base::io::{self, Limits};
use tiface_base::{Error, Result};

/// The content of a mesh file.
#[derive(Debug)]
pub struct OpenedMesh {
    /// The mesh with its texture; the file's coordinates are taken for the world.
    pub head: HeadMesh,
    /// The texture coordinates of a missing texture.
    pub bare_atlas: Option<Atlas>,
    /// Why the texture that the file names is not shown.
    pub texture_problem: Option<String>,
    /// Number of soft layers around the surface, which are not read.
    pub soft_layers: usize,
    /// Files beside it that were read: libraries of materials, and pictures.
    pub beside: Vec<PathBuf>,
    /// Values that were read otherwise than they are written, or left out.
    pub notes: Vec<String>,
}

impl OpenedMesh {
    /// Returns all that a user should know of what is shown.
    pub fn warnings(&self) -> Vec<String> {
        let problem = self.texture_problem.iter().map(|what| format!("{what}; shown without its texture"));
        problem.chain(self.notes.iter().cloned()).collect()
    }
}

/// Returns the surface in a mesh file, without its texture.
///
/// # Errors
///
/// Fails if the surface cannot be read.
pub fn open_surface(path: &Path) -> Result<ReadMesh> {
    read_with(&bytes_of(path)?, path, &ReadOptions::SURFACE)
}

/// Opens a `.glb`, `.gltf`, `.obj`, `.ply` or `.stl` file with its texture, and says what cannot be
/// shown.
///
/// # Errors
///
/// Fails if the surface itself cannot be read.
pub fn open_mesh(path: &Path) -> Result<OpenedMesh> {
    let bytes = bytes_of(path)?;
    let (mut found, mut texture_problem) = match read_with(&bytes, path, &ReadOptions::DEFAULT) {
        Ok(found) => (found, None),
        Err(e) => (read_with(&bytes, path, &ReadOptions::SURFACE)?, Some(with_way(&e))),
    };
    drop(bytes);
    let mut photo = open_picture(&mut found, path).unwrap_or_else(|e| {
        texture_problem = Some(with_way(&e));
        None
    });
    let ReadMesh { mesh, origin, atlas, lobes, tint, soft_layers, beside, mut notes, .. } = found;
    if let (Some(photo), Some(tint)) = (&mut photo, tint) {
        multiply(photo, tint);
    }
    let (texture, bare_atlas) = match (atlas, photo) {
        (Some(atlas), Some(color)) => {
            let (width, height) = (color.width, color.height);
            let mut texture = HeadTexture::new(Atlas { width, height, ..atlas }, color);
            if let Some(Err(e)) = lobes.map(|lobes| open_lobes(&mut texture, lobes, path)) {
                notes.push(format!("colors that change with the view are not shown: {}", with_way(&e)));
            }
            (Some(texture), None)
        }
        (None, Some(_)) => {
            let what = "has a texture, but does not say where in it all of its triangles lie";
            texture_problem = Some(format!("`{}` {what}", path.display()));
            (None, None)
        }
        (atlas, None) => (None, atlas),
    };
    if bare_atlas.is_some() && texture_problem.is_none() && mesh.colors.is_empty() {
        notes.push(format!("`{}` has texture coordinates, but names no picture", path.display()));
    }
    let world_from_scene = Similarity { translation: origin, ..Similarity::IDENTITY };
    let head = HeadMesh { mesh, world_from_scene, texture, harmonics: None, shells: None };
    Ok(OpenedMesh { head, bare_atlas, texture_problem, soft_layers, beside, notes })
}

/// Opens the lobes of a texture, whose directions are those of the file's axes.
fn open_lobes(texture: &mut HeadTexture, lobes: LobeSource, path: &Path) -> Result<()> {
    let open = |bytes: &Vec<u8>| io::parse_photo(bytes, path, &Limits::default());
    let pictures = lobes.pictures.iter().map(open).collect::<Result<Vec<Photo>, _>>()?;
    texture.lobes = Some(Lobes { pictures, scale: lobes.scale, turned: Mat3::IDENTITY });
    texture.check_pictures().inspect_err(|_| texture.lobes = None)
}

/// Returns the bytes of a mesh file; those of a `.gltf` as the GLB that it would be.
fn bytes_of(path: &Path) -> Result<Vec<u8>> {
    let bytes = io::read_bytes(path, &Limits::default())?;
    Ok(as_glb(&bytes, path)?.unwrap_or(bytes))
}

/// Returns an error with its suggested fix in one sentence.
fn with_way(e: &Error) -> String {
    if e.hint().is_empty() { e.to_string() } else { format!("{e} ({})", e.hint()) }
}

/// Multiplies the linear light of a picture.
fn multiply(photo: &mut Photo, tint: [f32; 3]) {
    let coded = |byte: u8, factor: f32| {
        quantize(srgb_from_linear(linear_from_srgb(f32::from(byte) / 255.0) * factor))
    };
    for (channel, factor) in tint.into_iter().enumerate() {
        let table: [u8; 256] = std::array::from_fn(|byte| coded(byte as u8, factor));
        photo.rgb.iter_mut().for_each(|c| c[channel] = table[usize::from(c[channel])]);
    }
}

/// Opens the picture that a mesh names, if it names one. Materials of one color become colors of
/// vertices.
fn open_picture(found: &mut ReadMesh, path: &Path) -> Result<Option<Photo>> {
    let limits = Limits::default();
    let folder = path.parent().unwrap_or(Path::new(""));
    match found.picture.take() {
        None => Ok(None),
        Some(PictureSource::Inside(bytes)) => Ok(Some(io::parse_photo(&bytes, path, &limits)?)),
        Some(PictureSource::Beside(name)) => open_beside(found, &[folder], path, &name),
        Some(PictureSource::Materials(lines)) => {
            let libraries = libraries(found, folder, path, &lines)?;
            let all = materials_in(&libraries);
            let used = used_materials(found, &all, &libraries);
            let Some((name, mtl)) = picture_of(found, &used)? else {
                color_by_materials(found, &all, &used);
                return Ok(None);
            };
            open_beside(found, &[mtl.parent().unwrap_or(folder), folder], mtl, &name)
        }
    }
}

/// A `.mtl` file and its materials.
struct Library {
    file: PathBuf,
    materials: Vec<Material>,
}

/// A material and the file that it stands in.
type Placed<'m> = (&'m Material, &'m Path);

/// Opens the files behind each `mtllib`: of one name, which may have blanks, or else of several
/// between blanks. Files that are not there are noted if others are.
fn libraries(found: &mut ReadMesh, folder: &Path, path: &Path, lines: &[String]) -> Result<Vec<Library>> {
    let limits = Limits::default();
    let mut files = Vec::new();
    for line in lines {
        let mut names = beside::names_between_blanks(line);
        let comment = names.iter().position(|name| name.starts_with('#'));
        names.truncate(comment.unwrap_or(names.len()));
        let whole = beside::find(&[folder], path, unquoted(line));
        let is_list = names.len() > 1 && names.iter().all(|name| name.to_lowercase().ends_with(".mtl"));
        let is_as_written = whole.as_ref().is_ok_and(|file| file.note.is_none());
        if is_list && !is_as_written {
            let first = names.iter().take(MAX_LIBRARIES);
            files.extend(first.map(|name| beside::find(&[folder], path, name)));
        } else {
            files.push(whole);
        }
    }
    let (there, missing): (Vec<_>, Vec<_>) = files.into_iter().partition(|file| file.is_ok());
    let mut missing = missing.into_iter().filter_map(|file| file.err());
    if there.is_empty() {
        return missing.next().map_or(Ok(Vec::new()), Err);
    }
    missing.for_each(|e| found.note(with_way(&e)));
    let mut libraries: Vec<Library> = Vec::new();
    for Beside { file, note } in there.into_iter().flatten() {
        note.into_iter().for_each(|note| found.note(note));
        if libraries.iter().all(|known| known.file != file) {
            let materials = materials_of_mtl(&io::read_maybe_empty(&file, &limits)?, &file)?;
            found.beside.push(file.clone());
            libraries.push(Library { file, materials });
        }
    }
    Ok(libraries)
}

/// Returns the materials of all files; of a name that several files have, those of the first.
fn materials_in(libraries: &[Library]) -> Vec<Placed<'_>> {
    let mut first: HashMap<&str, usize> = HashMap::new();
    let mut all = Vec::new();
    for (k, Library { file, materials }) in libraries.iter().enumerate() {
        let own = materials.iter().filter(|m| *first.entry(m.name.as_str()).or_insert(k) == k);
        all.extend(own.map(|m| (m, file.as_path())));
    }
    all
}

/// Opens a picture in one of these folders, by the name that the file `by` writes.
fn open_beside(found: &mut ReadMesh, folders: &[&Path], by: &Path, name: &str) -> Result<Option<Photo>> {
    let beside = beside::find(folders, by, name)?;
    beside.note.into_iter().for_each(|note| found.note(note));
    let error = match io::read_photo(&beside.file, None, &Limits::default()) {
        Ok(photo) => {
            found.beside.push(beside.file);
            return Ok(Some(photo));
        }
        Err(e) => Error::from(e),
    };
    // a picture of a format that is not read, perhaps with what it was converted to
    match beside::converted(&beside.file) {
        None => Err(error),
        Some(None) => {
            let way = "convert it to PNG, with the same name but for the ending, in the same folder";
            Err(error.with_hint(way))
        }
        Some(Some(other)) => {
            let name = |file: &Path| file.file_name().unwrap_or_default().display().to_string();
            let (written, taken) = (name(&beside.file), name(&other));
            found.note(format!("`{written}` is not read; `{taken}` beside it is taken"));
            Ok(Some(io::read_photo(&other, None, &Limits::default())?))
        }
    }
}

/// Returns the materials of the faces; all of the files if the mesh names none of them.
fn used_materials<'m>(found: &mut ReadMesh, all: &[Placed<'m>], libraries: &[Library]) -> Vec<Placed<'m>> {
    let names: BTreeSet<&str> = found.materials.iter().map(|(_, name)| name.as_str()).collect();
    let used: Vec<Placed> = all.iter().copied().filter(|(m, _)| names.contains(m.name.as_str())).collect();
    let known: BTreeSet<&str> = all.iter().map(|(m, _)| m.name.as_str()).collect();
    let unknown = names.difference(&known).next().map(|name| name.to_string());
    if let Some(name) = unknown.filter(|_| !all.is_empty()) {
        let files: Vec<String> = libraries.iter().map(|l| format!("`{}`", l.file.display())).collect();
        let verb = if files.len() == 1 { "has" } else { "have" };
        found.note(format!("{} {verb} no material `{name}`, which the mesh uses", files.join(", ")));
    }
    if used.is_empty() { all.to_vec() } else { used }
}

/// Returns the name of the picture of these materials, if they have one, and the file that names
/// it.
fn picture_of<'m>(found: &mut ReadMesh, used: &[Placed<'m>]) -> Result<Option<(String, &'m Path)>> {
    if let Some((material, _)) = used.iter().find(|(m, _)| m.transparent.is_some()) {
        let (key, name) = (material.transparent.unwrap_or_default(), &material.name);
        found.note(format!("`{key}` makes the material `{name}` transparent; it is shown opaque"));
    }
    let own = used.iter().filter_map(|(m, file)| Some((m.picture.as_deref()?, (*file, None))));
    let mut pictures: BTreeMap<&str, (&Path, Option<&str>)> = own.collect();
    let has_own = !pictures.is_empty();
    if !has_own {
        pictures.extend(used.iter().filter_map(|(m, file)| {
            let (key, name) = m.stand_in.as_ref()?;
            Some((name.as_str(), (*file, Some(*key))))
        }));
    }
    let mut pictures = pictures.into_iter();
    let Some((name, (file, key))) = pictures.next() else { return Ok(None) };
    if let Some((second, _)) = pictures.next() {
        let source = Source { path: file, format: "MTL", options: &ReadOptions::DEFAULT };
        let feature = format!("a mesh with several base colors, `{name}` and `{second}`,");
        return Err(source.unsupported("its materials", feature));
    }
    if let Some(key) = key {
        found.note(format!("there is no `map_Kd`; the picture of `{key}` is shown"));
    } else if let Some((bare, _)) = used.iter().find(|(m, _)| m.picture.is_none()) {
        let without = &bare.name;
        found.note(format!("the material `{without}` has no picture; its faces show that of the others"));
    }
    Ok(Some((name.to_owned(), file)))
}

/// Colors the vertices by the `Kd` of their faces' materials, unless they have colors, or no
/// material is colored: gray is what programs write for a mesh without color.
fn color_by_materials(found: &mut ReadMesh, all: &[Placed], used: &[Placed]) {
    let is_colored = |m: &Material| m.color.is_some_and(|[r, g, b]| r != g || g != b);
    if !found.mesh.colors.is_empty() || !used.iter().any(|(m, _)| is_colored(m)) {
        return;
    }
    let color = |m: &Material| m.color.unwrap_or([1.0; 3]);
    let named: HashMap<&str, [f32; 3]> = all.iter().map(|(m, _)| (m.name.as_str(), color(m))).collect();
    // of a mesh without `usemtl` the first
    let first = color(used[0].0);
    // of none of the names that the mesh uses a color is known
    if !found.materials.is_empty()
        && !found.materials.iter().any(|(_, name)| named.contains_key(name.as_str()))
    {
        return;
    }
    let color_of = |name: &String| named.get(name.as_str()).copied().unwrap_or([1.0; 3]);
    let runs: Vec<(u32, [f32; 3])> =
        found.materials.iter().map(|(from, name)| (*from, color_of(name))).collect();
    let (vertices, triangles) = (found.mesh.positions.len(), &found.mesh.triangles);
    let of_face = |t: usize| match runs.partition_point(|(from, _)| *from as usize <= t) {
        0 => first,
        n => runs[n - 1].1,
    };
    found.mesh.colors = at_vertices(vertices, triangles, of_face);
    found.note("the mesh has no picture; the colors `Kd` of its materials are shown, taken as sRGB");
    let range = bring_into_range(&mut found.mesh.colors, "`Kd` of its materials");
    range.into_iter().for_each(|note| found.note(note));
}

#[cfg(test)]
mod tests {
    use super::super::testing::tetrahedron;
    use super::super::{ExportOptions, to_glb};
    use super::*;

    #[test]
    fn a_file_of_ours_is_opened_with_its_lobes_and_without_damaged_ones() {
        let head = tetrahedron();
        let texture = head.texture.as_ref().unwrap();
        let glb = to_glb(&head.mesh, Some(texture), None, &ExportOptions::default()).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("a.glb");
        let open = |bytes: &[u8]| {
            std::fs::write(&path, bytes).unwrap();
            let opened = open_mesh(&path).unwrap();
            (opened.head.texture.unwrap(), opened.notes)
        };
        let (found, notes) = open(&glb);
        assert_eq!(found.lobes, texture.lobes.as_ref().unwrap().in_coordinates(Mat3::IDENTITY));
        assert!(found.lobes.is_some() && notes.is_empty(), "{notes:?}");
        // color, normals and four lobes are textures 0 to 5
        let (named, missing) = (br#""lobe 3","texture":5"#, br#""lobe 3","texture":9"#);
        let at = glb.windows(named.len()).position(|bytes| bytes == named).unwrap();
        let damaged = [&glb[..at], &missing[..], &glb[at + named.len()..]].concat();
        let (found, notes) = open(&damaged);
        assert!(found.lobes.is_none() && found.color == texture.color);
        assert!(notes.len() == 1 && notes[0].contains("texture 9"), "{notes:?}");
    }

    #[test]
    fn a_tint_multiplies_light() {
        let mut photo = Photo { width: 2, height: 1, rgb: vec![[255; 3], [188, 9, 0]], alpha: None };
        multiply(&mut photo, [0.5, 1.0, 0.0]);
        // linear 0.5 is 188, linear 0.25 is 137
        assert_eq!(photo.rgb, [[188, 255, 0], [137, 9, 0]]);
    }
}
