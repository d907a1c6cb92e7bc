//! Files that a mesh names: materials and pictures.
//!
//! Programs write them as they saw them: in quotes, with folders, with the drive of another
//! machine. They are looked for in the mesh's own folder and the folders in it, and nowhere else:
//! of `C:\scans\textures\head.png` first `textures/head.png`, then `head.png`. A file that is not
//! found as it was written is told with the result.

use std::path::{Path, PathBuf};
use tiface_base::io;
use tiface_base::{Error, Result};

/// A file that was found, and a sentence if it is not where its name said.
pub(super) struct Beside {
    pub file: PathBuf,
    pub note: Option<String>,
}

/// Folders of a name that are looked for, from its end.
const MAX_PARTS: usize = 8;

/// Returns a name without the quotes around it, and without blanks at its ends.
pub(super) fn unquoted(name: &str) -> &str {
    let name = name.trim();
    let inner = ['"', '\''].into_iter().find_map(|q| name.strip_prefix(q)?.strip_suffix(q));
    inner.unwrap_or(name).trim()
}

/// Returns the names between blanks, each without the quotes around it.
pub(super) fn names_between_blanks(text: &str) -> Vec<&str> {
    let (mut rest, mut names) = (text.trim(), Vec::new());
    while let Some(first) = rest.chars().next() {
        let quoted = rest[first.len_utf8()..].find(first).filter(|_| ['"', '\''].contains(&first));
        let end = match quoted {
            Some(length) => length + 2,
            None => rest.find(char::is_whitespace).unwrap_or(rest.len()),
        };
        let (name, behind) = rest.split_at(end);
        names.push(unquoted(name));
        rest = behind.trim_start();
    }
    names
}

/// Finds a file in one of `folders` by the name that the file `by` writes, perhaps with a comment
/// behind it.
///
/// # Errors
///
/// Fails if no such file is there, or if the name is none.
pub(super) fn find(folders: &[&Path], by: &Path, written: &str) -> Result<Beside> {
    let found = find_whole(folders, by, written);
    match written.split_once(" #") {
        Some((name, _)) if found.is_err() => find_whole(folders, by, unquoted(name)),
        _ => found,
    }
}

fn find_whole(folders: &[&Path], by: &Path, written: &str) -> Result<Beside> {
    let parts = inner_parts(written);
    let shown = by.display();
    let Some(name) = parts.last().filter(|_| !written.contains(char::is_control)) else {
        let hint = "give it the name of a file in the folder of the mesh";
        return Err(Error::cannot(format!("`{shown}` names no file: `{}`", written.escape_debug()), hint));
    };
    let mut seen: Vec<&Path> = folders.to_vec();
    seen.dedup();
    for folder in &seen {
        for first in 0..parts.len() {
            let inner: PathBuf = parts[first..].iter().collect();
            let file = folder.join(&inner);
            if io::is_file(&file) {
                let is_as_written =
                    written == inner.to_string_lossy() || written.strip_prefix("./") == inner.to_str();
                let note =
                    || format!("`{shown}` names `{written}`; `{}` in its folder is taken", inner.display());
                return Ok(Beside { note: (!is_as_written).then(note), file });
            }
        }
    }
    if let Some((folder, other)) =
        seen.iter().find_map(|folder| Some((folder, nearly_the_same(folder, name)?)))
    {
        let note = format!("`{shown}` names `{written}`; `{other}` in its folder is taken");
        return Ok(Beside { file: folder.join(other), note: Some(note) });
    }
    let near = seen.iter().find_map(|folder| io::similar(&folder.join(name)));
    let near = near.and_then(|path| Some(path.file_name()?.to_string_lossy().into_owned()));
    let hint = match near {
        Some(near) => format!("put it into the folder of the mesh, or rename `{near}`, which is there"),
        None => "put it into the folder of the mesh".into(),
    };
    Err(Error::cannot(format!("`{shown}` names `{written}`, which is not there"), hint))
}

/// Returns the end of a path that leads into the folder: what follows the last `..`, without drive
/// and root.
fn inner_parts(written: &str) -> Vec<&str> {
    let mut parts = Vec::new();
    for part in written.split(['/', '\\', ':']).map(str::trim) {
        match part {
            "" | "." => {}
            ".." => parts.clear(),
            part => parts.push(part),
        }
    }
    // `a/..` names a folder
    let ends_above = written.trim_end_matches(['/', '\\']).ends_with("..") && parts.is_empty();
    if ends_above { Vec::new() } else { parts.split_off(parts.len().saturating_sub(MAX_PARTS)) }
}

/// Endings of pictures that are read, and of those that programs convert to them.
const READ: [&str; 3] = ["png", "jpg", "jpeg"];
const CONVERTED: [&str; 6] = ["tif", "tiff", "tga", "bmp", "webp", "exr"];

/// Returns the picture that a file of a format that is not read was converted to, if it lies beside
/// it: `Some(None)` if there is none, or more than one, `None` if the ending of the file is that of
/// no such format.
pub(super) fn converted(file: &Path) -> Option<Option<PathBuf>> {
    let ending = file.extension()?.to_str()?.to_lowercase();
    let (folder, stem) = (file.parent()?, file.file_stem()?.to_str()?);
    let other = || nearly_the_same(folder, &format!("{stem}.{}", READ[0]));
    CONVERTED.contains(&ending.as_str()).then(|| Some(folder.join(other()?)))
}

/// Returns the only file in a folder whose name differs from this one by capital letters alone, or
/// else, of a picture, by its ending.
fn nearly_the_same(folder: &Path, name: &str) -> Option<String> {
    // the folder of a bare file name is empty
    let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
    let names = io::list_files(folder).ok()?;
    let only = |is_it: &dyn Fn(&str) -> bool| {
        let mut same = names.iter().filter(|other| is_it(&other.to_lowercase()));
        same.next().filter(|_| same.next().is_none()).cloned()
    };
    let name = name.to_lowercase();
    let (stem, ending) = name.rsplit_once('.').unwrap_or((&name, ""));
    let is_picture = READ.contains(&ending) || CONVERTED.contains(&ending);
    let has_stem = |other: &str| other.rsplit_once('.').is_some_and(|(s, e)| s == stem && READ.contains(&e));
    only(&|other| other == name).or_else(|| only(&has_stem).filter(|_| is_picture))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quotes_are_no_part_of_a_name() {
        assert_eq!(unquoted(" \"my head.png\" "), "my head.png");
        assert_eq!(unquoted("'a'"), "a");
        assert_eq!(unquoted("a \"b\""), "a \"b\"");
        assert_eq!(unquoted("\""), "\"");
        assert_eq!(names_between_blanks(" a.mtl  \"b c.mtl\"\t'd.mtl' "), ["a.mtl", "b c.mtl", "d.mtl"]);
        assert_eq!(names_between_blanks("\"a b"), ["\"a", "b"]);
        assert!(names_between_blanks(" ").is_empty());
    }

    #[test]
    fn a_path_of_another_machine_is_cut_to_what_can_lie_in_the_folder() {
        assert_eq!(inner_parts("C:\\scans\\head.png"), ["C", "scans", "head.png"]);
        assert_eq!(inner_parts("..\\textures\\head.png"), ["textures", "head.png"]);
        assert_eq!(inner_parts("/a/../../b.png"), ["b.png"]);
        assert_eq!(inner_parts("./head.png"), ["head.png"]);
        for name in ["", "..", "/", "a/..", ".", "c:"] {
            assert!(inner_parts(name).len() < 2, "{name}");
        }
        assert!(inner_parts("a/..").is_empty());
    }

    #[test]
    fn files_above_the_folder_are_never_found() {
        let dir = tempfile::tempdir().unwrap();
        let inside = dir.path().join("mesh");
        std::fs::create_dir_all(inside.join("textures")).unwrap();
        std::fs::write(dir.path().join("secret.png"), "s").unwrap();
        std::fs::write(inside.join("textures/head.png"), "h").unwrap();
        let secret = dir.path().join("secret.png");
        for name in ["../secret.png", "..\\secret.png", secret.to_str().unwrap(), "x/../../secret.png"] {
            let error = find(&[&inside], Path::new("a.mtl"), name).err().unwrap();
            assert!(error.to_string().contains("which is not there"), "{name}: {error}");
        }
        let found = find(&[&inside], Path::new("a.mtl"), "C:\\x\\Textures\\..\\textures\\head.png").unwrap();
        assert_eq!(found.file, inside.join("textures/head.png"));
        assert!(found.note.unwrap().contains("`textures/head.png` in its folder is taken"));
        for name in ["textures/head.png", "textures/head.png # of the left side"] {
            assert!(find(&[&inside], Path::new("a.mtl"), name).unwrap().note.is_none(), "{name}");
        }
    }

    #[test]
    fn a_picture_that_was_converted_is_found_if_it_is_the_only_one() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("Head.jpg"), "h").unwrap();
        let named =
            |name: &str| find(&[dir.path()], Path::new("a.mtl"), name).map(|found| found.note.unwrap());
        for name in ["head.jpg", "HEAD.JPG", "head.tif", "head.png"] {
            assert!(named(name).unwrap().contains("`Head.jpg` in its folder is taken"), "{name}");
        }
        assert!(named("Head.mtl").is_err() && named("head2.jpg").is_err());
        std::fs::write(dir.path().join("head.png"), "h").unwrap();
        assert!(named("head.tif").unwrap_err().to_string().contains("which is not there"));
    }
}
