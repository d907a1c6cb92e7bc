//! The words of the command line: commands, what each takes, and their help.

use super::bench::BenchOptions;
use super::cameras::CamerasOptions;
use super::complete;
use super::experiment::ExperimentOptions;
use super::export::ExportOptions;
use super::flags::KeyFlags;
use super::options::Common;
use super::preview::PreviewOptions;
use super::run::StageCommand;
use super::status::StatusOptions;
use super::target::RunTarget;
use crate::config::key;
use crate::pipeline::Stage;
use clap::{Args, Parser, Subcommand};
use clap_complete::{ArgValueCompleter, Shell};
use std::path::PathBuf;
use tiface_base::Result;

const EXAMPLES: &str = "\
Examples:
  tiface demo                                   reconstruct a synthetic head, from photographs to mesh
  tiface inspect captures/002_00                list what is in a folder of photographs, and what is wrong
  tiface run captures/002_00 --preset draft     reconstruct your own head quickly, into runs/002_00
  tiface export --out head.usdz                 write the head of the newest run to a file

Exit codes:
  0         success
  1         failure
  2         wrong command line or configuration
  3         required quality not met
  75        temporary failure: try again
  101       a bug
  130, 143  stopped: repeat to continue";

/// Reconstruct a human head from photographs by calibrated cameras: a watertight mesh and novel
/// views.
#[derive(Parser, Debug)]
#[command(name = "tiface", version, max_term_width = 100, after_long_help = EXAMPLES)]
pub(super) struct Cli {
    #[command(subcommand)]
    pub command: Command,
    #[command(flatten)]
    pub common: Common,
}

/// Options for making masks, of which the page that asks for clicks has no use.
const NOT_WITH_PAGE: [&str; 5] =
    [key!(mask.point), key!(mask.sam), key!(mask.sam_decoder), key!(mask.vitmatte), key!(mask.alpha_net)];

/// Capture or run of a stage command.
#[derive(Args, Debug)]
pub(super) struct CaptureOrRun {
    /// Capture (a folder of photographs with cameras) or run [default: the run in this folder, else
    /// the newest under runs/]
    #[arg(value_name = "CAPTURE|RUN")]
    pub path: Option<PathBuf>,
}

/// A command and what it takes.
#[derive(Subcommand, Debug)]
pub(super) enum Command {
    /// Run all stages, continuing where the last command stopped
    #[command(after_long_help = "Examples:
  tiface run captures/002_00
  tiface run captures/002_00 --run /data/002_00 --preset paper --seed 7
  tiface run captures/002_00 --prompts prompts.json  make masks from clicks on a few photographs
  tiface run runs/002_00 --fresh mesh --set mesh.resolution=1024
  tiface run captures/002_00 --require psnr=28      exit with 3 if the PSNR is lower")]
    Run {
        #[command(flatten)]
        input: CaptureOrRun,
        #[command(flatten)]
        flags: KeyFlags,
        /// Exit with 3 if not met: watertight, psnr=DB (masked PSNR of the best method); repeatable
        #[arg(long, value_name = "BAR")]
        require: Vec<String>,
    },
    /// Run all stages on a synthetic head; needs no data
    #[command(after_long_help = "Examples:
  tiface demo
  tiface demo --set iface.steps=500 --set tface.steps=500    train for fewer steps
  tiface demo --run /tmp/demo --out head.glb    choose the run folder, and copy the mesh
  tiface demo --size 3000x4096 --views 24 --border 60 --run /tmp/full    use the size of the ILSH dataset")]
    Demo {
        /// Size of each photograph, pixels [default: 256x320]
        #[arg(long, value_name = "WxH")]
        size: Option<String>,
        /// Number of photographs, a quarter of them held out [default: 32]
        #[arg(long, value_name = "N")]
        views: Option<usize>,
        /// Width of the border to mark as invalid, pixels [default: none]
        #[arg(long, value_name = "PX")]
        border: Option<u32>,
    },
    /// Check a capture: format, cameras, masks, splits, problems; writes nothing
    #[command(after_long_help = "Examples:
  tiface inspect captures/002_00
  tiface inspect captures/002_00 --set capture.mask_dir=vit_mask
  tiface inspect captures/002_00 --json | jq .problems")]
    Inspect {
        /// Folder of photographs with cameras, or a run, whose capture is checked
        #[arg(value_name = "CAPTURE|RUN")]
        capture: PathBuf,
    },
    /// Find the cameras of photographs that have none, with COLMAP, which must be installed
    #[command(after_long_help = "Examples:
  tiface cameras photographs --out captures/002_00
  tiface cameras --video turn.mp4 --every 15    keep the sharpest of every 15 frames
  tiface cameras rig --lens-each                calibrate a lens for each photograph

The new folder [default: PHOTOGRAPHS_cameras, or HEAD_cameras for HEAD/images] has a copy of the photographs in
images/, COLMAP's model in sparse/0 and its log in colmap/tiface_cameras.log. If the folder has head masks, features
are searched inside them; --set mask.source=none uses whole photographs. A search that failed is repeated in its
folder; one that is done is not.")]
    Cameras(CamerasOptions),
    /// Write a capture's cameras in another format: transforms.json or COLMAP
    #[command(after_long_help = "Examples:
  tiface convert captures/002_00 --to colmap
  tiface convert captures/002_00 --to transforms --set capture.mask_dir=vit_mask    name the masks to copy
  tiface convert scan --to transforms --out captures/scan

Photographs and masks are copied unchanged. The output folder must not exist, or be empty.")]
    Convert {
        /// Folder of photographs with cameras
        capture: PathBuf,
        /// Format to write: transforms or colmap
        #[arg(long, value_name = "FORMAT")]
        to: String,
    },
    /// Stage: make or read head masks, and find the head's bounding box
    #[command(after_long_help = "Examples:
  tiface mask captures/002_00                   read the capture's masks; write a sheet of them to the run's mask/
  tiface mask captures/002_00 --page            write a page to click on, which saves prompts.json
  tiface mask captures/002_00 --prompts prompts.json
  tiface mask captures/002_00 --view 010 --point 181,288,1 --point 32,51,0
  tiface mask captures/002_00 --prompts prompts.json --sam encoder.onnx --sam-decoder decoder.onnx \\
      --vitmatte vitmatte.onnx
  tiface mask captures/002_00 --alpha-net isnet.onnx    make masks without clicks

On three photographs from different sides, click the face, the hair, every garment of another color, and the
background twice. The masks of the other views follow from the cameras.")]
    Mask {
        #[command(flatten)]
        input: CaptureOrRun,
        #[command(flatten)]
        flags: KeyFlags,
        /// Write a page to click on instead, to --out or <capture>_clicks.html
        #[arg(long, conflicts_with_all = NOT_WITH_PAGE)]
        page: bool,
    },
    /// Stage: train T-Face, a radiance field of the masked photographs
    #[command(after_long_help = "Examples:
  tiface tface captures/002_00
  tiface tface runs/002_00                      continue after a stop
  tiface tface captures/002_00 --run runs/ce --set tface.mask_loss=ce
  tiface tface captures/002_00 --set tface.fields=3    average three fields
  tiface tface captures/002_00 --set tface.import=official.safetensors")]
    Tface(CaptureOrRun),
    /// Stage: train the same field on whole photographs, as a baseline for T-Face
    #[command(after_long_help = "Examples:
  tiface baseline captures/002_00
  tiface baseline runs/002_00                   continue after a stop
  tiface baseline runs/002_00 --fresh baseline --set baseline.steps=20000")]
    Baseline(CaptureOrRun),
    /// Stage: train I-Face, a signed distance field
    #[command(after_long_help = "Examples:
  tiface iface captures/002_00
  tiface iface runs/002_00                      continue after a stop
  tiface iface runs/002_00 --fresh iface --set iface.steps=30000")]
    Iface(CaptureOrRun),
    /// Stage: extract, simplify and texture the watertight mesh
    #[command(after_long_help = "Examples:
  tiface mesh runs/002_00
  tiface mesh runs/002_00 --out head.glb        the ending selects the format
  tiface mesh captures/002_00 --format glb,obj,ply
  tiface mesh runs/002_00 --fresh mesh --triangles 200000 --texture 4096 --lobes 1 --normal-map

`tiface export` writes a finished mesh in another format, material, frame or size, without making it again.")]
    Mesh {
        #[command(flatten)]
        input: CaptureOrRun,
        #[command(flatten)]
        flags: KeyFlags,
    },
    /// Stage: render views of the fields and of the mesh
    #[command(after_long_help = "Examples:
  tiface render runs/002_00
  tiface render captures/002_00 --with tface    render T-Face only, and train nothing else
  tiface render runs/002_00 --cameras orbit --with tface --background white --out turn/
  tiface render runs/002_00 --cameras path.json --format exr

Views of other cameras than the held-out ones are written to render/paths/, one folder for each path. The
held-out views, their blend and the metrics do not change; --fresh render then renders only that path again.")]
    Render {
        #[command(flatten)]
        input: CaptureOrRun,
        #[command(flatten)]
        flags: KeyFlags,
    },
    /// Stage: blend the views of several methods
    #[command(after_long_help = "Examples:
  tiface ensemble runs/002_00
  tiface ensemble runs/002_00 --fresh ensemble --members tface,volume --weights 0.6,0.4
  tiface ensemble captures/002_00 --members tface,raycast

Without --weights, the weights are fitted on small squares of the training photographs that are held out of
all trainings (capture.tiles).")]
    Ensemble {
        #[command(flatten)]
        input: CaptureOrRun,
        #[command(flatten)]
        flags: KeyFlags,
    },
    /// Stage: compare views and blends with held-out photographs
    #[command(after_long_help = "Examples:
  tiface metrics runs/002_00 --require psnr=30
  tiface metrics captures/002_00 --views nerfstudio/renders/ --views brush/    judge other programs' pictures
  tiface metrics captures/002_00 --mesh scan.ply --out judged/                 judge a mesh by its pictures

Pictures are named like the held-out photographs, meshes are in the capture's world. metrics.json, a page and the
pictures of meshes are written to CAPTURE_judged/ or to --out; no run is started or changed.")]
    Metrics {
        #[command(flatten)]
        input: CaptureOrRun,
        /// Judge the pictures that another program made of the capture's held-out views; repeatable
        #[arg(long, value_name = "FOLDER", conflicts_with = "require")]
        views: Vec<PathBuf>,
        /// Judge a .glb, .gltf, .obj, .ply or .stl mesh by pictures from the held-out cameras;
        /// repeatable
        #[arg(long, value_name = "FILE", conflicts_with = "require")]
        mesh: Vec<PathBuf>,
        /// Exit with 3 if not met: watertight, psnr=DB (masked PSNR of the best method); repeatable
        #[arg(long, value_name = "BAR")]
        require: Vec<String>,
    },
    /// Write the finished head of a run, or a mesh file, to files for other programs
    #[command(after_long_help = "Examples:
  tiface export runs/002_00 --out head.obj      the ending selects the format
  tiface export runs/002_00 --out head.usdz     iPhone, iPad, Mac and Safari show it by themselves
  tiface export runs/002_00 --material lit --frame head --out lit.glb
  tiface export runs/002_00 --format glb,ply --triangles 10000 --texture 1024 --out small/
  tiface export runs/002_00 --no-layers --height 0.24       write to 002_00.glb
  tiface export runs/002_00 --measure -0.03,0.1,0.2 0.03,0.1,0.2 0.064 --out head.glb
  tiface export scan.ply --up z --triangles 20000 --out scan.usdz

It takes seconds, opens no photograph, writes nothing into the run and remembers nothing: the same command writes the same
bytes, whatever was exported before. A larger texture needs `tiface mesh RUN --fresh mesh`.")]
    Export(ExportOptions),
    /// Render pictures of a run's mesh, or of any .glb, .gltf, .obj, .ply or .stl
    #[command(after_long_help = "Examples:
  tiface preview runs/002_00                    draw a three-quarter view, 1024 pixels, as a PNG
  tiface preview scan.ply --light matcap --up z --out scan.png
  tiface preview runs/002_00 --sheet            draw all sides, wireframe, normals, texture coordinates, errors
  tiface preview runs/002_00 --turntable --out turn.gif     animate; also .png
  tiface preview runs/002_00 --cameras test --out views/    draw from the held-out cameras
  tiface preview runs/002_00 --page             write a page to turn it in a browser
  tiface preview runs/002_00 --watch            write watch.html in the run, and update it while the run works")]
    Preview(PreviewOptions),
    /// Measure speed against error of settings on this machine
    #[command(after_long_help = "Examples:
  tiface bench captures/002_00 --sweep steps,hash
  tiface bench runs/002_00 --sweep triangles,texture      reuse the fields of a run
  tiface bench captures/002_00 --out bench/new/           run all sweeps, into a folder

Writes bench.json and bench.html to bench/NAME/.")]
    Bench(BenchOptions),
    /// Reproduce the paper's tables and ablations on captures
    #[command(after_long_help = "Examples:
  tiface experiment captures/* --scale 0.1      make all tables with a tenth of the steps
  tiface experiment captures/002_00 --tables components,iface --out tables/
  tiface experiment captures/* --dry-run        list the runs that the tables need, and which are done
  tiface experiment captures/* --only 002_00/tface-ce    make one of these runs, as a task of a cluster
  tiface experiment captures/* --published figures.csv   compare; a line is: tface,l2-reference,masked,30.1

Runs are folders experiment/CAPTURE/RUN, and continue where they stopped. Tables are experiment.md and
experiment.json.")]
    Experiment(ExperimentOptions),
    /// Validate a mesh: watertight, manifold, self-intersections, texture coordinates
    #[command(after_long_help = "Examples:
  tiface check head.glb
  tiface check runs/002_00 --require watertight
  tiface check scan.obj --require watertight --require one-piece
  tiface check head.ply --json
  tiface check runs/lps/mesh/surface.ply --against captures/lps/gt.ply --seen-by captures/lps")]
    Check {
        /// .glb, .gltf, .obj, .ply or .stl file, or a run: its exported mesh, or with --against its
        /// extracted surface
        #[arg(value_name = "MESH|RUN")]
        mesh: PathBuf,
        /// Exit with 3 if not met: watertight, manifold, one-piece, no-self-intersections,
        /// sound-uv; repeatable
        #[arg(long, value_name = "BAR")]
        require: Vec<String>,
        /// Measure the distance to this surface, in the same coordinates (use a PLY: a GLB is
        /// rotated to +Y up)
        #[arg(long, value_name = "MESH")]
        against: Option<PathBuf>,
        /// Measure it also where three or more training cameras of this capture see the surface, by
        /// the number of cameras, and back from skin and hair
        #[arg(long, value_name = "CAPTURE", requires = "against")]
        seen_by: Option<PathBuf>,
    },
    /// Write the page of a run again, or one page of two or many runs
    #[command(after_long_help = "Examples:
  tiface report runs/002_00                     write its report.html again
  tiface report runs/a runs/b                   compare two finished runs of one capture
  tiface report runs/* --out fleet.html         write a table of all runs with links, and fleet.csv
  tiface report runs/* --json                   print the same figures, an object for each run

The comparison of two runs, compare.html, shows their views beside each other, their curves in one chart, the distance
between their surfaces and the settings that differ; --table writes the table instead.")]
    Report {
        /// Run folders [default: all under runs/]
        runs: Vec<PathBuf>,
        /// Write a table even of one or two runs
        #[arg(long)]
        table: bool,
    },
    /// Show stages, progress, time left and last error of runs
    #[command(after_long_help = "Examples:
  tiface status
  tiface status runs/002_00                     print a row for each stage
  tiface status runs/*                          print a line for each run, and one for all
  tiface status runs/* --failed                 print only runs that need attention
  tiface status runs/* --json                   print an object for each run

Signs of stages, and the exit code of a run that stands there:
  #  done             0      x  failed                                    3
  >  running          0      %  damaged: a file was lost or cut           3
  =  stopped          0      !  killed: repeat its command to continue    3
  .  to do            0      ?  not readable                              1
Of many runs, the worst state decides: failed, damaged, killed, not readable. Of more than 40 runs, those that are done
or have not begun are summed up; -v prints a line for each.")]
    Status(StatusOptions),
    /// Compare the files of runs with the SHA-256 digests in their records
    #[command(after_long_help = "Examples:
  tiface verify                                 compare all runs under runs/
  tiface verify runs/002_00                     exit with 3 if a file is gone, cut or changed
  tiface verify runs/* --json | jq '.files[] | select(.state != \"recorded\")'

Nothing is written. Each file that differs is printed with the command that makes it again. --json prints an object for
each run, with size, SHA-256 and state (recorded, changed, cut or gone) of every file: a manifest.")]
    Verify {
        /// Run folders [default: all under runs/]
        runs: Vec<PathBuf>,
    },
    /// Remove what finished runs do not need: optimizer state, float views, old checkpoints
    #[command(after_long_help = "Examples:
  tiface clean runs/002_00                      list what would be removed, with its size
  tiface clean runs/002_00 --yes                list it, then remove it
  tiface clean runs/* --json | jq .bytes        print an object for each run

Photographs, masks, weights, meshes, pictures, figures and pages stay, and so does everything of a stage that is not
finished. All stages stay finished; `run`, `export`, `preview`, `report` and `verify` work as before. To repeat the blend
or the metrics alone, the views are then rendered again (--fresh render). A run in use is refused.")]
    Clean {
        /// Run folders
        #[arg(value_name = "RUN", required = true)]
        runs: Vec<PathBuf>,
        /// Remove what is listed
        #[arg(long)]
        yes: bool,
    },
    /// Print the effective configuration, or explain a key
    #[command(after_long_help = "Examples:
  tiface config --preset paper
  tiface config runs/002_00 --set mesh.resolution=1024
  tiface config --explain iface.steps           explain a key; --explain mesh explains a table
  tiface config --preset draft --json | jq .mesh.resolution")]
    Config {
        #[command(flatten)]
        input: CaptureOrRun,
        /// Explain a key or a table: meaning, range and value in every preset
        #[arg(long, value_name = "KEY", add = ArgValueCompleter::new(complete::complete_key))]
        explain: Option<String>,
    },
    /// List GPUs, test them, and show which one `auto` uses
    #[command(after_long_help = "Examples:
  tiface doctor                 show drivers, memory and a self-test of each device, for a bug report
  tiface doctor --json          print the same as JSON

It exits with 1 if a device fails its self-test against the CPU. A build without the feature `wgpu` has no GPUs.")]
    Doctor,
    /// Print shell completions, which know settings and their values
    #[command(after_long_help = "Examples:
  tiface completions bash > /etc/bash_completion.d/tiface
  tiface completions zsh > ~/.zfunc/_tiface
  tiface completions fish > ~/.config/fish/completions/tiface.fish")]
    Completions {
        /// Shell to complete for
        shell: Shell,
    },
}

impl Command {
    /// Returns the stages that a command runs, and its settings.
    pub fn on_stages(&self, common: &Common) -> Result<StageCommand<'_>> {
        let (input, until, flags) = match self {
            Command::Run { input, flags, .. } => (input, Stage::Metrics, Some(flags)),
            Command::Mask { input, flags, .. } => (input, Stage::Mask, Some(flags)),
            Command::Baseline(input) => (input, Stage::Baseline, None),
            Command::Tface(input) => (input, Stage::Tface, None),
            Command::Iface(input) => (input, Stage::Iface, None),
            Command::Mesh { input, flags } => (input, Stage::Mesh, Some(flags)),
            Command::Render { input, flags } => (input, Stage::Render, Some(flags)),
            Command::Ensemble { input, flags } => (input, Stage::Ensemble, Some(flags)),
            Command::Metrics { input, .. } => (input, Stage::Metrics, None),
            other => unreachable!("{other:?} runs no stage"),
        };
        let keys = flags.map(KeyFlags::options).transpose()?.unwrap_or_default();
        let (product, require) = match self {
            Command::Run { require, .. } => ("run", &require[..]),
            Command::Metrics { require, .. } => ("metrics", &require[..]),
            _ => (until.as_str(), &[][..]),
        };
        let target = RunTarget::find(common, input.path.as_deref())?;
        Ok(StageCommand { product, until, target, require, keys, fallback: None })
    }
}

/// Returns the options of all commands that a command would ignore, by their identifiers.
pub(super) fn ignored(command: &str) -> &'static [&'static str] {
    match command {
        "status" | "verify" => {
            &["fresh", "seed", "config", "preset", "set", "device", "deterministic", "memory"]
        }
        "clean" | "doctor" | "completions" => {
            &["run", "fresh", "seed", "config", "preset", "set", "device", "deterministic", "memory"]
        }
        "inspect" | "cameras" | "convert" | "check" => {
            &["run", "fresh", "seed", "device", "deterministic", "memory"]
        }
        "preview" | "report" => &["fresh", "deterministic", "memory"],
        "export" => &["fresh", "seed", "config", "preset", "set", "device", "deterministic", "memory"],
        "config" | "bench" => &["fresh"],
        _ => &[],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

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
            assert!(matches!(cli.command, Command::Run { input, .. } if input.path.is_some()));
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
            let plain = ["doctor"].contains(&command.get_name());
            assert!(plain || shown.matches("tiface ").count() >= 3, "{}", command.get_name());
        }
    }
}
