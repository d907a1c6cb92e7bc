//! `--out`: another place to write the product of a command to. One rule for all commands, checked
//! before any work begins.
//!
//! A path with an ending of the product's formats is a file; an existing folder, or a path that
//! ends in `/`, receives the product under its usual names; everything else is refused.

use crate::config::MeshFormat;
use crate::pipeline::{DEMO_CAPTURE, KeptHead, Session, Stage};
use crate::run::Run;
use std::path::{Path, PathBuf};
use tiface_base::io;
use tiface_base::{Error, Result};
use tiface_surface::files::ExportedFiles;

/// A writable destination.
#[derive(Debug, PartialEq)]
pub(super) enum Out {
    /// One file, and its ending in lower case, which selects the format.
    File(PathBuf, String),
    /// A folder; created if it does not exist.
    Folder(PathBuf),
}

/// Returns the file endings that a command can write.
fn endings(product: &str) -> &'static [&'static str] {
    match product {
        "run" => &["glb", "obj", "ply", "usdz", "json"],
        "mesh" | "export" => &["glb", "obj", "ply", "usdz"],
        "metrics" => &["json"],
        "page" | "report" => &["html"],
        "preview" => &["png"],
        "turntable" => &io::ANIMATIONS,
        _ => &[],
    }
}

impl Out {
    /// Returns the destination that `out` means for the product of a command, named like the
    /// command. Nothing is written.
    pub fn find(out: Option<&Path>, product: &str) -> Result<Option<Out>> {
        let Some(out) = out else { return Ok(None) };
        let shown = out.display();
        if io::is_folder(out) {
            return writable(out).map(|()| Some(Out::Folder(out.into())));
        }
        let folder = out.to_string_lossy().ends_with(std::path::is_separator);
        let ending = out.extension().map(|e| e.to_string_lossy().to_lowercase()).unwrap_or_default();
        let known = endings(product);
        if !folder && !known.contains(&ending.as_str()) {
            let list: Vec<String> = known.iter().map(|e| format!(".{e}")).collect();
            let hint = match list.len() {
                0 => "name a folder, with `/` at its end".to_string(),
                _ => format!("end it in {}, or in `/` for a folder", list.join(", ")),
            };
            return Err(Error::usage(format!("`--out {shown}`: `{product}` writes no such file"), hint));
        }
        // by its name without the `/`, by which a file is not found
        let bare = out.components().as_path();
        if io::exists(bare) && (folder || !io::is_file(bare)) {
            let what = if folder { "folder" } else { "regular file" };
            return Err(Error::cannot(format!("`--out {shown}` is not a {what}"), "choose another name"));
        }
        writable(out.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new(".")))?;
        Ok(Some(if folder { Out::Folder(out.into()) } else { Out::File(out.into(), ending) }))
    }

    /// Refuses `--out` for a command without a product.
    pub fn none(out: Option<&Path>, command: &str) -> Result<()> {
        match out {
            Some(_) => Err(Error::usage(format!("`{command}` has no product for `--out`"), "leave it out")),
            None => Ok(()),
        }
    }

    /// Refuses a folder inside the run, and a mesh file if none of these stages makes a mesh.
    pub fn check(&self, run: &Path, stages: &[Stage]) -> Result<()> {
        let mesh = matches!(self, Out::File(_, ending) if ending.parse::<MeshFormat>().is_ok());
        if mesh && !stages.contains(&Stage::Mesh) {
            return Err(Error::usage(
                "these settings make no mesh that `--out` could write",
                "use `tiface mesh --out head.glb`",
            ));
        }
        match self {
            // a folder would be copied into itself
            Out::Folder(folder) => require_outside(folder, run),
            Out::File(..) => Ok(()),
        }
    }

    /// Creates the destination folder, and removes temporary files of killed commands from it: all
    /// of them in a folder that was named, else those that begin with the file's name.
    pub fn prepare(&self) -> Result<()> {
        match self {
            Out::File(file, _) => {
                let folder = file.parent().filter(|f| !f.as_os_str().is_empty()).unwrap_or(Path::new("."));
                prepare(folder, &file.file_stem().unwrap_or_default().to_string_lossy())
            }
            Out::Folder(folder) => prepare(folder, ""),
        }
    }

    /// Writes the command's product to the destination, and returns the paths of what was written.
    pub fn write(&self, product: &str, session: &Session, run: &Run) -> Result<Vec<PathBuf>> {
        self.prepare()?;
        match self {
            Out::File(file, ending) if let Ok(format) = ending.parse() => {
                let head = KeptHead::read(run.dir(), session.config())?;
                let stem = file.file_stem().and_then(|stem| stem.to_str()).unwrap_or("head");
                let export = head.files(0, format, stem)?;
                head.warnings.iter().chain(&export.warnings).for_each(|warning| run.warn("mesh", warning));
                write_files(file, &export)
            }
            Out::File(file, ending) if ending == "json" => {
                copy_file(&run.path("metrics/metrics.json"), file)?;
                Ok(vec![file.clone()])
            }
            // no stage makes another file: `Out::find` has refused it
            Out::File(file, _) => Ok(vec![file.clone()]),
            Out::Folder(folder) => {
                // fields, and pictures that only another stage can read, are not copied
                match product {
                    "run" => copy_folder(run.dir(), folder, &["baseline", "tface", "iface", DEMO_CAPTURE])?,
                    "render" => copy_folder(&run.path(session.views()), folder, &["float", "paths"])?,
                    stage => copy_folder(&run.path(stage), folder, &["float", "parts"])?,
                }
                if product == "metrics" {
                    copy_file(&run.path("report.html"), &folder.join("report.html"))?;
                }
                Ok(vec![folder.clone()])
            }
        }
    }

    /// Returns the file to write: the one that was named, or `name` in the folder.
    pub fn file(&self, name: &str) -> PathBuf {
        match self {
            Out::File(file, _) => file.clone(),
            Out::Folder(folder) => folder.join(name),
        }
    }
}

/// Refuses a path inside a run.
pub(super) fn require_outside(path: &Path, run: &Path) -> Result<()> {
    let target = path
        .ancestors()
        .find_map(|f| io::real_path(if f.as_os_str().is_empty() { Path::new(".") } else { f }).ok());
    match (target, io::real_path(run)) {
        (Some(target), Ok(run)) if target.starts_with(&run) => {
            let text = format!("`{}` is inside the run", path.display());
            Err(Error::usage(text, "choose another place with `--out`, beside the run"))
        }
        _ => Ok(()),
    }
}

/// Writes an exported mesh to a file, and the files that it refers to beside it; returns their
/// paths.
pub(super) fn write_files(file: &Path, export: &ExportedFiles) -> Result<Vec<PathBuf>> {
    // the mesh refers to its pictures, so it is written last, under the requested name
    let mut written = vec![file.to_path_buf()];
    for (name, bytes) in export.files.iter().skip(1).rev() {
        written.push(file.with_file_name(name));
        io::write_atomic(&written[written.len() - 1], bytes)?;
    }
    io::write_atomic(file, &export.files[0].1)?;
    Ok(written)
}

fn prepare(folder: &Path, start: &str) -> Result<()> {
    io::create_folder(folder)?;
    let belongs = |name: &str| {
        name.strip_prefix(start).is_some_and(|rest| start.is_empty() || rest.starts_with(['.', '_']))
    };
    io::remove_leftovers(folder, |name, pid| belongs(name) && io::has_ended(pid))?;
    Ok(())
}

fn copy_file(from: &Path, to: &Path) -> Result<()> {
    Ok(io::write_atomic(to, &io::read_maybe_empty(from, &io::Limits::default())?)?)
}

/// Copies all files but the records of the stages, and all folders except those in `left`; in
/// subfolders only the float views are left out.
fn copy_folder(from: &Path, to: &Path, left: &[&str]) -> Result<()> {
    prepare(to, "")?;
    for name in io::list_files(from)? {
        if !["done.json", "status.json", "log.jsonl"].contains(&name.as_str()) {
            copy_file(&from.join(&name), &to.join(&name))?;
        }
    }
    for folder in io::list_folders(from)? {
        if let Some(name) = folder.file_name().filter(|n| !left.iter().any(|k| n == k)) {
            copy_folder(&folder, &to.join(name), &["float", "parts"])?;
        }
    }
    Ok(())
}

fn writable(folder: &Path) -> Result<()> {
    let shown = folder.display();
    if !io::is_folder(folder) {
        return Err(Error::cannot(format!("the folder `{shown}` does not exist"), "create it first"));
    }
    if !io::is_writable(folder) {
        return Err(Error::cannot(
            format!("the folder `{shown}` is not writable"),
            "choose a folder with write permission",
        ));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_out_means_is_known_before_anything_begins() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| format!("{}/{name}", dir.path().display());
        std::fs::create_dir(at("there.glb")).unwrap();
        std::fs::write(at("plain"), "").unwrap();
        let find = |name: &str, product: &str| Out::find(Some(Path::new(&at(name))), product);
        let code = |name: &str, product: &str| find(name, product).unwrap_err().kind().code();
        assert_eq!(find("a.GLB", "mesh").unwrap(), Some(Out::File(at("a.GLB").into(), "glb".into())));
        assert_eq!(find("m.json", "metrics").unwrap(), Some(Out::File(at("m.json").into(), "json".into())));
        for (name, product) in [("new/", "mesh"), ("there.glb", "render"), ("new.d/", "page")] {
            assert_eq!(find(name, product).unwrap(), Some(Out::Folder(at(name).into())));
        }
        for (name, product) in [("a.fbx", "mesh"), ("a.stl", "run"), ("a", "render"), ("a.glb", "metrics")] {
            assert_eq!(code(name, product), 2, "{name}");
        }
        for (name, product) in [("absent/a.glb", "mesh"), ("absent/new/", "run"), ("plain/", "mask")] {
            assert_eq!(code(name, product), 1, "{name}");
        }
        let run = dir.path().join("there.glb");
        assert!(find("there.glb/", "run").unwrap().unwrap().check(&run, &[]).is_err());
        assert!(find("there.glb/new/", "run").unwrap().unwrap().check(&run, &[]).is_err());
        assert!(find("new/", "run").unwrap().unwrap().check(&run, &[]).is_ok());
        assert!(
            require_outside(&run.join("new/a.glb"), &run).is_err()
                && require_outside(&run, dir.path()).is_err()
        );
        assert!(require_outside(&dir.path().join("a.glb"), &run).is_ok());
    }
}
