//! Color of what no photograph shows, or only at a steep angle.
//!
//! There a fit to photographs keeps what the network guesses: the light of lamps behind hair, or a
//! color between all others. Instead it takes the smooth color of the trusted surface of its
//! material around it (`smooth`), and that material's grain (`grain`); with the trust in a
//! photograph's color that color fades in. Nothing unseen is brighter than what was seen of its
//! material.

use super::cover::{Bands, Sample};
use super::grain::Grain;
use super::smooth::SmoothColors;
use super::trust::Seen;
use crate::appearance::Nodes;
use glam::Vec3;
use serde::Serialize;
use tiface_base::geom::{Atlas, Hit, Mesh};
use tiface_base::image::Image;

/// Share of a material's trusted texels that are no brighter than the limit for what was not seen:
/// the rest may be lamps' reflections.
const BRIGHTEST: f64 = 0.999;

/// Trust below which a texel counts as unseen.
const UNSEEN: f32 = 0.5;

/// Trust from which on a texel keeps its color: 1, but for rounding.
const FULL: f32 = 0.999;

/// Half a step of a picture of bytes: what is brighter by less, is not.
const HALF_STEP: f32 = 0.5 / 255.0;

/// Texels of a texture by what is known of them, to measure what was made of the unseen ones.
pub struct TexelTrust {
    /// Texels whose color is trusted, with their materials.
    trusted: Vec<(u32, u8)>,
    /// Texels that were not seen, with theirs.
    unseen: Vec<(u32, u8)>,
    /// Number of texels that a triangle covers.
    texels: usize,
    materials: usize,
}

/// Figures of the color that unseen texels were given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct UnseenReport {
    /// Number of materials.
    pub materials: usize,
    /// Share of the texels that were not seen, or only at a steep angle.
    pub share: f64,
    /// Number of them that were brighter than the brightest trusted one of their material.
    pub brighter_before: usize,
    /// The same of those that are now.
    pub brighter: usize,
}

impl TexelTrust {
    /// Returns how many unseen texels of a picture are brighter than the brightest trusted one of
    /// their material.
    pub fn brighter(&self, image: &Image) -> usize {
        let brightness = |texel: u32| luma(texel_of(image, texel));
        let mut most = vec![0f32; self.materials];
        for &(texel, material) in &self.trusted {
            let most = &mut most[usize::from(material)];
            *most = most.max(brightness(texel));
        }
        self.unseen
            .iter()
            .filter(|(texel, material)| brightness(*texel) > most[usize::from(*material)] + HALF_STEP)
            .count()
    }

    /// Returns the figures of a picture, with how it was before.
    pub fn report(&self, before: &Image, after: &Image) -> UnseenReport {
        UnseenReport {
            materials: self.materials,
            share: self.unseen.len() as f64 / self.texels.max(1) as f64,
            brighter_before: self.brighter(before),
            brighter: self.brighter(after),
        }
    }

    /// Returns the brightness that all but the brightest trusted texels of each material stay
    /// below.
    fn limits(&self, image: &Image) -> Vec<f32> {
        let mut of_material = vec![Vec::new(); self.materials];
        for &(texel, material) in &self.trusted {
            of_material[usize::from(material)].push(luma(texel_of(image, texel)));
        }
        let limit = |all: &mut Vec<f32>| {
            let at = (all.len().saturating_sub(1) as f64 * BRIGHTEST) as usize;
            if all.is_empty() { 0.0 } else { *all.select_nth_unstable_by(at, f32::total_cmp).1 }
        };
        of_material.iter_mut().map(limit).collect()
    }
}

/// A fitted texture, and what it is completed with.
pub struct FittedTexture<'a> {
    /// The mesh, with normals; its colors are those that were fitted.
    pub mesh: &'a mut Mesh,
    /// Its atlas.
    pub atlas: &'a Atlas,
    /// What cameras have seen of the vertices.
    pub seen: &'a Seen,
    /// The picture before the fit, sRGB-coded.
    pub guess: &'a Image,
    /// The picture, sRGB-coded.
    pub image: &'a mut Image,
    /// Texels with a color of their own.
    pub known: &'a mut [bool],
    /// Points that get no grain.
    pub calm: &'a (dyn Fn(Vec3) -> bool + Sync),
}

impl FittedTexture<'_> {
    /// Gives texels and vertices without trust the color of their material; `None`, and no change,
    /// where nothing is trusted. Texels that no triangle covers are no longer known beside a texel
    /// that was changed: they repeat it.
    pub fn complete_unseen(self) -> Option<TexelTrust> {
        let FittedTexture { mesh, atlas, seen, guess, image, known, calm } = self;
        let nodes = Nodes::vertices(mesh);
        let bands = Bands::new(atlas, 1);
        let all: Vec<Sample> = (0..bands.len())
            .flat_map(|band| {
                let samples = bands.samples(atlas, band, 1);
                samples.chunk_by(|a, b| a.texel == b.texel).map(|s| s[0]).collect::<Vec<_>>()
            })
            .collect();
        let at = |s: &Sample, trust: &[f32]| {
            s.hit().mix(mesh.triangles[s.triangle as usize].map(|v| trust[v as usize]))
        };
        let sure = |s: &Sample| at(s, &seen.trust);
        let (guesses, _) = at_vertices(mesh, &all, guess, |_| 1.0);
        let (own, evidence) = at_vertices(mesh, &all, image, sure);
        // a vertex without a trusted texel has no color that could be trusted
        let some = |(trust, evidence): (&f32, &f32)| if *evidence > 1e-3 { *trust } else { 0.0 };
        let certain: Vec<f32> = seen.trust.iter().zip(&evidence).map(some).collect();
        let smooth = SmoothColors::new(mesh, &nodes, &certain, &own, &guesses)?;
        let (shown, _) = at_vertices(mesh, &all, image, |_| 1.0);
        let trust = smooth.confirmed(&nodes, seen, &shown);
        let trust_at = |s: &Sample| at(s, &trust);
        let open: Vec<Sample> = all.iter().filter(|s| trust_at(s) < FULL).copied().collect();
        let grain =
            Grain { mesh, atlas, nodes: &nodes, trust: &certain, smooth: &smooth, image: &*image, calm };
        let grain = grain.of(&open);
        let material = |s: &Sample| (s.texel, smooth.material_at(&s.hit()).0 as u8);
        let texels = TexelTrust {
            trusted: all.iter().filter(|s| sure(s) >= FULL).map(material).collect(),
            unseen: open.iter().filter(|s| trust_at(s) < UNSEEN).map(material).collect(),
            texels: all.len(),
            materials: smooth.materials(),
        };
        let limits = texels.limits(image);
        for (sample, grain) in open.iter().zip(&grain) {
            let (trust, plain) = (trust_at(sample), smooth.at(&sample.hit()));
            let at = 3 * sample.texel as usize;
            let mixed: [f32; 3] = std::array::from_fn(|k| {
                let made = (plain[k] + grain[k]).clamp(0.0, 1.0);
                made + trust * (image.data[at + k] - made)
            });
            let limited = below(mixed, limits[smooth.material_at(&sample.hit()).0]);
            image.data[at..at + 3].copy_from_slice(&limited);
        }
        repeat_beside(&all, &open, known, atlas.width as usize);
        let colors = vertex_colors(mesh, &trust, &smooth);
        mesh.colors = colors;
        Some(texels)
    }
}

/// Gives vertices with colors, but without trust, the color of their material.
pub fn complete_unseen_vertices(mesh: &mut Mesh, seen: &Seen, guess: &[[f32; 3]]) {
    let nodes = Nodes::vertices(mesh);
    let own = mesh.colors.clone();
    let Some(smooth) = SmoothColors::new(mesh, &nodes, &seen.trust, &own, guess) else { return };
    let colors = vertex_colors(mesh, &smooth.confirmed(&nodes, seen, &own), &smooth);
    mesh.colors = colors;
}

/// Returns the colors of vertices, mixed by trust with the smooth ones.
fn vertex_colors(mesh: &Mesh, trust: &[f32], smooth: &SmoothColors) -> Vec<[f32; 3]> {
    let mut colors = mesh.colors.clone();
    for (t, triangle) in mesh.triangles.iter().enumerate() {
        for (&vertex, (u, v)) in triangle.iter().zip([(0.0, 0.0), (1.0, 0.0), (0.0, 1.0)]) {
            let (v_at, trust) = (vertex as usize, trust[vertex as usize]);
            if let (true, Some(own)) = (trust < 1.0, mesh.colors.get(v_at)) {
                let plain = smooth.at(&Hit { t: 0.0, triangle: t as u32, u, v });
                colors[v_at] = std::array::from_fn(|k| plain[k] + trust * (own[k] - plain[k]));
            }
        }
    }
    colors
}

/// Returns the mean color of the texels around each vertex, and their weights, `[vertices]`.
fn at_vertices(
    mesh: &Mesh,
    samples: &[Sample],
    image: &Image,
    weight: impl Fn(&Sample) -> f32,
) -> (Vec<[f32; 3]>, Vec<f32>) {
    let mut sums = vec![[0f32; 3]; mesh.positions.len()];
    let mut weights = vec![0f32; mesh.positions.len()];
    for sample in samples {
        let (hit, color, weight) = (sample.hit(), texel_of(image, sample.texel), weight(sample));
        for (&vertex, share) in mesh.triangles[hit.triangle as usize].iter().zip(hit.weights()) {
            let share = share.max(0.0) * weight;
            weights[vertex as usize] += share;
            (0..3).for_each(|k| sums[vertex as usize][k] += share * color[k]);
        }
    }
    sums.iter_mut().zip(&weights).filter(|(_, w)| **w > 0.0).for_each(|(s, w)| *s = s.map(|v| v / w));
    (sums, weights)
}

/// Makes texels beside changed ones unknown, unless a triangle covers them.
fn repeat_beside(all: &[Sample], changed: &[Sample], known: &mut [bool], width: usize) {
    let mut covered = vec![false; known.len()];
    all.iter().for_each(|s| covered[s.texel as usize] = true);
    let height = known.len() / width;
    for sample in changed {
        let (x, y) = (sample.texel as usize % width, sample.texel as usize / width);
        for y in y.saturating_sub(1)..(y + 2).min(height) {
            for x in x.saturating_sub(1)..(x + 2).min(width) {
                known[y * width + x] &= covered[y * width + x];
            }
        }
    }
}

fn texel_of(image: &Image, texel: u32) -> [f32; 3] {
    let at = 3 * texel as usize;
    [image.data[at], image.data[at + 1], image.data[at + 2]]
}

/// Returns the brightness of an sRGB-coded color, coded too (Rec. 709).
fn luma([r, g, b]: [f32; 3]) -> f32 {
    0.2126 * r + 0.7152 * g + 0.0722 * b
}

/// Returns a color that is darkened to a brightness if it is brighter.
fn below(color: [f32; 3], limit: f32) -> [f32; 3] {
    let found = luma(color);
    if found > limit { color.map(|c| c * limit / found) } else { color }
}

#[cfg(test)]
mod tests {
    use super::super::fill::fill;
    use super::*;
    use crate::bake::testing::ball;
    use crate::files::HeadMesh;
    use std::sync::OnceLock;

    const SKIN: [f32; 3] = [0.8, 0.6, 0.5];
    const CLOTH: [f32; 3] = [0.2, 0.25, 0.4];

    /// A ball of radius 12, skin above and striped cloth below, that was seen where x < 4; where
    /// nobody looked, the guess has a lamp.
    #[derive(Clone)]
    struct Scene {
        mesh: Mesh,
        atlas: Atlas,
        seen: Seen,
        guess: Image,
        image: Image,
        known: Vec<bool>,
        places: Vec<(u32, Vec3)>,
    }

    impl Scene {
        /// Returns the fit of the scene, to be completed with grain but where it is calm.
        fn fitted<'a>(&'a mut self, calm: &'a (dyn Fn(Vec3) -> bool + Sync)) -> FittedTexture<'a> {
            FittedTexture {
                mesh: &mut self.mesh,
                atlas: &self.atlas,
                seen: &self.seen,
                guess: &self.guess,
                image: &mut self.image,
                known: &mut self.known,
                calm,
            }
        }
    }

    /// Stripes along x, a few texels wide.
    fn paint(p: Vec3) -> [f32; 3] {
        let stripe = if (2.0 * p.z).rem_euclid(2.0) < 1.0 { 0.03 } else { -0.03 };
        if p.y > 0.0 { SKIN } else { CLOTH.map(|c| c + stripe) }
    }

    fn scene() -> Scene {
        static SCENE: OnceLock<Scene> = OnceLock::new();
        SCENE.get_or_init(make_scene).clone()
    }

    fn make_scene() -> Scene {
        let HeadMesh { mesh, texture, .. } = ball();
        let atlas = texture.unwrap().atlas;
        let trust: Vec<f32> = mesh.positions.iter().map(|p| ((6.0 - p.x) / 2.0).clamp(0.0, 1.0)).collect();
        let seen = Seen { cameras: Vec::new(), glimpse: trust.clone(), trust };
        let (w, h) = (atlas.width, atlas.height);
        let (mut image, mut guess) = (Image::new(w, h, 3), Image::new(w, h, 3));
        let (mut known, mut places) = (vec![false; (w * h) as usize], Vec::new());
        let bands = Bands::new(&atlas, 1);
        for s in (0..bands.len()).flat_map(|band| bands.samples(&atlas, band, 1)) {
            let (p, at) = (mesh.point_at(&s.hit()), 3 * s.texel as usize);
            let lamp = p.distance(Vec3::new(11.0, -5.0, 0.0)) < 1.2;
            let guessed = if lamp { [1.0; 3] } else { paint(p) };
            let fitted = if p.x > 6.0 { guessed } else { paint(p) };
            guess.data[at..at + 3].copy_from_slice(&guessed);
            image.data[at..at + 3].copy_from_slice(&fitted);
            known[at / 3] = true;
            places.push((s.texel, p));
        }
        // a look-up at the border of a chart must not meet black
        fill(&mut image, &known, 4);
        fill(&mut guess, &known, 4);
        Scene { mesh, atlas, seen, guess, image, known, places }
    }

    #[test]
    fn a_lamp_where_nobody_looked_becomes_cloth_with_its_grain() {
        let mut s = scene();
        let before = s.image.clone();
        let texels = s.fitted(&|p| p.y < -11.0).complete_unseen().unwrap();
        let report = texels.report(&before, &s.image);
        assert!(report.materials < 5 && report.brighter == 0, "{report:?}");
        assert!(report.brighter_before > 100 && report.share > 0.15 && report.share < 0.35, "{report:?}");
        let (mut rough, mut count) = (0.0, 0);
        for &(texel, p) in &s.places {
            let (found, was) = (texel_of(&s.image, texel), texel_of(&before, texel));
            if p.x < 2.5 {
                assert_eq!(found, was, "{p}");
            } else if p.x > 7.0 && p.y.abs() > 3.0 {
                let plain = if p.y > 0.0 { SKIN } else { CLOTH };
                // stripes are 0.03 above and below; patches that overlap add some
                assert!((0..3).all(|k| (found[k] - plain[k]).abs() < 0.1), "{p} {found:?}");
                if p.y < -3.0 && p.y > -10.0 {
                    rough += (found[0] - plain[0]).powi(2);
                    count += 1;
                }
            }
        }
        // the contrast of the stripes, 0.03, less what the smooth color follows
        let rough = (rough / count as f32).sqrt();
        assert!(rough > 0.01 && rough < 0.045, "{rough}");
        // vertices are smooth
        for (p, c) in s.mesh.positions.iter().zip(&s.mesh.colors).filter(|(p, _)| p.x > 7.0 && p.y < -3.0) {
            assert!((0..3).all(|k| (c[k] - CLOTH[k]).abs() < 0.03), "{p} {c:?}");
        }
    }

    #[test]
    fn a_calm_place_has_no_grain_and_without_trust_nothing_changes() {
        let mut s = scene();
        let before = s.image.clone();
        let none = vec![0.0; s.seen.trust.len()];
        let unseen = Seen { trust: none.clone(), glimpse: none, ..Seen::default() };
        let seen = std::mem::replace(&mut s.seen, unseen);
        assert!(s.fitted(&|_| true).complete_unseen().is_none());
        assert_eq!(s.image, before);
        s.seen = seen;
        assert!(s.fitted(&|_| true).complete_unseen().is_some());
        for &(texel, p) in s.places.iter().filter(|(_, p)| p.x > 8.0 && p.y < -3.0) {
            let found = texel_of(&s.image, texel);
            assert!((0..3).all(|k| (found[k] - CLOTH[k]).abs() < 0.03), "{p} {found:?}");
        }
    }

    #[test]
    fn what_was_glimpsed_stays_unless_it_is_a_lamp() {
        // the fit shows the lamp, and cloth whose stripes are no guess
        let kept = |glimpsed: bool| {
            let mut s = scene();
            if glimpsed {
                s.seen.glimpse.fill(1.0);
            }
            let before = s.image.clone();
            assert!(s.fitted(&|_| false).complete_unseen().is_some());
            let (mut kept, mut all) = (0, 0);
            for &(texel, p) in s.places.iter().filter(|(_, p)| p.x > 7.0 && p.y < -3.0) {
                let (found, was) = (texel_of(&s.image, texel), texel_of(&before, texel));
                let away = p.distance(Vec3::new(11.0, -5.0, 0.0));
                assert!(away > 0.5 || found[0] < 0.4, "{p} {found:?}");
                // a third of the way from dark stripes to light ones
                let same = (0..3).all(|k| (found[k] - was[k]).abs() < 0.02);
                if away > 6.0 {
                    (kept, all) = (kept + usize::from(same), all + 1);
                }
            }
            kept as f64 / f64::from(all)
        };
        let (glimpsed, never) = (kept(true), kept(false));
        assert!(glimpsed > 0.9 && never < 0.7, "{glimpsed} {never}");
    }

    #[test]
    fn only_what_is_brighter_than_all_that_is_trusted_counts() {
        let image =
            Image { width: 4, height: 1, channels: 3, data: [0.5, 0.2, 0.6, 0.4].map(|v| [v; 3]).concat() };
        let of = |unseen: Vec<(u32, u8)>| {
            TexelTrust { trusted: vec![(0, 0), (1, 1)], unseen, texels: 4, materials: 2 }.brighter(&image)
        };
        // 0.6 is above 0.5, 0.4 is not; of the other material both are above 0.2
        assert_eq!([of(vec![(2, 0), (3, 0)]), of(vec![(2, 1), (3, 1)]), of(vec![(1, 1)])], [1, 2, 0]);
        assert_eq!(below([0.5, 0.5, 0.5], 0.25), [0.25; 3]);
        assert_eq!(below([0.1, 0.2, 0.3], 0.25), [0.1, 0.2, 0.3]);
    }
}
