"""Reads a finished run with examples/read_run.py and sends it to a tracker with tools/track.py, and compares both with the run.

    python3.11 -m venv .venv && .venv/bin/pip install -r tools/readers/requirements.txt
    .venv/bin/python tools/readers/check_scripts.py RUN [OTHER]

Checked: pictures are Pillow's, bit by bit; vertices of the mesh fall on opaque pixels of the views from their cameras; the
example runs on one and on two runs, and its CSV has every figure of the logs; tensorboard's file has the same; a tracker that
is not installed is named in a sentence. Exits 1 after printing every disagreement.
"""

import csv
import json
import pathlib
import struct
import subprocess
import sys
import tempfile

import numpy
import trimesh
from PIL import Image
from tensorboardX.proto.event_pb2 import Event

from verdict import exit_code

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "examples"))
import read_run  # noqa: E402

LEAST_INSIDE = 0.99


def logged(run):
    """Stage, step, figure and value of every log, in order."""
    for log in sorted(run.glob("*/log.jsonl")):
        for line in map(json.loads, log.read_text().splitlines()):
            for name in sorted(line):
                if name not in ("step", "steps", "elapsed_s"):
                    yield log.parent.name, line["step"], name, line[name]


def check_pictures(run, wrong):
    files = sorted((run / "render/tface").glob("**/*.png"))
    for file in files:
        with Image.open(file) as opened:
            depth = opened.mode.startswith("I")
            expected = numpy.asarray(opened) / (65535 if depth else 255)
        found = read_run.picture(file)
        if not numpy.array_equal(found, expected[..., None] if depth else expected):
            wrong.append(f"{file} is not what Pillow reads")
    print(f"{len(files)} pictures are Pillow's")


def check_cameras(run, wrong):
    """`surface.ply` lies in the cameras' world."""
    points = trimesh.load(run / "mesh/surface.ply", process=False).vertices[::97]
    cameras = {name: camera for name, camera in read_run.cameras(run).items() if camera["split"] == "test"}
    for name, camera in cameras.items():
        opaque = read_run.picture(run / f"render/textured/{name}.png")[..., 3] > 0.5
        # a vertex of the outline may lie in the pixel beside the last opaque one
        rows = opaque | numpy.roll(opaque, 1, 0) | numpy.roll(opaque, -1, 0)
        opaque = rows | numpy.roll(rows, 1, 1) | numpy.roll(rows, -1, 1)
        x, y = numpy.floor(read_run.project(camera, points)).astype(int).T
        width, height = camera["size"]
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        seen = opaque[y[inside], x[inside]].mean()
        if not (inside.any() and seen > LEAST_INSIDE):
            wrong.append(f"{name}: {seen:.3f} of the vertices are on the head")
    print(f"{len(cameras)} cameras see the mesh where it was rendered")


def events(folder):
    """Step, name and value of every scalar in tensorboard's files."""
    for file in folder.iterdir():
        data, at = file.read_bytes(), 0
        while at < len(data):
            (length,) = struct.unpack_from("<Q", data, at)
            event = Event.FromString(data[at + 12 : at + 12 + length])
            at += 16 + length
            for value in event.summary.value:
                if value.HasField("simple_value"):
                    yield value.tag, event.step, value.simple_value


def run_script(*words):
    return subprocess.run([sys.executable, *map(str, words)], capture_output=True, text=True)


def main():
    runs = [pathlib.Path(word).resolve() for word in sys.argv[1:]]
    run, wrong = runs[0], []
    check_pictures(run, wrong)
    check_cameras(run, wrong)
    rows = list(logged(run))
    with tempfile.TemporaryDirectory() as scratch:
        table = pathlib.Path(scratch) / "curves.csv"
        told = run_script(ROOT / "examples/read_run.py", *runs, run, "--csv", table)
        figures = read_run.figures(run)
        if told.returncode or not all(method in told.stdout for method in figures) or "ensemble" not in figures:
            wrong.append(f"the example says {told.stdout[-500:]} {told.stderr[-500:]}")
        with table.open(newline="") as file:
            found = [(r["stage"], int(r["step"]), r["figure"], float(r["value"] or "nan")) for r in csv.DictReader(file)]
        same = [a[:3] == b[:3] and (b[3] is None or a[3] == b[3]) for a, b in zip(found, rows)]
        if len(found) != len(rows) or not all(same):
            wrong.append(f"{len(found)} rows of curves, {len(rows)} figures in the logs")
        out = pathlib.Path(scratch) / "board"
        told = run_script(ROOT / "tools/track.py", run, "--to", "tensorboard", "--out", out)
        sent = set(events(out)) if told.returncode == 0 else set()
        wanted = {(f"{stage}/{name}", step, numpy.float32(v)) for stage, step, name, v in rows if v is not None}
        wanted |= {(f"{m}/{name}", 0, numpy.float32(v)) for m, of in figures.items() for name, v in of.items() if v is not None}
        if sent != {(name, step, float(value)) for name, step, value in wanted}:
            wrong.append(f"tensorboard got {len(sent)} of {len(wanted)} figures: {told.stderr[-500:]}")
        print(f"{len(found)} figures of curves; {len(sent)} at tensorboard")
        # where that package is not installed
        bare = run_script("-c", f"import runpy, sys; sys.argv = ['', {str(run)!r}, '--to', 'trackio']; "
                          f"sys.modules['trackio'] = None; runpy.run_path({str(ROOT / 'tools/track.py')!r}, run_name='__main__')")
        if bare.returncode != 1 or "error: " not in bare.stderr or "hint: pip install" not in bare.stderr:
            wrong.append(f"without a tracker: {bare.returncode} {bare.stderr[-500:]}")
    return exit_code(wrong)


if __name__ == "__main__":
    sys.exit(main())
