#!/usr/bin/env python3
"""How far refined poses are from the truth, on captures whose poses were disturbed.

    tools/reference/poses.py CAPTURE...

A capture holds `perturb.json`, which states for each disturbed view, in a list `views`, its `name` and the exact
`transform_matrix` (camera to world, OpenGL axes). Without that file the given poses count as exact. Runs `tiface mask` on each
capture (TIFACE names the program), and compares the poses given and those in `mask/poses.json` with the exact ones: the root
mean square of how far points of a cube around the head are projected apart, in pixels.
"""

import json
import os
import pathlib
import resource
import subprocess
import sys
import tempfile

import numpy as np

program = os.environ.get("TIFACE", "target/release/tiface")


def pose(p):
    """Rotation and position of a camera in a file of ours; matrices are stored by columns."""
    return np.array(p["rotation"]).reshape(3, 3).T, np.array(p["position"])


def pixels(camera, rotation, position, points):
    c = (points - position) @ rotation
    return np.stack([camera["fx"] * c[:, 0] / -c[:, 2], -camera["fy"] * c[:, 1] / -c[:, 2]], 1)


def row(capture):
    with tempfile.TemporaryDirectory() as folder:
        before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
        done = subprocess.run([program, "mask", str(capture), "--run", folder, "--quiet"], capture_output=True, text=True)
        cpu = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
        if done.returncode:
            return f"refused: {done.stderr.strip().splitlines()[0]}"
        run = pathlib.Path(folder)
        check = json.loads((run / "mask/poses.json").read_text())
        cameras = json.loads((run / "cameras.json").read_text())
    exact = {}
    truth = capture / "perturb.json"
    if truth.is_file():
        exact = {v["name"]: np.array(v["transform_matrix"]) for v in json.loads(truth.read_text())["views"]}
    lens = {v["name"]: v["camera"] for v in cameras["views"]}
    scene = cameras["world_from_scene"]
    grid = np.stack(np.meshgrid(*[np.linspace(-0.6, 0.6, 5)] * 3), -1).reshape(-1, 3)
    points = scene["scale"] * grid + np.array(scene["translation"])
    errors = []
    for c in check["cameras"]:
        given, used = pose(c["given"]), pose(c.get("refined", c["given"]))
        m = exact.get(c["view"])
        true = given if m is None else (m[:3, :3], m[:3, 3])
        reference = pixels(lens[c["view"]], *true, points)
        apart = [pixels(lens[c["view"]], *p, points) - reference for p in (given, used)]
        errors.append([np.sqrt((a**2).sum(1).mean()) for a in apart])
    errors = np.array(errors)
    before, after = np.sqrt((errors**2).mean(0))
    states = {s: [c["view"] for c in check["cameras"] if c["state"] == s] for s in ("refined", "lost", "far")}
    named = ", ".join(f"{s} {' '.join(v)}" for s, v in states.items() if 0 < len(v) < 5)
    residual = f"{check['given_px']:.2f} -> {check['adjusted_px']:.2f}"
    return (f"{check['verdict']}{' (' + named + ')' if named else ''}: {before:.2f} -> {after:.3f} px, worst camera "
            f"{errors[:, 1].max():.2f}; residual {residual} px; {cpu:.1f} CPU s with the masks")


for capture in map(pathlib.Path, sys.argv[1:]):
    print(f"{capture.name}: {row(capture)}", flush=True)
