"""Draws heads beneath each other from all sides, on gray, and in clay: what a change of the mesh changes for the eye.

    tiface run CAPTURE --preset draft --run RUN
    sides.py OUT.jpg RUN [RUN ...] [--tiface PROGRAM [PROGRAM ...]]

A row is a run, drawn by the program of the same place (the last one draws the rest): front, left, back and top as stored, and
the front in clay. A run is drawn by the program that made it, as that shows its soft layers. Needs numpy and Pillow.
"""

import argparse
import os
import pathlib
import subprocess
import tempfile

import numpy as np
from PIL import Image

# pictures of `tiface preview --sheet`: front, left, back, top; in clay the front
SHOWN = [0, 1, 3, 4]
IN_CLAY = [0]
GRAY = 128
SIDE = 360
MARGIN = 24
QUALITY = 88


def sheet(program, run, light):
    """The pictures of a run's sheet, twice as large as they are shown, over gray."""
    side = 2 * SIDE
    with tempfile.TemporaryDirectory() as folder:
        out = pathlib.Path(folder) / "sheet.png"
        command = [program, "preview", str(run), "--sheet", "--size", str(side), "--light", light, "--background", "none"]
        subprocess.run([*command, "--out", str(out)], check=True, stdout=subprocess.DEVNULL)
        rgba = np.asarray(Image.open(out).convert("RGBA"), float)
    alpha = rgba[..., 3:] / 255
    rows = np.split(rgba[..., :3] * alpha + GRAY * (1 - alpha), rgba.shape[0] // side, 0)
    return [picture for row in rows for picture in np.split(row, rgba.shape[1] // side, 1)]


def row(program, run):
    colored, clay = sheet(program, run, "unlit"), sheet(program, run, "matcap")
    return [colored[k] for k in SHOWN] + [clay[k] for k in IN_CLAY]


def used(pictures, axis):
    """The part of some pictures along an axis in which any of them shows a head."""
    shown = (np.abs(np.array(pictures) - GRAY).max(-1) > 1).any(0).any(1 - axis)
    first, last = np.flatnonzero(shown)[[0, -1]]
    return slice(max(first - MARGIN, 0), last + MARGIN)


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("out", type=pathlib.Path)
    arguments.add_argument("runs", type=pathlib.Path, nargs="+")
    arguments.add_argument("--tiface", nargs="+", default=[os.environ.get("TIFACE", "tiface")])
    given = arguments.parse_args()
    programs = given.tiface + given.tiface[-1:] * len(given.runs)
    rows = [row(program, run) for program, run in zip(programs, given.runs)]
    down, across = used(sum(rows, []), 0), [used(column, 1) for column in zip(*rows)]
    cut = [np.concatenate([picture[down, columns] for picture, columns in zip(one, across)], 1) for one in rows]
    picture = Image.fromarray(np.clip(np.concatenate(cut, 0) + 0.5, 0, 255).astype(np.uint8))
    picture = picture.resize((picture.width // 2, picture.height // 2), Image.Resampling.LANCZOS)
    picture.save(given.out, quality=QUALITY, optimize=True)


if __name__ == "__main__":
    main()
