"""Reads a run of tiface with numpy alone: cameras, views, figures and curves. What the files hold is in docs/schemas.

    python examples/read_run.py runs/head                      what is in it
    python examples/read_run.py runs/head runs/other           figures of two runs beside each other
    python examples/read_run.py runs/head --csv curves.csv     the curves of all stages, a row for each figure of a step
"""

import argparse
import csv
import json
import struct
import zlib
from pathlib import Path

import numpy


def cameras(run):
    """Cameras by view, with the poses that the run uses; world_from_camera [4, 4] looks along -Z, +Y up."""
    found = json.loads((run / "cameras.json").read_text(encoding="utf-8"))
    fit = found.get("fit", {})
    poses = {c["view"]: c.get("refined") for c in fit.get("cameras", [])}
    poses |= {c["view"]: c.get("fitted") for c in fit.get("held_out", [])}
    result = {}
    for view in found["views"]:
        c = view["camera"] | (poses.get(view["name"]) or {})
        world_from_camera = numpy.eye(4)
        world_from_camera[:3, :3] = numpy.reshape(c["rotation"], (3, 3)).T  # stored column by column
        world_from_camera[:3, 3] = c["position"]
        intrinsics = numpy.array([[c["fx"], 0, c["cx"]], [0, c["fy"], c["cy"]], [0, 0, 1.0]])
        known = {"split": view["split"], "size": (c["width"], c["height"]), "distortion": c["distortion"]}
        result[view["name"]] = known | {"intrinsics": intrinsics, "world_from_camera": world_from_camera}
    return result


def project(camera, points):
    """World points [n, 3] -> pixels [n, 2] from the top-left corner, without lens distortion."""
    pose = camera["world_from_camera"]
    homogeneous = ((points - pose[:3, 3]) @ pose[:3, :3] * [1, -1, -1]) @ camera["intrinsics"].T
    return homogeneous[:, :2] / homogeneous[:, 2:]


def picture(path):
    """A PNG of 8 or 16 bits as [h, w, channels] in 0..1. Slow for large pictures: take Pillow there."""
    data, at, packed = Path(path).read_bytes(), 8, b""
    while at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        if kind == b"IHDR":
            width, height, bits, color, *_ = struct.unpack_from(">IIBBBBB", data, at + 8)
        packed += data[at + 8 : at + 8 + length] if kind == b"IDAT" else b""
        at += 12 + length
    step = {0: 1, 2: 3, 4: 2, 6: 4}[color] * bits // 8
    rows = numpy.frombuffer(zlib.decompress(packed), numpy.uint8).reshape(height, 1 + width * step)
    above, out = numpy.zeros(width * step, numpy.uint8), []
    for kind, row in zip(rows[:, 0], rows[:, 1:]):
        if kind in (1, 2):
            row = numpy.cumsum(row.reshape(width, step), 0, numpy.uint8).ravel() if kind == 1 else row + above
        elif kind > 2:
            line, up = [0] * step + row.tolist(), [0] * step + above.tolist()
            for i in range(step, len(line)):
                a, b, c = line[i - step], up[i], up[i - step]
                pa, pb, pc = abs(b - c), abs(a - c), abs(a + b - 2 * c)
                near = (a + b) // 2 if kind == 3 else a if pa <= pb and pa <= pc else b if pb <= pc else c
                line[i] = (line[i] + near) & 255
            row = numpy.array(line[step:], numpy.uint8)
        out.append(above := row)
    return numpy.array(out).view(f">u{bits // 8}").reshape(height, width, -1) / (2.0**bits - 1)


def figures(run):
    """Mean figures by method: psnr, ssim, psnr_masked, ssim_masked, and lpips if it was measured."""
    found = json.loads((run / "metrics/metrics.json").read_text(encoding="utf-8"))
    return {method: of["head"]["mean"] for method, of in found.items() if isinstance(of, dict) and "head" in of}


def curves(run):
    """Rows stage, step, seconds, figure, value of all logs; lines that a crash cut short are passed over."""
    for log in sorted(run.glob("*/log.jsonl")):
        for text in log.read_text(encoding="utf-8").splitlines():
            line = json.loads(text) if text.endswith("}") else {}
            for name in sorted(line.keys() - {"step", "steps", "elapsed_s"}):
                yield log.parent.name, line["step"], line["elapsed_s"], name, line[name]


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--csv", type=Path)
    run, *_ = runs = parser.parse_args().runs
    for name, camera in cameras(run).items():
        print(name, camera["split"], "{} x {}".format(*camera["size"]), "at", camera["world_from_camera"][:3, 3].round(3))
    for method, of in figures(run).items():
        shown = sorted((run / ("" if method == "ensemble" else "render") / method).glob("*.png"))
        print(method, *(f"{view.stem} {picture(view).shape}" for view in shown[:1]), f"and {len(shown)} views in all")
        beside = [figures(other).get(method, {}) for other in runs]
        print(*(f"  {name} {[round(f[name], 3) if f.get(name) is not None else None for f in beside]}" for name in of))
    if table := parser.parse_args().csv:
        with table.open("w", newline="") as file:
            csv.writer(file).writerows([("stage", "step", "elapsed_s", "figure", "value"), *curves(run)])
