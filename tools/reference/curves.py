"""Measures quality over CPU seconds of both fields for several numbers of steps; prints Markdown, draws an SVG.

    python tools/reference/curves.py OUT CAPTURE... [--demo RUN/capture] [--iface STEPS...] [--tface STEPS...]

Every point trains one field of every capture into a run of its own under OUT and judges it by the held-out views:
I-Face by its ray-cast mesh, T-Face by its own views. A capture with the true surface (gt.ply) also has the median
distance from the skin to the mesh; the demo head (`tiface demo --size 384x512 --run RUN`) the mean distance from the
mesh to its formula. CPU seconds are user and system time of the training alone, with --threads threads (1: no waiting
is counted). OUT/points.csv is written after every point, and points that it holds are not measured again. Needs
nothing but Python and the program.
"""

import argparse
import csv
import json
import os
import pathlib
import subprocess
import sys

COLUMNS = ["capture", "field", "steps", "variant", "cpu_s", "max_mib", "psnr_db", "distance_mm"]
HEAD_MM = 250.0  # height of the demo head, whose distances are stated in per cent of it
COLORS = ["#1f77b4", "#d62728", "#2ca02c", "#9467bd", "#ff7f0e"]


# measurement


class Program:
    """The program with the options that all commands of one measurement share."""

    def __init__(self, binary, threads, preset):
        self.binary, self.preset = binary, preset
        self.environment = {**os.environ, "RAYON_NUM_THREADS": str(threads)}

    def call(self, *words):
        """Runs a command; returns its output, CPU seconds and largest memory in MiB."""
        child = subprocess.Popen([self.binary, *words], env=self.environment, stdout=subprocess.PIPE, text=True)
        text = child.stdout.read()
        _, status, used = os.wait4(child.pid, 0)
        if status:
            sys.exit(f"{' '.join(words)}: exit status {os.waitstatus_to_exitcode(status)}")
        return text, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024


def measure(program, out, capture, demo, field, steps, variant, settings):
    """Trains and judges one point; returns its row."""
    name = capture.parent.name if demo else capture.name
    run = out / name / "-".join(filter(None, [field, str(steps), variant]))
    run.mkdir(parents=True, exist_ok=True)
    if demo and not (run / "capture").exists():
        (run / "capture").symlink_to(capture.resolve())  # a run with the demo's photographs knows the true surface
    keys = [f"{field}.steps={steps}", "ensemble.members=", *settings]
    keys.append(f"render.method={'raycast' if field == 'iface' else 'tface'}")
    words = [str(capture.resolve()), "--run", str(run), "--preset", program.preset, "--quiet"]
    words += [word for key in keys for word in ("--set", key)]
    _, cpu_s, max_mib = program.call(field, *words)
    program.call("metrics", *words)
    figures = json.loads((run / "metrics/metrics.json").read_text())
    method = "raycast" if field == "iface" else "tface"
    psnr = figures[method]["head"]["mean"]["psnr_masked"]
    distance = ""
    surface = run / "mesh/surface.ply"
    if demo and field == "iface":
        distance = figures["truth_percent_of_head"]["accuracy_mean"] / 100 * HEAD_MM
    elif field == "iface" and (capture / "gt.ply").is_file():
        text, _, _ = program.call(
            "check", str(surface), "--against", str(capture / "gt.ply"), "--seen-by", str(capture), "--json"
        )
        against = json.loads(text)["against"]
        parts = {part["part"]: part["median"] for part in against.get("parts", [])}
        distance = parts.get("skin", against["seen"][0]["median"])
    round_to = lambda value, digits: value if value == "" else round(value, digits)
    values = [name, field, steps, variant, round(cpu_s, 1), round(max_mib), round(psnr, 3), round_to(distance, 4)]
    return dict(zip(COLUMNS, map(str, values)))


def read(file):
    if not file.is_file():
        return []
    with file.open() as lines:
        return list(csv.DictReader(lines))


def write(file, rows):
    with file.open("w") as lines:
        table = csv.DictWriter(lines, COLUMNS, lineterminator="\n")
        table.writeheader()
        table.writerows(rows)


# table and picture


def ordered(rows):
    return sorted(rows, key=lambda r: (r["field"], r["capture"], r["variant"], int(r["steps"])))


def markdown(rows):
    lines = ["| field | capture | variant | steps | CPU s | memory, MiB | PSNR, dB | distance, mm |", "|---" * 8 + "|"]
    for r in ordered(rows):
        cells = ["field", "capture", "variant", "steps", "cpu_s", "max_mib", "psnr_db", "distance_mm"]
        lines.append("| " + " | ".join(r[c] or "–" for c in cells) + " |")
    return "\n".join(lines) + "\n"


def panel(rows, column, title, left, colors):
    """One diagram as SVG elements: `column` over CPU seconds, a line for every capture and variant."""
    width, height, top = 300, 220, 40
    curves = {}
    for r in ordered(rows):
        if r[column]:
            curves.setdefault((r["capture"], r["variant"]), []).append((float(r["cpu_s"]), float(r[column]), r["steps"]))
    points = [p for curve in curves.values() for p in curve]
    if not points:
        return []
    most = 1.05 * max(p[0] for p in points)
    low, high = min(p[1] for p in points), max(p[1] for p in points)
    low, high = low - 0.06 * (high - low or 1), high + 0.06 * (high - low or 1)
    x = lambda v: left + width * v / most
    y = lambda v: top + height * (high - v) / (high - low)
    text = lambda x, y, words, more="": f'<text x="{x:.0f}" y="{y:.0f}" font-size="11" {more}>{words}</text>'
    out = [
        f'<rect x="{left}" y="{top}" width="{width}" height="{height}" fill="none" stroke="#888"/>',
        text(left, top - 10, title, 'font-weight="bold"'),
        text(left + width, top + height + 28, "CPU seconds of the training", 'text-anchor="end"'),
    ]
    for k in range(5):
        t, v = most * k / 4, low + (high - low) * k / 4
        out.append(text(x(t), top + height + 14, f"{t:.0f}", 'text-anchor="middle"'))
        out.append(text(left - 4, y(v) + 4, f"{v:.2f}", 'text-anchor="end"'))
    for i, ((capture, variant), curve) in enumerate(curves.items()):
        color = colors[capture, variant]
        line = " ".join(f"{x(t):.1f},{y(v):.1f}" for t, v, _ in curve)
        out.append(f'<polyline points="{line}" fill="none" stroke="{color}" stroke-width="1.5"/>')
        out += [
            f'<circle cx="{x(t):.1f}" cy="{y(v):.1f}" r="3" fill="{color}"><title>{steps} steps</title></circle>'
            for t, v, steps in curve
        ]
        name = f"{capture} {variant}".strip()
        out.append(text(left + 6, top + height + 44 + 13 * i, name, f'fill="{color}"'))
    return out


def picture(rows):
    """A diagram for each field and quantity, as SVG."""
    of = lambda field: [r for r in rows if r["field"] == field]
    kinds = [
        ("iface", "psnr_db", "I-Face: its mesh, ray cast, dB"),
        ("iface", "distance_mm", "I-Face: skin from the true surface, mm"),
        ("tface", "psnr_db", "T-Face: its views, dB"),
    ]
    kinds = [kind for kind in kinds if any(r[kind[1]] for r in of(kind[0]))]
    names = sorted({(r["capture"], r["variant"]) for r in rows})
    colors = {name: COLORS[i % len(COLORS)] for i, name in enumerate(names)}
    panels = [
        e for i, (f, column, title) in enumerate(kinds) for e in panel(of(f), column, title, 50 + 370 * i, colors)
    ]
    curves = max([len({(r["capture"], r["variant"]) for r in of(f)}) for f, _, _ in kinds], default=0)
    size = f'width="{370 * len(kinds) + 10}" height="{320 + 13 * curves}"'
    background = '<rect width="100%" height="100%" fill="white"/>'
    head = f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">'
    return "\n".join([head, background, *panels, "</svg>"]) + "\n"


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("out", type=pathlib.Path)
    parser.add_argument("capture", type=pathlib.Path, nargs="*")
    parser.add_argument("--demo", type=pathlib.Path, action="append", default=[], help="the demo head's photographs")
    parser.add_argument("--iface", type=int, nargs="*", default=[], metavar="STEPS")
    parser.add_argument("--tface", type=int, nargs="*", default=[], metavar="STEPS")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="further settings of the points")
    parser.add_argument("--variant", default="", help="name of the points with these settings or this program")
    parser.add_argument("--program", default="tiface")
    parser.add_argument("--preset", default="draft")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_intermixed_args()
    options.out.mkdir(parents=True, exist_ok=True)
    file = options.out / "points.csv"
    program = Program(options.program, options.threads, options.preset)
    captures = [(c, False) for c in options.capture] + [(c, True) for c in options.demo]
    for field, all_steps in (("iface", options.iface), ("tface", options.tface)):
        for steps in all_steps:
            for capture, demo in captures:
                name = capture.parent.name if demo else capture.name
                key = (name, field, str(steps), options.variant)
                if key in {(r["capture"], r["field"], r["steps"], r["variant"]) for r in read(file)}:
                    continue
                row = measure(program, options.out, capture, demo, field, steps, options.variant, options.set)
                write(file, read(file) + [row])
                print(",".join(row.values()), file=sys.stderr, flush=True)
    rows = read(file)
    (options.out / "curves.svg").write_text(picture(rows))
    print(markdown(rows), end="")


if __name__ == "__main__":
    main()
