//! The command line: one file per command, named as it is typed. The only module that prints.
//!
//! Data goes to stdout, everything else to stderr; the exit code says whether to try again
//! ([`crate::ErrorKind`]).

use crate::{Error, Result};
mod check;
mod completions;
mod config;
mod demo;
mod inspect;
mod line;
mod options;
mod out;
mod page;
mod plain;
mod screen;
mod signals;
mod status;
mod stdout;
mod target;

use crate::pipeline::Stage;
use crate::run::Stop;
use clap::{Args, CommandFactory, Parser, Subcommand};
use options::Common;
use out::Out;
use screen::Screen;
use std::path::PathBuf;
use std::process::ExitCode;

const EXAMPLES: &str = "\
Examples:
  tiface demo                                   a head made on the spot, from pictures to mesh
  tiface inspect captures/002_00                what is in a folder of photographs, and what is wrong
  tiface run captures/002_00 --preset draft     a first look at your own head, into runs/002_00
  tiface mesh --format glb,ply --out head.glb   the mesh of the newest run, once more, as a file

Exit codes:
  0         done
  1         cannot be done as asked
  2         wrong command line or configuration
  3         below a bar you set
  75        not now, try again
  101       a bug
  130, 143  stopped: repeat to continue";

/// Photographs of a human head, taken by calibrated cameras, become a watertight mesh and novel views.
#[derive(Parser, Debug)]
#[command(name = "tiface", version, max_term_width = 100, after_long_help = EXAMPLES)]
struct Cli {
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    common: Common,
}

/// What a stage command works on.
#[derive(Args, Debug)]
struct Place {
    /// A capture (a folder of photographs with cameras) or a run; without one, the run in this
    /// folder, else the newest under runs/
    #[arg(value_name = "CAPTURE|RUN")]
    path: Option<PathBuf>,
}

/// Masks from clicks.
#[derive(Args, Debug, Default)]
struct Clicks {
    /// Make masks from the clicks in this prompts.json
    #[arg(long, alias = "points", value_name = "FILE")]
    prompts: Option<PathBuf>,
    /// A click on one photograph, label 1 for the head, 0 for what is not; repeatable
    #[arg(long, value_name = "X,Y,LABEL", conflicts_with = "prompts", allow_hyphen_values = true)]
    point: Vec<String>,
    /// The view that --point is on [default: the first that is trained on]
    #[arg(long, value_name = "NAME", requires = "point")]
    view: Option<String>,
    /// SAM's image encoder, ONNX; needs --sam-decoder
    #[arg(long, value_name = "FILE")]
    sam: Option<PathBuf>,
    /// SAM's prompt encoder and mask decoder, ONNX
    #[arg(long, value_name = "FILE")]
    sam_decoder: Option<PathBuf>,
    /// ViTMatte, ONNX
    #[arg(long, value_name = "FILE")]
    vitmatte: Option<PathBuf>,
    /// An ONNX Runtime library to run them with, instead of the built-in engine
    #[arg(long, value_name = "FILE")]
    onnxruntime: Option<PathBuf>,
}

impl Clicks {
    /// As keys of the configuration; files by their absolute path, so that the run remembers them from anywhere.
    fn keys(&self) -> Result<Vec<(String, String, String)>> {
        let mut keys = Vec::new();
        let files = [
            ("--prompts", "mask.prompts", &self.prompts),
            ("--sam", "mask.sam", &self.sam),
            ("--sam-decoder", "mask.sam_decoder", &self.sam_decoder),
            ("--vitmatte", "mask.vitmatte", &self.vitmatte),
            ("--onnxruntime", "mask.onnxruntime", &self.onnxruntime),
        ];
        for (option, key, file) in files {
            let Some(file) = file else { continue };
            let path = crate::io::real_path(file)?;
            let text = path.to_str().ok_or_else(|| {
                Error::cannot(format!("the path `{}` is not UTF-8", path.display()), "rename the file")
            })?;
            keys.push((format!("{option} {}", file.display()), key.into(), text.into()));
        }
        if !self.point.is_empty() {
            let list = serde_json::json!(self.point).to_string();
            keys.push((format!("--point {}", self.point.join(" --point ")), "mask.point".into(), list));
        }
        if let Some(view) = &self.view {
            keys.push((format!("--view {view}"), "mask.view".into(), view.clone()));
        }
        Ok(keys)
    }
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Every stage in order, going on where the last command stopped
    #[command(after_long_help = "Examples:
  tiface run captures/002_00
  tiface run captures/002_00 --run /data/002_00 --preset paper --seed 7
  tiface run captures/002_00 --prompts prompts.json  masks from clicks on a few photographs
  tiface run runs/002_00 --fresh mesh --set mesh.resolution=1024
  tiface run captures/002_00 --require psnr=28      exit code 3 if the views are worse than that")]
    Run {
        #[command(flatten)]
        place: Place,
        #[command(flatten)]
        clicks: Clicks,
        /// Exit with 3 below this bar: watertight, psnr=DB (masked, the best of all); repeatable
        #[arg(long, value_name = "BAR")]
        require: Vec<String>,
    },
    /// The same on a synthetic head made on the spot: no data, weights or network needed
    #[command(after_long_help = "Examples:
  tiface demo
  tiface demo --set iface.steps=500 --set tface.steps=500    a rougher head, sooner
  tiface demo --run /tmp/demo --out head.glb    somewhere else, and the mesh beside it")]
    Demo,
    /// What was found: format, cameras, masks, splits, problems; writes nothing
    #[command(after_long_help = "Examples:
  tiface inspect captures/002_00
  tiface inspect captures/002_00 --set capture.mask_dir=vit_mask
  tiface inspect captures/002_00 --json | jq .problems")]
    Inspect {
        /// A folder of photographs with cameras
        capture: PathBuf,
    },
    /// Stage: which pixels are the head, and where that puts it
    #[command(after_long_help = "Examples:
  tiface mask captures/002_00                   the masks that lie there; a sheet of them in the run's mask/
  tiface mask captures/002_00 --page            an annotation page, which saves prompts.json
  tiface mask captures/002_00 --prompts prompts.json
  tiface mask captures/002_00 --view 010 --point 181,288,1 --point 32,51,0
  tiface mask captures/002_00 --prompts prompts.json --sam encoder.onnx --sam-decoder decoder.onnx \\
      --vitmatte vitmatte.onnx

Click the face, the hair and every garment of another colour, and the background twice; on three photographs
from different sides. The other views follow from the cameras.")]
    Mask {
        #[command(flatten)]
        place: Place,
        #[command(flatten)]
        clicks: Clicks,
        /// Write an annotation page to click on instead, to --out or <capture>_clicks.html
        #[arg(long, conflicts_with_all = ["point", "sam", "sam_decoder", "vitmatte", "onnxruntime"])]
        page: bool,
    },
    /// Stage: learn T-Face, a radiance field, from the masked photographs
    #[command(after_long_help = "Examples:
  tiface tface captures/002_00
  tiface tface runs/002_00                      go on after a stop
  tiface tface captures/002_00 --run runs/ce --set tface.mask_loss=ce
  tiface tface captures/002_00 --set tface.fields=3    the mean of three fields
  tiface tface captures/002_00 --set tface.import=official.th")]
    Tface {
        #[command(flatten)]
        place: Place,
    },
    /// Stage: learn one such field from whole photographs, to compare T-Face with
    #[command(after_long_help = "Examples:
  tiface baseline captures/002_00
  tiface baseline runs/002_00                   go on after a stop
  tiface baseline runs/002_00 --fresh baseline --set baseline.steps=20000")]
    Baseline {
        #[command(flatten)]
        place: Place,
    },
    /// Stage: learn I-Face, a signed-distance field
    #[command(after_long_help = "Examples:
  tiface iface captures/002_00
  tiface iface runs/002_00                      go on after a stop
  tiface iface runs/002_00 --fresh iface --set iface.steps=30000")]
    Iface {
        #[command(flatten)]
        place: Place,
    },
    /// Stage: extract the watertight mesh, simplify it, bake its texture
    #[command(after_long_help = "Examples:
  tiface mesh runs/002_00
  tiface mesh runs/002_00 --out head.glb        the ending picks the format
  tiface mesh runs/002_00 --fresh mesh --format glb,obj,ply --frame head
  tiface mesh runs/002_00 --fresh mesh --triangles 20000 --texture 4096 --lobes 1 --normal-map")]
    Mesh {
        #[command(flatten)]
        place: Place,
        /// Files to write: glb, obj, ply
        #[arg(long, value_name = "LIST")]
        format: Option<String>,
        /// Coordinates: dataset, or head (+Y up, face towards +Z)
        #[arg(long, value_name = "FRAME")]
        frame: Option<String>,
        /// Triangles of the product; 0 keeps all
        #[arg(long, value_name = "N")]
        triangles: Option<String>,
        /// Texels along each side of the texture; 0: colours at the vertices
        #[arg(long, value_name = "PX")]
        texture: Option<String>,
        /// Degree of view-dependent colour in the GLB: 0, 1 or 2
        #[arg(long, value_name = "DEGREE")]
        lobes: Option<String>,
        /// Put the detail that simplification takes into a normal map; the GLB's material is lit then
        #[arg(long)]
        normal_map: bool,
        /// Leave the surface open where the frames cut the body
        #[arg(long)]
        no_cap: bool,
    },
    /// Stage: make views of the fields and of the mesh
    #[command(after_long_help = "Examples:
  tiface render runs/002_00
  tiface render captures/002_00 --with tface    T-Face alone: no other field is learned for it
  tiface render runs/002_00 --cameras orbit --with tface --background white --out turn/
  tiface render runs/002_00 --cameras path.json --format exr

Views of other cameras than the held-out ones lie in render/paths/, one folder for each path. They leave
the held-out views, their blend and the metrics alone; --fresh render then makes only that path anew.")]
    Render {
        #[command(flatten)]
        place: Place,
        /// test (the held-out views); train, orbit or a file (a nerfstudio camera path or a
        /// transforms.json), into a folder of their own
        #[arg(long, value_name = "WHICH")]
        cameras: Option<String>,
        /// Any of baseline, tface, volume (I-Face), raycast (I-Face's mesh) and textured
        /// (head.glb, as a viewer shows it), with commas
        #[arg(long = "with", value_name = "LIST")]
        method: Option<String>,
        /// png or exr
        #[arg(long)]
        format: Option<String>,
        /// black, white or none
        #[arg(long)]
        background: Option<String>,
    },
    /// Stage: blend the views of T-Face and I-Face, or of others
    #[command(after_long_help = "Examples:
  tiface ensemble runs/002_00
  tiface ensemble runs/002_00 --fresh ensemble --members tface,volume --weights 0.6,0.4
  tiface ensemble captures/002_00 --members tface,raycast

Without --weights, they are fitted on small squares of the training photographs that no field
learned from (capture.tiles): the blend follows the better member.")]
    Ensemble {
        #[command(flatten)]
        place: Place,
        /// Whose views: baseline, tface, volume (I-Face), raycast (I-Face's mesh), textured (head.glb)
        #[arg(long, value_name = "LIST")]
        members: Option<String>,
        /// Their shares, in that order, together 1 [default: fitted]
        #[arg(long, value_name = "LIST")]
        weights: Option<String>,
    },
    /// Stage: compare views and blends with held-out photographs
    Metrics {
        #[command(flatten)]
        place: Place,
        /// Exit with 3 below this bar: watertight, psnr=DB (masked, the best of all); repeatable
        #[arg(long, value_name = "BAR")]
        require: Vec<String>,
    },
    /// Is this mesh sound: watertight, manifold, self-intersections, texture coordinates, size
    #[command(after_long_help = "Examples:
  tiface check head.glb
  tiface check scan.obj --require watertight --require one-piece
  tiface check head.ply --json
  tiface check runs/lps/mesh/surface.ply --against captures/lps/gt.ply --seen-by captures/lps")]
    Check {
        /// A .glb, .obj or .ply file
        mesh: PathBuf,
        /// Exit with 3 if it is not: watertight, manifold, one-piece, no-self-intersections, sound-uv;
        /// repeatable
        #[arg(long, value_name = "BAR")]
        require: Vec<String>,
        /// Also the distance to this surface, in the same coordinates (so a PLY: a GLB is turned +Y up)
        #[arg(long, value_name = "MESH")]
        against: Option<PathBuf>,
        /// ... and the distance over the part that three or more of this capture's training cameras see
        #[arg(long, value_name = "CAPTURE", requires = "against")]
        seen_by: Option<PathBuf>,
    },
    /// Stages, progress, time left and last error of one or many runs
    #[command(after_long_help = "Examples:
  tiface status
  tiface status runs/002_00
  tiface status runs/* --json")]
    Status {
        /// Run folders; without any, all under runs/
        runs: Vec<PathBuf>,
    },
    /// Print the effective configuration, or explain a key
    #[command(after_long_help = "Examples:
  tiface config --preset paper
  tiface config runs/002_00 --set mesh.resolution=1024
  tiface config --explain iface.steps           a whole table: --explain mesh")]
    Config {
        #[command(flatten)]
        place: Place,
        /// Say what a key or a table means, its range and its value in every preset
        #[arg(long, value_name = "KEY")]
        explain: Option<String>,
    },
    /// Completions for a shell, on stdout
    Completions {
        /// bash, zsh, fish, powershell or elvish
        shell: clap_complete::Shell,
    },
}

/// Parses the command line, does what it says, and gives the exit code.
pub fn main() -> ExitCode {
    let cli = match Cli::try_parse() {
        Ok(cli) => cli,
        Err(e) => {
            // help and version end here too, with 0; a closed stdout is no error
            let _ = e.print();
            return ExitCode::from(e.exit_code() as u8);
        }
    };
    let screen = Screen::new(&cli.common);
    cli.common.log();
    let stop = Stop::new();
    let ended = signals::listen(&stop, &screen).and_then(|()| cli.run(&screen, &stop));
    ExitCode::from(match ended {
        Ok(()) => 0,
        Err(error) => {
            screen.error(&error);
            error.kind().code()
        }
    })
}

impl Cli {
    fn run(&self, screen: &Screen, stop: &Stop) -> Result<()> {
        let common = &self.common;
        // options of one command are keys of the configuration under a shorter name
        let keys = |pairs: &[(&str, &str, &Option<String>)]| -> Vec<(String, String, String)> {
            let given = pairs.iter().filter_map(|(option, key, value)| {
                value.as_ref().map(|v| (format!("{option} {v}"), key.to_string(), v.clone()))
            });
            given.collect()
        };
        let works = |place: &Place, product: &str, until: Stage, require: &[String], extra: &[_]| {
            line::go(common, place.path.as_deref(), product, until, require, extra, screen, stop)
        };
        let line = |place: &Place, stage: Stage, extra: &[_]| works(place, stage.word(), stage, &[], extra);
        let nothing = |command: &str| Out::none(common.out.as_deref(), command);
        match &self.command {
            Command::Run { place, clicks, require } => {
                works(place, "run", Stage::Metrics, require, &clicks.keys()?)
            }
            Command::Demo => demo::go(common, screen, stop),
            Command::Inspect { capture } => nothing("inspect").and_then(|()| inspect::go(common, capture)),
            Command::Mask { place, clicks, page: true } => {
                page::go(common, place.path.as_deref(), clicks.prompts.as_deref(), screen)
            }
            Command::Mask { place, clicks, page: false } => line(place, Stage::Mask, &clicks.keys()?),
            Command::Baseline { place } => line(place, Stage::Baseline, &[]),
            Command::Tface { place } => line(place, Stage::Tface, &[]),
            Command::Iface { place } => line(place, Stage::Iface, &[]),
            Command::Mesh { place, format, frame, triangles, texture, lobes, normal_map, no_cap } => {
                let given = |flag: bool, value: &str| flag.then(|| value.to_owned());
                let extra = keys(&[
                    ("--format", "mesh.format", format),
                    ("--frame", "mesh.frame", frame),
                    ("--triangles", "mesh.triangles", triangles),
                    ("--texture", "mesh.texture_px", texture),
                    ("--lobes", "mesh.lobes", lobes),
                    ("--normal-map", "mesh.normal_map", &given(*normal_map, "true")),
                    ("--no-cap", "mesh.cap", &given(*no_cap, "false")),
                ]);
                line(place, Stage::Mesh, &extra)
            }
            Command::Render { place, cameras, method, format, background } => {
                let extra = keys(&[
                    ("--cameras", "render.cameras", cameras),
                    ("--with", "render.method", method),
                    ("--format", "render.format", format),
                    ("--background", "render.background", background),
                ]);
                line(place, Stage::Render, &extra)
            }
            Command::Ensemble { place, members, weights } => {
                let extra = keys(&[
                    ("--members", "ensemble.members", members),
                    ("--weights", "ensemble.weights", weights),
                ]);
                line(place, Stage::Ensemble, &extra)
            }
            Command::Metrics { place, require } => works(place, "metrics", Stage::Metrics, require, &[]),
            Command::Check { mesh, require, against, seen_by } => {
                nothing("check")?;
                check::go(common, mesh, require, against.as_deref(), seen_by.as_deref())
            }
            Command::Status { runs } => nothing("status").and_then(|()| status::go(common, runs)),
            Command::Config { place, explain } => {
                nothing("config")?;
                config::go(common, place.path.as_deref(), explain.as_deref())
            }
            Command::Completions { shell } => {
                nothing("completions").and_then(|()| completions::go(*shell, &mut Cli::command()))
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Cli::command().debug_assert();
    }

    #[test]
    fn options_may_stand_before_and_after_paths() {
        for words in [
            ["tiface", "--seed", "7", "run", "captures/a"],
            ["tiface", "run", "--seed", "7", "captures/a"],
            ["tiface", "run", "captures/a", "--seed", "7"],
        ] {
            let cli = Cli::try_parse_from(words).unwrap();
            assert_eq!(cli.common.seed, Some(7));
            assert!(matches!(cli.command, Command::Run { place, .. } if place.path.is_some()));
        }
    }

    #[test]
    fn every_exit_code_has_a_line_of_its_own_on_any_terminal() {
        let (_, codes) = EXAMPLES.split_once("Exit codes:\n").unwrap();
        assert_eq!(codes.lines().count(), 7);
        for columns in [50, 60, 80, 100, 200] {
            let help = Cli::command().term_width(columns).render_long_help().to_string();
            for row in codes.lines() {
                assert!(help.lines().any(|l| l == row), "{columns} columns break `{row}`:\n{help}");
            }
        }
    }

    #[test]
    fn short_help_fits_one_screen() {
        let help = Cli::command().render_help().to_string();
        assert!(help.lines().count() <= 50, "{} lines", help.lines().count());
    }

    #[test]
    fn every_command_with_something_to_choose_shows_worked_examples() {
        for command in Cli::command().get_subcommands() {
            let shown = command.get_after_long_help().map(|h| h.to_string()).unwrap_or_default();
            let plain = ["metrics", "completions"].contains(&command.get_name());
            assert!(plain || shown.matches("tiface ").count() >= 3, "{}", command.get_name());
        }
    }
}
