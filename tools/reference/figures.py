"""Writes the figures of the documents from runs, so that they cannot age.

    python tools/reference/figures.py record NAME=RUN...    read runs into figures.json beside this file
    python tools/reference/figures.py write                 write the figures into the documents
    python tools/reference/figures.py check                 exit with 1 where a document and figures.json differ
    python tools/reference/figures.py picture RUN           draw docs/demo.png from a run of the demo head

A figure of a document stands between two comments, the first with its name and number of decimals:

    <!--figure demo.raycast.psnr 1-->38.5<!--/-->

The part before the first dot is the NAME of a run; COMMANDS below says how each run is made. `picture` draws held-out
photographs above the mesh from the same cameras, and needs the program, numpy and pillow; the rest needs Python alone.
"""

import argparse
import json
import os
import pathlib
import re
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
RECORD = pathlib.Path(__file__).with_name("figures.json")
DOCUMENTS = ["README.md", "docs/results.md", "docs/artist.md", "docs/bench.md", "docs/cookbook.md"]
FIGURE = re.compile(r"<!--figure ([\w.]+) (\d)-->(.*?)<!--/-->")
METHODS = ["baseline", "tface", "volume", "raycast", "plain", "textured", "raster", "ensemble"]
ALL_METHODS = "--set render.method=tface,volume,raycast,plain,textured"
COMMANDS = {
    "demo": "tiface demo --run RUN",
    "quick_man": "tiface run MAN --preset quick --run RUN",
    "draft_man": f"tiface run MAN --preset draft {ALL_METHODS} --run RUN",
    "draft_bust": f"tiface run BUST --preset draft {ALL_METHODS} --run RUN",
    "methods": "tiface demo --set iface.steps=1500 --set render.residuals=false "
    "--set render.method=tface,volume,raycast,plain,textured,raster --run RUN",
}


# figures of a run


def read(file):
    return json.loads(file.read_text()) if file.is_file() else {}


def figures_of(run):
    """Returns the figures of a run by their name after that of the run."""
    stages = {file.parent.name: read(file) for file in sorted(run.glob("*/done.json"))}
    if "metrics" not in stages:
        sys.exit(f"{run} is not done: it has no metrics/done.json")
    found = {}
    metrics = stages["metrics"]["summary"]
    for method in METHODS:
        mean = metrics.get(method, {}).get("head", {}).get("mean", {})
        for key, figure in [("psnr", "psnr_masked"), ("ssim", "ssim_masked")]:
            if mean.get(figure) is not None:
                found[f"{method}.{key}"] = mean[figure]
    truth = metrics.get("truth_percent_of_head") or {}
    if truth.get("accuracy_mean") is not None:
        found["truth.percent"] = truth["accuracy_mean"]
    for method, seconds in stages.get("render", {}).get("summary", {}).get("seconds_per_view", {}).items():
        found[f"{method}.ms"] = 1000 * seconds
    for stage, done in stages.items():
        found[f"{stage}.cpu_s"] = done.get("cpu_s")
        found[f"{stage}.mib"] = done["peak_bytes"] / 2**20 if done.get("peak_bytes") else None
    found["minutes"] = sum(done["elapsed_s"] for done in stages.values()) / 60
    found["cpu_s"] = sum(done.get("cpu_s") or 0 for done in stages.values())
    found["gib"] = max((done.get("peak_bytes") or 0) for done in stages.values()) / 2**30
    return {name: round(value, 6) for name, value in found.items() if value is not None}


def record(pairs):
    known = read(RECORD)
    for pair in pairs:
        name, _, run = pair.partition("=")
        if name not in COMMANDS:
            sys.exit(f"{name} is no run of the documents; they have {', '.join(COMMANDS)}")
        run = pathlib.Path(run)
        done = read(run / "metrics/done.json")
        known[name] = {"version": done.get("version"), "finished": done.get("finished"), "figures": figures_of(run)}
    RECORD.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")


# documents


def recorded():
    runs = read(RECORD)
    return {f"{name}.{key}": value for name, run in runs.items() for key, value in run["figures"].items()}


def filled(text, figures, wrong):
    """Returns a document with its figures; what is wrong with it is added to a list."""

    def one(found):
        name, digits, stands = found.groups()
        if name not in figures:
            wrong.append(f"no run has the figure {name}")
            return found.group(0)
        value = f"{figures[name]:,.{digits}f}"
        if value != stands:
            wrong.append(f"{name} is {value}, and the document says {stands}")
        return f"<!--figure {name} {digits}-->{value}<!--/-->"

    return FIGURE.sub(one, text)


def documents(writes):
    figures, failed = recorded(), False
    for name in DOCUMENTS:
        file, wrong = ROOT / name, []
        text = file.read_text()
        new = filled(text, figures, wrong)
        if writes and new != text:
            file.write_text(new)
            print(f"{name}: written")
        for line in wrong if not writes else [line for line in wrong if line.startswith("no run")]:
            failed = True
            print(f"{name}: {line}")
    unmade = [name for name, run in read(RECORD).items() if run["version"] is None]
    if unmade:
        print(f"not from a run yet: {', '.join(unmade)}")
        for name in unmade:
            print(f"  {COMMANDS[name]}, then: figures.py record {name}=RUN")
    return failed


# docs/demo.png


def draw(run, binary, out, columns=4, width=192):
    import numpy
    from PIL import Image

    split = read(run / "capture/transforms_test.json")["frames"]
    frames = [split[i * len(split) // columns] for i in range(columns)]
    rows = [[], []]
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [binary, "preview", str(run), "--cameras", "test", "--background", "black", "--out", folder + "/"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        for frame in frames:
            photograph = run / "capture" / frame["file_path"]
            name = photograph.stem
            for row, file in zip(rows, [photograph, pathlib.Path(folder) / f"{name}.png"]):
                picture = Image.open(file).convert("RGB")
                size = (width, round(width * picture.height / picture.width))
                row.append(numpy.asarray(picture.resize(size, Image.Resampling.LANCZOS)))
    sheet = numpy.concatenate([numpy.concatenate(row, axis=1) for row in rows], axis=0)
    Image.fromarray(sheet).save(out, optimize=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("work", choices=["record", "write", "check", "picture"])
    parser.add_argument("runs", nargs="*")
    parser.add_argument("--tiface", default=os.environ.get("TIFACE", "tiface"))
    options = parser.parse_args()
    if options.work == "picture":
        if len(options.runs) != 1:
            parser.error("name one run of the demo head")
        draw(pathlib.Path(options.runs[0]), options.tiface, ROOT / "docs/demo.png")
        return
    if options.work == "record":
        record(options.runs)
        return
    if documents(options.work == "write"):
        sys.exit(1)


if __name__ == "__main__":
    main()
