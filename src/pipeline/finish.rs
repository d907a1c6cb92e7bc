//! From the extracted surface to the head mesh: simplification, atlas and texture baking.

use super::advice::{advised, sentence};
use super::frames::center;
use super::hair_views::hair_views;
use super::mesh_files::Export;
use super::surface::Fields;
use crate::config::{ColorSource, Hair, MeshConfig, Stage};
use glam::Mat3;
use serde_json::{Map, Value, json};
use tiface_base::geom::{Atlas, Camera, Harmonics, Mesh, SdfField, Shells, Similarity};
use tiface_base::image::{Image, linear_from_srgb, srgb_from_linear};
use tiface_base::{Monitor, Result};
use tiface_capture::LoadedView;
use tiface_capture::scene::Scene;
use tiface_surface::bake::{
    BakeConfig, Baked, FittedTexture, Seams, Seen, bake, bake_harmonics, complete, complete_unseen_vertices,
    tangent_space,
};
use tiface_surface::files::{HeadMesh, HeadTexture, LOBE_TEXEL, Lobes, tangents};
use tiface_surface::{
    Appearance, AtlasConfig, Cap, Colors, FittedShells, Photograph, SimplifyConfig, atlas, fit_appearance,
    fit_shells, resolved, shell_importance, simplify,
};

/// How far the true surface may lie from a triangle, in cells: the chords of large triangles and
/// half a cell.
pub(super) const REACH: f32 = 2.5;

/// The head mesh, the files kept beside it, and reports.
pub(super) struct FinishedHead {
    /// The simplified, textured mesh.
    pub head: HeadMesh,
    /// The baked color, linear.
    pub linear: Option<Image>,
    /// A report per step.
    pub report: Map<String, Value>,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Number of cameras that the network's colors are sampled from, where photographs give the rest.
const FALLBACK_VIEWS: usize = 3;

/// A surface to be finished, and what its colors and its files come from. All is in scene
/// coordinates.
pub(super) struct Finish<'a> {
    pub surface: &'a Mesh,
    /// Size of the cells that the surface was extracted with.
    pub cell: f32,
    pub field: &'a dyn SdfField,
    /// The cap where the frames cut the body.
    pub cap: Option<&'a Cap>,
    pub cameras: &'a [Camera],
    pub photographs: &'a [Photograph<'a>],
    /// The fields of the run: hair may be fitted to views of T-Face.
    pub fields: &'a dyn Fields,
    pub scene: &'a Scene,
    pub export: &'a Export,
    pub config: &'a MeshConfig,
    pub monitor: &'a dyn Monitor,
}

/// Reports and warnings of the steps made so far.
#[derive(Default)]
struct StepLog {
    report: Map<String, Value>,
    warnings: Vec<String>,
}

/// The photographs that colors are fitted to, and how.
struct ColorFit<'a> {
    /// `None` if the colors are the network's.
    photographs: Option<&'a [Photograph<'a>]>,
    /// Maximum degree of view-dependent color.
    max_degree: u32,
    /// Turns directions of the scene into those that harmonics are kept in.
    turned: Mat3,
}

impl Finish<'_> {
    /// Simplifies the surface, and colors the vertices or bakes a texture.
    pub fn run(&self) -> Result<FinishedHead> {
        let mut log = StepLog::default();
        let (mut mesh, fitted) = self.simplified(&mut log)?;
        let views = fitted.as_ref().map_or(Ok(Vec::new()), |fitted| self.hair_views(&mesh, fitted))?;
        let rendered = photographs(&views).into_iter().map(|p| Photograph { rendered: true, ..p });
        let pictures: Vec<Photograph> = self.photographs.iter().copied().chain(rendered).collect();
        let shells = fitted.map(|fitted| self.refit(&mesh, fitted, &pictures, &mut log)).transpose()?;
        let seen = Seen::of(&mesh, self.cameras, self.photographs, REACH * self.cell);
        mesh.seen_by.clone_from(&seen.cameras);
        let world_from_scene = self.scene.scene_from_world.inverse();
        let turned = self.lobe_coordinates(&mesh, &world_from_scene)?;
        let fit = self.color_fit(&pictures, turned, &mut log);
        let (texture, harmonics, linear) = if self.config.texture_px == 0 {
            let guess = mesh.colors.clone();
            let fitted = self.fit_colors(&mut mesh, shells.as_ref(), Colors::Vertices, &fit, &mut log)?;
            if fitted.is_some() {
                complete_unseen_vertices(&mut mesh, &seen, &guess);
            }
            (None, fitted.and_then(|fitted| fitted.harmonics).map(|h| faded(h, &seen.glimpse)), None)
        } else {
            let layout = self.unwrap(&mesh, &mut log)?;
            let (mut baked, harmonics) =
                self.bake(&mut mesh, shells.as_ref(), &layout, &fit, &seen, &mut log)?;
            let texture = self.texture(&mesh, layout, &mut baked, harmonics.as_ref(), turned, &mut log);
            (Some(texture), harmonics, self.config.exr.then_some(baked.color))
        };
        let head = HeadMesh { mesh, world_from_scene, texture, harmonics, shells };
        Ok(FinishedHead { head, linear, report: log.report, warnings: log.warnings })
    }

    /// Returns the simplified surface and its soft layers: with fewer triangles in hair if it has
    /// some.
    fn simplified(&self, log: &mut StepLog) -> Result<(Mesh, Option<FittedShells>)> {
        let c = self.config;
        let importance = match c.hair {
            // to an error all places are simplified alike
            Hair::Shells if c.max_error == 0.0 => {
                let sharpness = self.field.sharpness(&self.surface.positions);
                shell_importance(self.surface, &sharpness, self.photographs)
            }
            _ => Vec::new(),
        };
        let (even, warnings) = (importance.is_empty(), log.warnings.len());
        let mesh = self.simplify(importance, log)?;
        let shells = self.shells(&mesh, log)?;
        if even || shells.is_some() {
            return Ok((mesh, shells));
        }
        log.warnings.truncate(warnings);
        Ok((self.simplify(Vec::new(), log)?, None))
    }

    /// Returns the surface with at most the configured number of triangles and error.
    fn simplify(&self, importance: Vec<f32>, log: &mut StepLog) -> Result<Mesh> {
        let c = self.config;
        let mut mesh = self.surface.clone();
        let fewer = c.triangles > 0 && (c.triangles as usize) < mesh.triangles.len();
        if fewer || c.max_error > 0.0 {
            let error = c.max_error * self.cell;
            let config = SimplifyConfig { triangles: c.triangles as usize, error, importance };
            let done = simplify(&mut mesh, Some(self.field), &config, self.monitor).map_err(advised)?;
            log.warnings.extend(done.warnings(&config).iter().map(sentence));
            log.report.insert("simplify".into(), json!(done));
        }
        self.cap.iter().for_each(|cap| cap.flatten(&mut mesh));
        Ok(mesh)
    }

    /// Returns the rotation from the scene to the coordinates that harmonics are kept in: those of
    /// the stage's files, which then hold them as they are. Where a file has another frame, its
    /// writer turns them.
    fn lobe_coordinates(&self, mesh: &Mesh, world_from_scene: &Similarity) -> Result<Mat3> {
        Ok(self.export.frames(mesh, world_from_scene)?.file_from_scene.rotation_f32())
    }

    /// Decides whether colors are fitted to photographs; warns if they should be, but cannot.
    fn color_fit<'p>(&self, pictures: &'p [Photograph<'p>], turned: Mat3, log: &mut StepLog) -> ColorFit<'p> {
        let c = self.config;
        let fits = c.color == ColorSource::Photographs;
        let photographs_say = fits && self.photographs.iter().any(|p| p.head_pixels() > 0);
        if fits && !photographs_say {
            log.warnings.push(
                "no photograph shows the head alone: the mesh has the colors of the network; look at `mask/sheet.html`"
                    .into(),
            );
        }
        ColorFit {
            photographs: photographs_say.then_some(pictures),
            max_degree: if c.lobes > 0 { c.lobes } else { 2 },
            turned,
        }
    }

    /// Returns the soft layers of the hair, if they are asked for and show more of the head.
    fn shells(&self, mesh: &Mesh, log: &mut StepLog) -> Result<Option<FittedShells>> {
        if self.config.hair != Hair::Shells {
            return Ok(None);
        }
        let sharpness = self.field.sharpness(&mesh.positions);
        let (shells, done) = fit_shells(mesh, &sharpness, self.photographs, self.monitor)?;
        log.report.insert("shells".into(), json!(done));
        Ok(shells)
    }

    /// Returns the views that layers are fitted to besides the photographs.
    fn hair_views(&self, mesh: &Mesh, fitted: &FittedShells) -> Result<Vec<LoadedView>> {
        if !self.config.uses_tface() {
            return Ok(Vec::new());
        }
        let field = self.fields.radiance(Stage::Tface)?;
        hair_views(mesh, &fitted.shells, self.cameras, field, self.monitor)
    }

    /// Fits layers to all pictures, if there may be more than they were fitted to.
    fn refit(
        &self,
        mesh: &Mesh,
        fitted: FittedShells,
        pictures: &[Photograph],
        log: &mut StepLog,
    ) -> Result<Shells> {
        if !self.config.uses_tface() {
            return Ok(fitted.shells);
        }
        let (shells, triangles) = fitted.refit(mesh, pictures, self.monitor)?;
        let views = pictures.len() - self.photographs.len();
        log.report.insert("hair_views".into(), json!({"views": views, "kept_triangles": triangles}));
        Ok(shells)
    }

    /// Fits colors to the photographs, if there are any to fit to, and gives them to the vertices.
    fn fit_colors(
        &self,
        mesh: &mut Mesh,
        shells: Option<&Shells>,
        colors: Colors,
        fit: &ColorFit,
        log: &mut StepLog,
    ) -> Result<Option<Appearance>> {
        let Some(photographs) = fit.photographs else { return Ok(None) };
        let fitted =
            fit_appearance(mesh, shells, colors, photographs, fit.max_degree, fit.turned, self.monitor)?;
        let Some(mut fitted) = fitted else { return Ok(None) };
        log.report.insert("appearance".into(), json!(fitted.report));
        mesh.colors = std::mem::take(&mut fitted.vertices);
        Ok(Some(fitted))
    }

    /// Lays the mesh out in an atlas.
    fn unwrap(&self, mesh: &Mesh, log: &mut StepLog) -> Result<Atlas> {
        let (c, scene_from_world) = (self.config, &self.scene.scene_from_world);
        let center = center(self.surface, &scene_from_world.inverse());
        let config = AtlasConfig {
            resolved: Some(resolved(mesh, self.cameras)),
            ..self.export.atlas_config(center, scene_from_world, c.texture_px, c.gutter_px)
        };
        let (layout, done) = atlas(mesh, &config, self.monitor)?;
        log.warnings.extend(done.warnings().iter().map(sentence));
        log.report.insert("atlas".into(), json!(done));
        Ok(layout)
    }

    /// Bakes the field into the atlas, and fits the color to photographs.
    fn bake(
        &self,
        mesh: &mut Mesh,
        shells: Option<&Shells>,
        layout: &Atlas,
        fit: &ColorFit,
        seen: &Seen,
        log: &mut StepLog,
    ) -> Result<(Baked, Option<Harmonics>)> {
        let (c, fits) = (self.config, fit.photographs.is_some());
        let config = BakeConfig {
            // colors that are then fitted to photographs need no exact baking
            side: if fits { 1 } else { c.texture_samples },
            views: if fits { FALLBACK_VIEWS } else { usize::MAX },
            gutter_px: c.gutter_px,
            reach: REACH * self.cell,
            lobes: if fits { 0 } else { c.lobes },
            normals: c.normal_map,
            turned: fit.turned,
        };
        let mut baked = bake(mesh, layout, self.field, self.cameras, &config, self.monitor)?;
        log.report.insert("bake".into(), json!(baked.report));
        if !fits {
            return Ok((baked, None));
        }
        let mut image = baked.color.clone();
        image.data.iter_mut().for_each(|v| *v = srgb_from_linear(*v));
        let Some(fitted) = self.fit_colors(mesh, shells, Colors::Texels(layout, &image), fit, log)? else {
            return Ok((baked, None));
        };
        let (texels, mut known) = fitted.texels;
        let own =
            Image { width: layout.width, height: layout.height, channels: 3, data: texels.into_flattened() };
        let before = own.clone();
        let guess = std::mem::replace(&mut image, own);
        let cap = self.cap;
        let fitted_texture = FittedTexture {
            mesh: &mut *mesh,
            atlas: layout,
            seen,
            guess: &guess,
            image: &mut image,
            known: &mut known,
            calm: &|p| cap.is_some_and(|cap| cap.holds(p)),
        };
        let unseen = fitted_texture.complete_unseen();
        complete(&mut image, &known, c.gutter_px, &Seams::new(mesh, layout));
        if let Some(unseen) = unseen {
            log.report.insert("unseen".into(), json!(unseen.report(&before, &image)));
        }
        image.data.iter_mut().for_each(|v| *v = linear_from_srgb(*v));
        baked.color = image;
        Ok((baked, fitted.harmonics.map(|h| faded(h, &seen.glimpse))))
    }

    /// Returns the pictures of a texture, coded as in files. Harmonics that were fitted replace
    /// baked lobes.
    fn texture(
        &self,
        mesh: &Mesh,
        layout: Atlas,
        baked: &mut Baked,
        harmonics: Option<&Harmonics>,
        turned: Mat3,
        log: &mut StepLog,
    ) -> HeadTexture {
        let c = self.config;
        let color = baked.color.encoded();
        log.report.insert("seam_step_255".into(), json!(Seams::new(mesh, &layout).step(&color)));
        let mut normal = None;
        if let Some(normals) = &baked.normal {
            match tangents(mesh, &layout) {
                Ok(tangents) => {
                    normal = Some(tangent_space(mesh, &layout, &tangents, normals, c.gutter_px));
                }
                Err(e) => {
                    let problem = format!("the mesh has no normal map: {e}; leave out `mesh.normal_map`");
                    log.warnings.push(problem);
                }
            }
        }
        if let Some(harmonics) = harmonics.filter(|_| c.lobes > 0) {
            baked.lobes = bake_harmonics(mesh, &layout, harmonics, c.gutter_px);
        }
        // the network's are as fine as the color
        let lobes = Lobes::new(&baked.lobes, turned).map(|l| l.reduced(c.texture_px / LOBE_TEXEL));
        HeadTexture { atlas: layout, color, normal, lobes }
    }
}

/// Returns loaded photographs in the form that colors are fitted to.
pub(super) fn photographs(views: &[LoadedView]) -> Vec<Photograph<'_>> {
    views
        .iter()
        .map(|view| Photograph {
            camera: &view.camera,
            photo: &view.photo,
            mask: view.mask.as_ref(),
            valid: view.valid.as_ref(),
            rendered: false,
        })
        .collect()
}

/// Returns view-dependent color that each vertex has by its trust: what nobody saw looks the same
/// from everywhere.
fn faded(mut harmonics: Harmonics, trust: &[f32]) -> Harmonics {
    for (own, trust) in harmonics.coefficients.chunks_mut(harmonics.functions).zip(trust) {
        own.iter_mut().flatten().for_each(|c| *c *= trust);
    }
    harmonics
}

#[cfg(test)]
mod tests {
    use super::*;
    use tiface_surface::files::testing::tetrahedron;

    #[test]
    fn what_nobody_saw_looks_the_same_from_everywhere() {
        let harmonics = tetrahedron().harmonics.unwrap();
        let (functions, before) = (harmonics.functions, harmonics.coefficients.clone());
        let after = faded(harmonics, &[0.0, 1.0, 0.5, 1.0]).coefficients;
        assert!(after[..functions].iter().all(|c| *c == [0.0; 3]));
        assert_eq!(after[functions..2 * functions], before[functions..2 * functions]);
        assert!(
            after[2 * functions..3 * functions]
                .iter()
                .zip(&before[2 * functions..])
                .all(|(a, b)| a[2] == 0.5 * b[2])
        );
    }
}
