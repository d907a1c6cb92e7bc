"""Sends the curves and the figures of a run to an experiment tracker that is installed: tensorboard, wandb or trackio.

    python tools/track.py runs/head --to tensorboard [--out DIR]     needs tensorboardX; then `tensorboard --logdir DIR`
    python tools/track.py runs/head --to wandb [--project NAME]      needs wandb; it asks for an account, WANDB_MODE=offline none
    python tools/track.py runs/head --to trackio [--project NAME]    needs trackio; then `trackio show`

Curves are named STAGE/FIGURE, by the step of the stage; figures that are not finite are left out. Means over the held-out
views are named METHOD/FIGURE. The settings are those of the run's config.toml. Nothing is written into the run. tiface itself
sends nothing anywhere.
"""

import argparse
import importlib
import itertools
import pathlib
import sys
import tomllib

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "examples"))
from read_run import curves, figures  # noqa: E402

PACKAGES = {"tensorboard": "tensorboardX", "wandb": "wandb", "trackio": "trackio"}


def steps(run):
    """The figures of each line of the logs: (stage, step, {STAGE/FIGURE: value}), in their order."""
    lines = itertools.groupby(curves(run), key=lambda row: row[:3])
    each = ((stage, step, {f"{stage}/{name}": v for *_, name, v in rows if v is not None}) for (stage, step, _), rows in lines)
    return [line for line in each if line[2]]


def means(run):
    """The figures of the held-out views, METHOD/FIGURE; none of a run without metrics."""
    if not (run / "metrics/metrics.json").is_file():
        return {}
    return {f"{method}/{name}": value for method, of in figures(run).items() for name, value in of.items() if value is not None}


def to_tensorboard(package, run, name, arguments):
    writer = package.SummaryWriter(str(arguments.out or pathlib.Path("tensorboard") / name))
    for stage, step, values in steps(run):
        for figure, value in values.items():
            writer.add_scalar(figure, value, step)
    for figure, value in means(run).items():
        writer.add_scalar(figure, value, 0)
    writer.add_text("config.toml", f"```toml\n{(run / 'config.toml').read_text(encoding='utf-8')}\n```")
    writer.close()


def to_tracker(package, run, name, arguments):
    """wandb, and trackio, which has the same functions. A stage counts its own steps, so each is an axis of its own."""
    settings = tomllib.loads((run / "config.toml").read_text(encoding="utf-8"))
    tracked = package.init(project=arguments.project, name=name, config=settings)
    if hasattr(tracked, "define_metric"):
        for stage in {stage for stage, _, _ in steps(run)}:
            tracked.define_metric(f"{stage}/*", step_metric=f"{stage}/step")
    for stage, step, values in steps(run):
        package.log(values | {f"{stage}/step": step})
    if found := means(run):
        package.log(found)
    package.finish()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=pathlib.Path)
    parser.add_argument("--to", required=True, choices=PACKAGES)
    parser.add_argument("--out", type=pathlib.Path, help="folder of tensorboard's files [default: tensorboard/NAME]")
    parser.add_argument("--project", default="tiface", help="of wandb or trackio [default: tiface]")
    arguments = parser.parse_args()
    run = arguments.run.resolve()
    if not (run / "config.toml").is_file():
        return f"error: `{arguments.run}` is not a run: it has no config.toml"
    word = PACKAGES[arguments.to]
    try:
        package = importlib.import_module(word)
    except ImportError as problem:
        return f"error: --to {arguments.to} needs the Python package {word} ({problem})\n\nhint: pip install {word}"
    to = to_tensorboard if arguments.to == "tensorboard" else to_tracker
    to(package, run, run.name, arguments)
    print(f"{run.name}: {len(steps(run))} steps and {len(means(run))} figures to {arguments.to}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
