//! `tiface export`: writes the finished head of a run to files for other programs.

use super::Invocation;
use super::out::{Out, require_outside, write_files};
use super::preview::{AXES, axis, no_up};
use super::screen::print;
use super::target::RunTarget;
use crate::config::{Config, MeshFormat, Stage};
use crate::pipeline::{Cut, ExportRequest, KeptHead, Material, MeshFrame, Size};
use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use glam::{DVec3, Vec3};
use serde_json::json;
use std::path::{Path, PathBuf};
use tiface_base::{Error, Quiet, Result, io};
use tiface_surface::CutReport;
use tiface_surface::files::ExportedFiles;

/// Options of `tiface export`.
#[derive(Args, Debug)]
pub(super) struct ExportOptions {
    /// Run, or .glb, .gltf, .obj, .ply or .stl file [default: the run in this folder, else the
    /// newest under runs/]
    #[arg(value_name = "RUN|MESH")]
    path: Option<PathBuf>,
    /// Formats to write: glb, obj, ply, usdz [default: as --out ends, else glb]
    #[arg(long, value_name = "LIST", value_delimiter = ',')]
    #[arg(value_parser = PossibleValuesParser::new(MeshFormat::ALL.map(MeshFormat::as_str))
        .try_map(|word| word.parse::<MeshFormat>()))]
    format: Vec<MeshFormat>,
    /// Material of GLB and USDZ: unlit (colors as photographed) or lit (shaded by lamps)
    /// [default: unlit; lit with a normal map]
    #[arg(long, value_name = "KIND")]
    #[arg(value_parser = PossibleValuesParser::new(["unlit", "lit"]).map(|word| material(&word)))]
    material: Option<Material>,
    /// Coordinate frame: dataset, or head (+Y up, face towards +Z, centered)
    #[arg(long, value_name = "FRAME", default_value = "dataset")]
    #[arg(value_parser = PossibleValuesParser::new(["dataset", "head"]).map(|word| frame(&word)))]
    frame: MeshFrame,
    /// Height of the head from chin to crown in GLB, OBJ and USDZ files, meters; shoulders follow
    /// [default: as long as `capture.unit_m` says]
    #[arg(long, value_name = "METERS", value_parser = length, conflicts_with = "measure")]
    height: Option<f64>,
    /// Scale GLB, OBJ and USDZ files by the distance of two points, meters; points are x,y,z in
    /// the dataset's world, the coordinates of .ply
    #[arg(long, num_args = 3, value_names = ["A", "B", "METERS"], allow_hyphen_values = true)]
    measure: Vec<String>,
    /// Up axis of a mesh file: x, -x, y, -y, z or -z [default: y]
    #[arg(long, value_name = "AXIS", allow_hyphen_values = true)]
    #[arg(value_parser = PossibleValuesParser::new(AXES).map(|word| axis(&word)))]
    up: Option<Vec3>,
    /// Unit of OBJ, which states none: m, cm or mm
    #[arg(long, value_name = "UNIT", default_value = "m")]
    #[arg(value_parser = PossibleValuesParser::new(["m", "cm", "mm"]).map(|word| meters(&word)))]
    unit: f64,
    /// Where the head ends: none (as in the run), chin (below it, rising to the nape) or collar (at
    /// the neck's base, above the shoulders); the cut is closed
    #[arg(long, value_name = "WHERE", default_value = "none")]
    #[arg(value_parser = PossibleValuesParser::new(["none", "chin", "collar"]).map(|word| cut(&word)))]
    cut: Cut,
    /// Write N levels of detail, each with half the triangles of the one before, as NAME_lod1 and
    /// so on
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u8).range(1..=12))]
    lod: u8,
    /// Number of triangles at most, before a cut; up to all of the extracted surface [default: as
    /// in the run]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(4..))]
    triangles: Option<u32>,
    /// Side of the texture, texels; 0 stores colors at the vertices [default: the run's]
    #[arg(long, value_name = "PX", value_parser = clap::value_parser!(u32).range(0..=16384))]
    texture: Option<u32>,
    /// Store the color as JPEG, which is smaller and lossy
    #[arg(long)]
    jpeg: bool,
    /// Compress a GLB (EXT_meshopt_compression), with the color as JPEG; not every program reads it
    #[arg(long)]
    compress: bool,
    /// Leave out the soft layers of hair
    #[arg(long)]
    no_layers: bool,
    /// Leave out view-dependent color
    #[arg(long)]
    no_lobes: bool,
    /// Leave out the normal map
    #[arg(long)]
    no_normal_map: bool,
}

fn material(word: &str) -> Material {
    if word == "lit" { Material::Lit } else { Material::Unlit }
}

fn cut(word: &str) -> Cut {
    match word {
        "chin" => Cut::Chin,
        "collar" => Cut::Collar,
        _ => Cut::None,
    }
}

fn frame(word: &str) -> MeshFrame {
    if word == "head" { MeshFrame::Head } else { MeshFrame::Dataset }
}

fn meters(unit: &str) -> f64 {
    match unit {
        "mm" => 1e-3,
        "cm" => 1e-2,
        _ => 1.0,
    }
}

/// Parses a length in meters.
fn length(word: &str) -> std::result::Result<f64, String> {
    let found = word.parse().ok().filter(|meters: &f64| meters.is_finite() && *meters > 0.0);
    found.ok_or_else(|| "it must be a number of meters above 0".into())
}

/// Parses a point `x,y,z`.
fn point(word: &str) -> Result<DVec3> {
    let numbers: Option<Vec<f64>> = word.split(',').map(|number| number.trim().parse().ok()).collect();
    match numbers.as_deref() {
        Some(&[x, y, z]) if [x, y, z].iter().all(|v| v.is_finite()) => Ok(DVec3::new(x, y, z)),
        _ => {
            let text = format!("`--measure`: `{word}` is no point");
            Err(Error::usage(text, "write it as x,y,z: `--measure 0.01,0.2,0.03 0.07,0.2,0.03 0.06`"))
        }
    }
}

/// A file to write.
struct Target {
    file: PathBuf,
    format: MeshFormat,
    /// Its level of detail; the first is 0.
    level: usize,
}

impl Target {
    /// Returns whether the file is one that the stage `mesh` of the run writes.
    fn is_own(&self, run: &Path) -> bool {
        let folder = self.file.parent().and_then(|folder| io::real_path(folder).ok());
        let is_there =
            folder.is_some_and(|folder| io::real_path(&run.join(Stage::Mesh)).is_ok_and(|own| own == folder));
        let name = format!("head.{}", self.format.as_str());
        self.level == 0 && is_there && self.file.file_name().is_some_and(|found| found == name.as_str())
    }
}

impl ExportOptions {
    /// Returns what is asked for, in these formats.
    fn request(&self, formats: Vec<MeshFormat>) -> Result<ExportRequest> {
        Ok(ExportRequest {
            formats,
            material: self.material,
            frame: self.frame,
            jpeg: self.jpeg,
            compress: self.compress,
            obj_unit_m: self.unit,
            size: self.size()?,
            cut: self.cut,
            triangles: self.triangles,
            levels: self.lod.into(),
            texture_px: self.texture,
            layers: !self.no_layers,
            lobes: !self.no_lobes,
            normal_map: !self.no_normal_map,
        })
    }

    fn size(&self) -> Result<Size> {
        match (self.height, self.measure.as_slice()) {
            (Some(meters), _) => Ok(Size::Head(meters)),
            (None, [a, b, meters]) => {
                let meters = length(meters).map_err(|e| {
                    Error::usage(format!("`--measure`: `{meters}`: {e}"), "write it as 0.064")
                })?;
                Ok(Size::Between([point(a)?, point(b)?], meters))
            }
            _ => Ok(Size::Dataset),
        }
    }

    /// Returns the run or the file that is named, and its head.
    fn read(&self, invocation: &Invocation) -> Result<(PathBuf, KeptHead)> {
        if let Some(file) = self.path.as_deref().filter(|path| io::is_file(path)) {
            return Ok((file.into(), KeptHead::open(file, self.up.unwrap_or(Vec3::Y))?));
        }
        no_up(self.up)?;
        let target = RunTarget::find(invocation.common, self.path.as_deref())?;
        let Some(saved) = &target.saved else {
            let what = format!("`{}` is not a run", self.path.as_deref().unwrap_or(&target.run).display());
            return Err(Error::usage(what, "name the folder of a run, or a mesh file"));
        };
        if target.guessed {
            invocation.screen.note("run", &format!("using `{}`", target.run.display()));
        }
        let head = KeptHead::read(&target.run, &Config::read(saved)?)?;
        Ok((target.run, head))
    }

    /// Returns all files to write: each destination, and its smaller levels of detail beside it.
    fn targets(&self, out: Option<&Out>, source: &Path) -> Result<Vec<Target>> {
        let levels = |(file, format): (PathBuf, MeshFormat)| {
            let stem = file.file_stem().map_or("head".into(), |stem| stem.to_string_lossy().into_owned());
            let smaller = (1..usize::from(self.lod)).map({
                let file = file.clone();
                move |level| Target {
                    file: file.with_file_name(format!("{stem}_lod{level}.{}", format.as_str())),
                    format,
                    level,
                }
            });
            std::iter::once(Target { file, format, level: 0 }).chain(smaller)
        };
        Ok(self.destinations(out, source)?.into_iter().flat_map(levels).collect())
    }

    /// Returns the destinations with their formats: `--out`, files in its folder, or else files
    /// in the working directory with the name of the run or the mesh file.
    fn destinations(&self, out: Option<&Out>, source: &Path) -> Result<Vec<(PathBuf, MeshFormat)>> {
        let all = MeshFormat::ALL.into_iter().filter(|format| self.format.contains(format));
        let formats = if self.format.is_empty() { vec![MeshFormat::Glb] } else { all.collect() };
        let named = |folder: &Path, stem: &str| {
            let file = |format: &MeshFormat| (folder.join(format!("{stem}.{}", format.as_str())), *format);
            formats.iter().map(file).collect()
        };
        match out {
            Some(Out::File(file, ending)) => {
                let format = ending
                    .parse()
                    .ok()
                    .filter(|format: &MeshFormat| self.format.is_empty() || self.format == [*format]);
                let format = format.ok_or_else(|| {
                    let what =
                        format!("`--out {}` is one .{ending}, and `--format` lists others", file.display());
                    Error::usage(what, "leave out `--format`, or end `--out` in `/` for a folder")
                })?;
                Ok(vec![(file.clone(), format)])
            }
            Some(Out::Folder(folder)) => Ok(named(folder, "head")),
            None => {
                let source = io::real_path(source).unwrap_or_else(|_| source.into());
                // the dots of a run's name are no ending
                let name = if io::is_file(&source) { source.file_stem() } else { source.file_name() };
                Ok(named(Path::new(""), &name.map_or("head".into(), |name| name.to_string_lossy())))
            }
        }
    }
}

/// Writes the head of a run as these options ask for it.
pub(super) fn run(invocation: &Invocation, options: &ExportOptions) -> Result<()> {
    let (common, screen) = (invocation.common, &invocation.screen);
    let out = Out::find(common.out.as_deref(), "export")?;
    let (source, mut head) = options.read(invocation)?;
    let targets = options.targets(out.as_ref(), &source)?;
    // a file of the run may be put back, but not replaced by another
    let (own, others): (Vec<_>, Vec<_>) = targets.iter().partition(|target| target.is_own(&source));
    others.iter().try_for_each(|target| require_apart(&target.file, &source))?;
    let request = options.request(targets.iter().map(|target| target.format).collect())?;
    head = head.changed(&request, &Quiet)?;
    own.iter().try_for_each(|target| head.require_recorded(target.format))?;
    let warn = |warning: &str| screen.note("export: warning", warning);
    std::mem::take(&mut head.warnings).iter().for_each(|w| warn(w));
    let mut exports = Vec::new();
    for Target { file, format, level } in &targets {
        let stem = file.file_stem().and_then(|stem| stem.to_str()).unwrap_or("head");
        let export = head.files(*level, *format, stem)?;
        // what a format cannot represent is said once
        export.warnings.iter().filter(|_| *level == 0).for_each(|w| warn(w));
        require_free(file, &export, &source, &head)?;
        let (shown, triangles) = (file.display(), head.triangles(*level));
        match (common.dry_run, io::exists(file)) {
            (true, false) => screen.note("export", &format!("would write `{shown}`, {triangles} triangles")),
            (true, true) => screen.note("export", &format!("would replace `{shown}`, {triangles} triangles")),
            (false, true) => screen.note("export", &format!("replaces `{shown}`")),
            (false, false) => {}
        }
        exports.push((file, export));
    }
    if common.dry_run {
        return Ok(());
    }
    out.iter().try_for_each(Out::prepare)?;
    let mut written = Vec::new();
    for (file, export) in &exports {
        written.extend(write_files(file, export)?);
    }
    tell(invocation, &source, &head, &written)
}

/// Refuses an export whose further files would replace some that the mesh needs, or that belong to
/// something else: the picture of an OBJ is replaced with the OBJ alone.
fn require_free(file: &Path, export: &ExportedFiles, source: &Path, head: &KeptHead) -> Result<()> {
    let real = |path: &Path| io::real_path(path).unwrap_or_else(|_| path.into());
    for (name, bytes) in export.files.iter().skip(1) {
        let further = file.with_file_name(name);
        // as an export that was killed has left it
        if io::read_bytes(&further, &io::Limits::default()).is_ok_and(|found| found == *bytes) {
            continue;
        }
        let is_read = head.beside.iter().any(|read| real(read) == real(&further));
        if io::exists(&further) && (is_read || !io::exists(file)) {
            let what = if is_read {
                format!("belongs to `{}`", source.display())
            } else {
                "is there already".into()
            };
            let text = format!("`{}` {what}, and the export would replace it", further.display());
            return Err(Error::usage(text, "choose another name or folder with `--out`"));
        }
    }
    Ok(())
}

/// Prints what was written, how large it is on the disk and in the world, and of how many
/// triangles.
fn tell(invocation: &Invocation, source: &Path, head: &KeptHead, written: &[PathBuf]) -> Result<()> {
    let is_glb = |file: &PathBuf| file.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("glb"));
    let of_layers = if written.iter().any(is_glb) { head.layer_triangles() } else { 0 };
    let triangles = head.triangles(0);
    let ([x, y, z], chin_to_crown, cut) = (head.size_m()?, head.head_height_m(), head.cut_m());
    let levels: Vec<(usize, [f64; 2])> = (1..)
        .zip(head.level_distances_m())
        .map(|(level, m)| (head.triangles(level), m.map(|m| 1e3 * m)))
        .collect();
    if invocation.common.json {
        let level = |(triangles, [largest, mean]): &(usize, [f64; 2])| json!({"triangles": triangles, "largest_mm": largest, "mean_mm": mean});
        let cut = cut.map(|CutReport { moved, dropped, loops, face_triangles }| {
            json!({
                "face_triangles": face_triangles,
                "face_loops": loops,
                "dropped_pieces": dropped,
                "moved_mm": 1e3 * moved,
            })
        });
        let result = json!({
            "event": "result",
            "source": source,
            "out": written,
            "bytes": written.iter().map(|file| io::file_size(file)).collect::<Vec<_>>(),
            "triangles": triangles,
            "layer_triangles": of_layers,
            "cut": cut,
            "levels": levels.iter().map(level).collect::<Vec<_>>(),
            "size_m": [x, y, z],
            "head_m": chin_to_crown,
        });
        return print(&format!("{result}\n"));
    }
    if invocation.common.quiet {
        return Ok(());
    }
    let file = |file: &PathBuf| {
        let size = io::file_size(file).map(|bytes| format!("  {:.2} MB", bytes as f64 / 1e6));
        format!("export    {}{}\n", file.display(), size.unwrap_or_default())
    };
    let mut text: String = written.iter().map(file).collect();
    let layers = if of_layers > 0 { format!(", and {of_layers} of soft layers") } else { String::new() };
    let face = cut.map(|cut| format!(", {} of which close the cut", cut.face_triangles));
    text += &format!("export    {triangles} triangles{}{layers}\n", face.unwrap_or_default());
    for (triangles, [largest, mean]) in levels {
        text += &format!(
            "export    {triangles} triangles, up to {largest:.2} mm from these, {mean:.2} mm on average\n"
        );
    }
    text += &format!("export    {x:.3} x {y:.3} x {z:.3} m");
    // measured before the head is simplified and cut: afterwards its chin may not be found
    let height =
        chin_to_crown.map(|meters| format!("; {meters:.3} m from chin to crown in the run's own mesh"));
    text += &format!("{}\n", height.unwrap_or_default());
    print(&text)
}

/// Refuses a file inside the run, or that is the mesh file itself.
fn require_apart(file: &Path, source: &Path) -> Result<()> {
    if !io::is_file(source) {
        return require_outside(file, source);
    }
    match (io::real_path(file), io::real_path(source)) {
        (Ok(file), Ok(source)) if file == source => Err(Error::usage(
            format!("`{}` is the file that is read", source.display()),
            "choose another name with `--out`",
        )),
        _ => Ok(()),
    }
}
