#!/usr/bin/env python3
"""What disturbed captures cost, and how much of it refined poses and evened-out exposures regain.

    tools/reference/disturbed.py CAPTURE COPY...

CAPTURE is undisturbed and holds the true surface, `gt.ply`; each COPY is the same capture whose training photographs and poses
were disturbed. Trains I-Face for 1,500 steps on each (TIFACE names the program), with poses and exposures as given and
with `auto`, and prints a row of `perturb.md` for each: PSNR of the ray-cast mesh against held-out photographs, the median
distance from the true skin (or surface, where there is no hair), and CPU seconds. Runs one training at a time.
"""

import json
import os
import pathlib
import re
import resource
import subprocess
import sys
import tempfile

program = os.environ.get("TIFACE", "target/release/tiface")
short = ["--preset", "draft", "--set", "capture.glare=given", "--set", "iface.steps=1500", "--set", 'render.method=["raycast"]', "--set", "ensemble.members=[]"]


def spent():
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def row(copy, truth, mode):
    modes = [a for key in ("cameras", "exposure") for a in ("--set", f"capture.{key}={mode}")]
    with tempfile.TemporaryDirectory() as folder:
        before = spent()
        done = subprocess.run([program, "metrics", str(copy), "--run", folder, "--quiet", *short, *modes], capture_output=True,
                              text=True)
        cpu = spent() - before
        if done.returncode:
            return f"| {copy.name} | {mode} | refused: {done.stderr.strip().splitlines()[0]} | | | | |"
        run = pathlib.Path(folder)
        figures = json.loads((run / "metrics/metrics.json").read_text())["raycast"]
        check = [program, "check", str(run / "mesh/surface.ply"), "--against", str(truth / "gt.ply"), "--seen-by", str(truth)]
        text = subprocess.run(check, capture_output=True, text=True, check=True).stdout
    median = [re.search(rf"{part} 3 cameras look .*?median ([\d.]+),", text) for part in ("skin,", "where")]
    skin = next(m.group(1) for m in median if m)
    own = figures.get("own_exposure", {}).get("mean", {}).get("psnr_masked")
    pose = figures.get("own_pose", {}).get("mean", {}).get("psnr_masked")
    own, pose = (f"{db:.2f}" if db else "–" for db in (own, pose))
    return f"| {copy.name} | {mode} | {figures['head']['mean']['psnr_masked']:.2f} | {own} | {pose} | {float(skin):.3f} | {cpu:.0f} |"


truth, *copies = map(pathlib.Path, sys.argv[1:])
print("| capture | cameras, exposure | mesh, dB | at own exposure, dB | from own pose, dB | skin, mm | CPU s |")
print("| --- | --- | --- | --- | --- | --- | --- |")
for copy in copies:
    for mode in ("given", "auto"):
        print(row(copy, truth, mode), flush=True)
