//! What to do about what the packages below `tiface` find, in words of its settings and commands.

use crate::config::key;
use tiface_base::Error;
use tiface_base::error::Cause;
use tiface_surface::Warning;

/// Replaces the hint of an error by one that names the setting or command that helps, if one does.
pub(super) fn advised(error: Error) -> Error {
    let hint = match error.cause() {
        Some(Cause::NowhereFinite) => "training diverged: resume `iface` from an earlier checkpoint".into(),
        Some(Cause::AllInside) => {
            "the field may be inverted (negative must be inside), untrained, or the box may lie within the \
             head"
                .into()
        }
        Some(Cause::AllOutside) => format!(
            "train `iface` longer, check that the box holds the head (`{}`), or raise `{}` for small pieces",
            key!(capture.box),
            key!(mesh.resolution)
        ),
        Some(Cause::NoTriangles) => "train longer, or check the mask: an empty surface has no file".into(),
        Some(Cause::Resolution) => format!("lower `{}`", key!(mesh.resolution)),
        Some(Cause::Stale) => "make the mesh again: `tiface mesh RUN --fresh mesh`".into(),
        _ => return error,
    };
    error.with_hint(hint)
}

/// Returns a warning as a sentence that names the setting or command that helps.
pub(super) fn sentence(warning: &Warning) -> String {
    let (triangles, resolution) = (key!(mesh.triangles), key!(mesh.resolution));
    let advice = match warning {
        Warning::NotFinite(_) => "train it again with another `--seed`".into(),
        Warning::Removed { .. } => {
            "if a part of the head is missing, look for it in `mask/sheet.html`".into()
        }
        Warning::NotSolid => "`tiface check RUN` says what is wrong".into(),
        Warning::Handles { .. } => format!("`{} = \"keep\"` keeps all", key!(mesh.genus)),
        Warning::TooManyTriangles { .. } => format!("`{triangles}` can be raised to that"),
        Warning::NotManifold(_) | Warning::Crossing(_) => format!("another `{resolution}` may avoid them"),
        Warning::NoCharts { .. } => {
            format!("a larger `{}` or fewer `{triangles}` help", key!(mesh.texture_px))
        }
        Warning::FinerThanPhotographs { sufficient_px, .. } => {
            format!("set `{}` to {sufficient_px}", key!(mesh.texture_px))
        }
        Warning::OwnCharts(_) => format!("fewer `{triangles}` help"),
    };
    format!("{warning}; {advice}")
}

#[cfg(test)]
mod tests {
    use super::*;
    use glam::Vec3;
    use tiface_base::Quiet;
    use tiface_base::geom::{Aabb, Mesh};
    use tiface_surface::files::{ExportOptions, ExtractedSurface, HeadMesh, to_ply};
    use tiface_surface::{ExtractOptions, extract, extract_dense};

    #[test]
    fn an_error_of_the_surface_names_the_setting_or_command_that_helps() {
        let dir = tempfile::tempdir().unwrap();
        let hint = |error: Error| advised(error).hint().to_owned();
        let options = ExtractOptions { resolution: 16, ..ExtractOptions::default() };
        let none = |value: f32| {
            extract(&move |_: Vec3| value, Aabb::SCENE, &options, &Quiet).map(|_| ()).unwrap_err()
        };
        let dense = |resolution| extract_dense(&|_: Vec3| 1.0, Aabb::SCENE, resolution, &Quiet).unwrap_err();
        assert!(hint(none(f32::NAN)).contains("resume `iface`"));
        assert!(hint(none(-1.0)).contains("inverted"));
        assert!(hint(none(1.0)).contains("train `iface` longer"));
        assert!(hint(dense(9)).contains("`capture.box`"));
        assert_eq!(hint(dense(4096)), "lower `mesh.resolution`");
        let empty = to_ply(&Mesh::default(), None, &ExportOptions::default());
        assert!(hint(empty.unwrap_err()).contains("check the mask"));
        assert!(hint(HeadMesh::load(dir.path()).unwrap_err()).contains("--fresh mesh"));
        assert!(hint(ExtractedSurface::load(dir.path()).unwrap_err()).contains("--fresh mesh"));
        assert_eq!(hint(Error::cannot("it rains", "wait")), "wait");
    }

    #[test]
    fn a_warning_is_what_was_found_and_then_the_setting_that_helps() {
        let handles = Warning::Handles { cut_mm: vec![40.0], filled_mm: Vec::new(), left: 0 };
        assert_eq!(
            sentence(&handles),
            "the surface had loops: 1 cut (40 mm around), 0 holes filled, 0 left; `mesh.genus = \"keep\"` \
             keeps all"
        );
        assert_eq!(
            sentence(&Warning::NoCharts { gutter_px: 0.5, reason: "it broke".into() }),
            "every triangle has a piece of the texture of its own, 0.5 texels of gutter: it broke; a larger \
             `mesh.texture_px` or fewer `mesh.triangles` help"
        );
    }
}
