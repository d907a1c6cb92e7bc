//! A capture's folder: its entries, the paths that names in camera files refer to, and errors
//! shared by the camera formats. No file outside the capture is opened.

use super::frame::CameraFrame;
use super::near::names::{IMAGE_FOLDERS, READABLE_FORMATS, bare, fold, without_ending};
pub(super) use super::near::names::{PHOTOGRAPHS, has_ending, is_common_name};
use super::near::{Kind, Search};
use super::options::{CaptureOptions, Reading};
use super::table;
use glam::DMat3;
use roxmltree::{Document, ParsingOptions};
use std::collections::HashSet;
use std::fmt::Display;
use std::path::{Component, Path, PathBuf};
use tiface_base::io::{self, ReadError};
use tiface_base::{Error, Result};

/// Endings that may be missing from a photograph's name: of supported files, and of files that are
/// found only to be refused by name.
const ENDINGS: [&[&str]; 2] = [
    &["", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG"],
    &[".tif", ".tiff", ".webp", ".heic", ".TIF", ".TIFF"],
];

/// From OpenCV's camera axes to ours: right, down, forward to right, up, backward.
pub(super) const FLIP: DMat3 = DMat3::from_cols_array(&[1.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, -1.0]);

/// Returns a photograph's name below its folder; absolute names are returned unchanged.
pub(super) fn join(base: &str, name: &str) -> String {
    let is_absolute = name.starts_with(['/', '\\']) || name.as_bytes().get(1) == Some(&b':');
    if base.is_empty() || is_absolute { name.into() } else { format!("{base}/{name}") }
}

/// The folder of a capture that is being opened.
pub(super) struct CaptureFolder<'a> {
    /// The path as given.
    pub root: &'a Path,
    /// The path without links.
    real: PathBuf,
    pub options: &'a CaptureOptions,
    /// Finds what is missing under a near name.
    pub search: Search,
}

impl CaptureFolder<'_> {
    pub fn new<'a>(root: &'a Path, options: &'a CaptureOptions) -> Result<CaptureFolder<'a>> {
        Ok(CaptureFolder {
            root,
            real: io::real_path(root)?,
            options,
            search: Search::new(options.result_file),
        })
    }

    /// Returns how what the files leave open is read.
    pub fn reading(&self) -> Reading {
        self.options.reading.unwrap_or_default()
    }

    /// Returns a path relative to the capture, for messages.
    pub fn shown(&self, path: &Path) -> String {
        path.strip_prefix(self.root).unwrap_or(path).to_string_lossy().into_owned()
    }

    /// Returns the path below the capture that `name` refers to. `\` counts as a separator, since
    /// tools on Windows write it; an absolute name is accepted if it points into the capture.
    pub fn relative(&self, file: &str, name: &str) -> Result<PathBuf> {
        let outside = || outside(file, name);
        if name.is_empty() || name.contains('\0') {
            return Err(outside());
        }
        let text = name.replace('\\', "/");
        let mut path = Path::new(&text);
        if path.is_absolute() {
            path = path
                .strip_prefix(self.root)
                .or_else(|_| path.strip_prefix(&self.real))
                .map_err(|_| outside())?;
        } else if text.as_bytes().get(1) == Some(&b':') {
            return Err(outside()); // a Windows drive
        }
        let mut relative = PathBuf::new();
        for part in path.components() {
            match part {
                Component::Normal(p) => relative.push(p),
                Component::CurDir => {}
                Component::ParentDir if relative.pop() => {}
                _ => return Err(outside()),
            }
        }
        Ok(relative)
    }

    /// Returns the regular file at a relative path, if it exists. Links are followed: data sets are
    /// kept as links into a store, and the paths that [`CaptureFolder::relative`] returns cannot
    /// climb out of the capture.
    pub fn file(&self, relative: &Path) -> Option<PathBuf> {
        Some(self.root.join(relative)).filter(|path| io::is_file(path))
    }

    /// Returns the folder that photographs' names are relative to, if the format does not define
    /// it: the one that contains most of the first names.
    pub fn image_folder<'n>(&self, names: impl Iterator<Item = &'n str>) -> &'static str {
        let names: Vec<&str> = names.take(64).collect();
        let is_in = |base: &str, name: &str| {
            self.exact_photo("", &join(base, name)).is_ok_and(|(_, photo)| photo.is_some())
        };
        let bases = IMAGE_FOLDERS.into_iter().chain([""]);
        let counted = bases.map(|base| (base, names.iter().filter(|name| is_in(base, name)).count()));
        counted.fold(("images", 0), |best, next| if next.1 > best.1 { next } else { best }).0
    }

    /// Returns the mask of a photograph: by COLMAP's own convention (`masks/NAME.jpg.png`), or by
    /// its name without ending.
    pub fn mask_of(&self, file: &str, name: &str) -> Result<Option<PathBuf>> {
        let stem =
            if has_ending(name, &PHOTOGRAPHS) { Path::new(name).with_extension("") } else { name.into() };
        for name in [format!("masks/{name}.png"), format!("masks/{}.png", stem.to_string_lossy())] {
            // a photograph of another computer's name may be found where its mask is not
            let Ok(relative) = self.relative(file, &name) else { continue };
            if let Some(path) = self.file(&relative) {
                return Ok(Some(path));
            }
        }
        Ok(None)
    }

    /// Returns the photograph that `name` refers to, with its path below the capture: that of
    /// [`CaptureFolder::exact_photo`], else the only one near the name, which
    /// [`missing::confirm_near`](super::missing::confirm_near) has yet to confirm.
    pub fn photo(&self, file: &str, name: &str) -> Result<(PathBuf, Option<PathBuf>)> {
        let exact = self.exact_photo(file, name);
        if matches!(exact, Ok((_, Some(_)))) {
            return exact;
        }
        match self.near(Kind::Photograph, name) {
            Some((relative, path)) => Ok((relative, Some(path))),
            None => exact,
        }
    }

    /// Returns the mask that `name` refers to, if it exists: the exact name, else the only mask
    /// near it.
    pub fn mask(&self, file: &str, name: &str) -> Result<Option<PathBuf>> {
        let exact = self.relative(file, name).map(|relative| self.file(&relative));
        match exact {
            Ok(Some(_)) => exact,
            missing => match self.near(Kind::Mask, name) {
                Some((_, path)) => Ok(Some(path)),
                None => missing,
            },
        }
    }

    /// Returns the only file near a name: its path below the capture, and its path.
    fn near(&self, kind: Kind, name: &str) -> Option<(PathBuf, PathBuf)> {
        let found = self.search.nearest(self.root, kind, name, self.options.downscale)?;
        let path = self.file(Path::new(&found))?;
        Some((found.into(), path))
    }

    /// Returns the pictures in the first of these folders that exists, in name order, as paths
    /// below the capture; `None` without such a folder. Where none exists, the only folder counts
    /// that is called like one of them in other letters or has a usual name of `others`.
    pub fn pictures(&self, names: &[&str], others: &[&str]) -> Result<Option<Vec<String>>> {
        let listed = |name: &str| -> Result<Option<Vec<String>>> {
            let files = photographs(&self.root.join(name))?;
            Ok(Some(files.into_iter().map(|file| format!("{name}/{file}")).collect()))
        };
        if let Some(name) = names.iter().find(|name| io::is_folder(&self.root.join(name))) {
            return listed(name);
        }
        let folders = FolderEntries::list(self.root).folders;
        let among = |names: &[&str]| -> Vec<&String> {
            let is_there = |name: &&String| names.contains(&fold(name).as_str());
            let has_photographs =
                |name: &&String| photographs(&self.root.join(name)).is_ok_and(|p| !p.is_empty());
            folders.iter().filter(is_there).filter(has_photographs).collect()
        };
        let near = Some(among(names)).filter(|near| !near.is_empty()).unwrap_or_else(|| among(others));
        let [name] = near[..] else { return Ok(None) };
        self.search.note(format!("`{name}/` is read, as there is no `{}/`", names[0]));
        listed(name)
    }

    /// Returns the photograph that `name` refers to, with its path below the capture: the exact
    /// name, else with a usual ending, else in the folder of pictures already reduced by
    /// `options.downscale` (`images_4/`, `images_4x/`).
    pub fn exact_photo(&self, file: &str, name: &str) -> Result<(PathBuf, Option<PathBuf>)> {
        let downscale = self.options.downscale;
        let wanted = self.relative(file, name)?;
        let mut candidates = vec![wanted.clone()];
        let mut parts = wanted.components();
        if let Some(first) = parts.next().map(|c| c.as_os_str().to_string_lossy())
            && downscale > 1
            && !parts.as_path().as_os_str().is_empty()
        {
            let reduced = [format!("{first}_{downscale}"), format!("{first}_{downscale}x")];
            candidates.extend(reduced.map(|folder| Path::new(&folder).join(parts.as_path())));
        }
        let all = ENDINGS.iter().flat_map(|endings| candidates.iter().map(move |c| (c, endings)));
        for (candidate, ending) in all.flat_map(|(c, endings)| endings.iter().map(move |e| (c, e))) {
            let mut with = candidate.clone().into_os_string();
            with.push(ending);
            if let Some(path) = self.file(Path::new(&with)) {
                return Ok((with.into(), Some(path)));
            }
        }
        Ok((wanted, None))
    }
}

/// Returns the common folder of all photographs, and each one's path below it without ending,
/// separated by `/`.
pub(super) fn view_names(frames: &[CameraFrame]) -> (PathBuf, Vec<String>) {
    let mut folder: Option<PathBuf> = None;
    for frame in frames {
        let parent = frame.relative.parent().unwrap_or(Path::new(""));
        folder = Some(match folder {
            None => parent.into(),
            Some(f) => {
                f.components().zip(parent.components()).take_while(|(a, b)| a == b).map(|(a, _)| a).collect()
            }
        });
    }
    let folder = folder.unwrap_or_default();
    let names = frames
        .iter()
        .map(|frame| {
            let below = frame.relative.strip_prefix(&folder).unwrap_or(&frame.relative).with_extension("");
            let parts: Vec<_> = below.components().map(|c| c.as_os_str().to_string_lossy()).collect();
            parts.join("/")
        })
        .collect();
    (folder, names)
}

/// The entries of a folder.
pub(super) struct FolderEntries {
    pub root: PathBuf,
    pub files: Vec<String>,
    pub folders: Vec<String>,
}

impl FolderEntries {
    /// Lists a folder. Names that are not UTF-8, and folders that cannot be listed, are ignored.
    pub fn list(root: &Path) -> FolderEntries {
        let name = |p: &PathBuf| Some(p.file_name()?.to_str()?.to_owned());
        let folders = io::list_folders(root).unwrap_or_default();
        FolderEntries {
            root: root.into(),
            files: io::list_files(root).unwrap_or_default(),
            folders: folders.iter().filter_map(name).collect(),
        }
    }

    /// Returns the first of these files or folders that exists; names may contain `/`.
    pub fn any<'a>(&self, names: &[&'a str]) -> Option<&'a str> {
        names.iter().copied().find(|n| io::exists(&self.root.join(n)))
    }

    /// Returns the first file with one of these endings.
    pub fn ending(&self, endings: &[&str]) -> Option<&String> {
        self.files.iter().find(|f| has_ending(f, endings))
    }

    /// Returns the first file with this ending whose beginning contains `words`.
    pub fn holding(&self, ending: &str, words: &str) -> Option<&String> {
        self.beginning(ending, |text| text.contains(words))
    }

    /// Returns the first file with this ending whose beginning is as asked for.
    pub fn beginning(&self, ending: &str, is_wanted: impl Fn(&str) -> bool) -> Option<&String> {
        let is_it = |name: &&String| {
            let bytes = io::read_beginning(&self.root.join(name), 1 << 16).unwrap_or_default();
            is_wanted(&table::decoded(&bytes))
        };
        self.files.iter().filter(|f| has_ending(f, &[ending])).take(16).find(is_it)
    }

    pub fn at(&self, name: &str) -> String {
        self.root.join(name).display().to_string()
    }

    /// Returns the folder that probably contains the photographs.
    pub fn photographs(&self) -> Option<PathBuf> {
        let folders = IMAGE_FOLDERS.into_iter().filter(|n| self.any(&[n]).is_some());
        let folders = folders.map(|n| self.root.join(n));
        [self.root.clone()]
            .into_iter()
            .chain(folders)
            .find(|f| FolderEntries::list(f).ending(&PHOTOGRAPHS).is_some())
    }
}

/// Returns the photographs in a folder, in name order, without masks beside them; if none is
/// supported, those of other formats, to be refused by name.
pub(super) fn photographs(folder: &Path) -> Result<Vec<String>, ReadError> {
    let mut files = io::list_files(folder)?;
    let can_be_read = files.iter().any(|f| has_ending(f, &PHOTOGRAPHS[..READABLE_FORMATS]));
    let endings = if can_be_read { &PHOTOGRAPHS[..READABLE_FORMATS] } else { &PHOTOGRAPHS };
    files.retain(|f| has_ending(f, endings));
    // `000_mask.png` beside `000.jpg` is no photograph
    let stems: Vec<String> = files.iter().map(|file| fold(without_ending(file).0)).collect();
    let known: HashSet<&str> = stems.iter().map(String::as_str).collect();
    let is_mask = |stem: &String| matches!(bare(stem), (photo, true) if known.contains(photo));
    let mut are_masks = stems.iter().map(is_mask);
    files.retain(|_| !are_masks.next().unwrap_or_default());
    Ok(files)
}

/// Returns the pictures in a folder that no view can be named after: hidden files, and names with
/// the separator of Windows. What macOS keeps beside files on foreign disks (`._NAME`) is none.
pub(super) fn unnameable(folder: &Path) -> Result<Vec<String>, ReadError> {
    let mut names = io::list_hidden(folder)?;
    names.retain(|name| !name.starts_with("._"));
    names.extend(io::list_files(folder)?.into_iter().filter(|name| !is_nameable(name)));
    names.retain(|name| has_ending(name, &PHOTOGRAPHS));
    Ok(names)
}

/// Returns whether a file or folder is hidden by its name.
pub(super) fn is_hidden(path: &Path) -> bool {
    path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."))
}

/// Returns whether a file's name is read as one name, not as folders in the manner of Windows.
pub(super) fn is_nameable(name: &str) -> bool {
    !name.contains('\\')
}

/// Parses an XML file with at most `nodes` nodes. A DTD is refused, because its entities could grow
/// without bound.
pub(super) fn parse_xml<'t>(
    path: &Path,
    format: &'static str,
    text: &'t str,
    nodes: u32,
) -> Result<Document<'t>, ReadError> {
    let options = ParsingOptions { allow_dtd: false, nodes_limit: nodes, ..ParsingOptions::default() };
    let problem = |e: roxmltree::Error| e.to_string().chars().take(200).collect::<String>();
    Document::parse_with_options(text, options)
        .map_err(|e| ReadError::damaged(path, format, None, problem(e)))
}

/// Returns the beginning of a text from a file, for a message.
pub(super) fn shortened(text: &str) -> String {
    text.chars().take(40).collect()
}

/// Returns the error for a camera file that is incomplete.
pub(super) fn in_file(file: &str, problem: impl Display, hint: impl Into<String>) -> Error {
    Error::cannot(problem, hint).within(format_args!("`{file}`"))
}

/// Returns the error for one frame of a camera file, named by its photograph or its number.
pub(super) fn in_frame(file: &str, frame: &str, problem: impl Display) -> Error {
    let place = format_args!("`{file}`, frame `{frame}`");
    Error::cannot(problem, "correct that frame, or remove it").within(place)
}

/// Returns the error for a name that points outside the capture.
fn outside(file: &str, name: &str) -> Error {
    Error::cannot(
        format_args!("`{file}` names `{name}`, which is outside the capture"),
        "copy the file into the capture, or give the folder that holds both",
    )
}

/// Returns the error for a capture without usable views.
pub(super) fn no_views(root: &Path, found: &str) -> Error {
    Error::cannot(
        format_args!("`{}` has no usable view: {found}", root.display()),
        "put the photographs where the camera file says they are, relative to the capture",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside_the_capture_however_they_are_written() {
        let dir = tempfile::tempdir().unwrap();
        let options = CaptureOptions::default();
        let folder = CaptureFolder::new(dir.path(), &options).unwrap();
        let good = [
            ("./images/a.png", "images/a.png"),
            ("images/../b/./c", "b/c"),
            ("images\\a.png", "images/a.png"),
            ("a b/ü.png", "a b/ü.png"),
        ];
        for (name, path) in good {
            assert_eq!(folder.relative("t.json", name).unwrap(), Path::new(path));
        }
        let inside = dir.path().join("x/y.png");
        assert_eq!(folder.relative("t.json", inside.to_str().unwrap()).unwrap(), Path::new("x/y.png"));
        for name in ["../a.png", "a/../../b", "/etc/passwd", "", "C:\\a.png", "a\0b", "..\\a"] {
            let error = folder.relative("t.json", name).unwrap_err().to_string();
            assert!(error.contains("outside the capture"), "{name:?}: {error}");
        }
    }

    #[test]
    #[cfg(unix)]
    fn a_link_is_followed_and_a_name_that_climbs_out_beside_it_is_not() {
        let (dir, other) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        std::fs::create_dir(other.path().join("store")).unwrap();
        for name in ["store/a.png", "b.png"] {
            std::fs::write(other.path().join(name), b"x").unwrap();
        }
        std::os::unix::fs::symlink(other.path().join("store"), dir.path().join("images")).unwrap();
        let options = CaptureOptions::default();
        let folder = CaptureFolder::new(dir.path(), &options).unwrap();
        let (relative, photo) = folder.photo("t.json", "images/a.png").unwrap();
        assert_eq!(
            (relative.as_path(), photo),
            (Path::new("images/a.png"), Some(dir.path().join("images/a.png")))
        );
        // `images/..` is the capture, wherever the link leads
        assert_eq!(folder.photo("t.json", "images/../b.png").unwrap().1, None);
    }
}
