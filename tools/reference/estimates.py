"""Compares what a run was told to take with what it took; exits with 1 where the whole of it was told wrong.

    python tools/reference/estimates.py RUN...

RUN/estimate.json holds the estimates, RUN/*/done.json the memory of the process while it made each stage, and the files
of a stage are what it took of the disk. A whole run is told right if memory and disk told are 1 to 1.3 times what was
used; run it in one process (`tiface run CAPTURE --run NEW`). To fit the constants of `mib` and `kept` in
src/pipeline/cost.rs: raise what makes a stage fall below 1, lower what makes the stage of the maximum exceed 1.3.
"""

import json
import pathlib
import sys

LOWEST, HIGHEST = 1.0, 1.3
STAGES = ["mask", "baseline", "tface", "iface", "mesh", "render", "ensemble", "metrics"]


def size(folder):
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def row(name, told, used):
    """Prints a line; returns whether it is told right."""
    cells = []
    right = True
    for (what, unit, scale) in [("memory", "MiB", 2**20), ("disk", "MB", 1e6)]:
        if not used.get(what):
            cells.append(f"{what} unknown")
            continue
        ratio = told[what] / used[what]
        right &= LOWEST <= ratio <= HIGHEST
        cells.append(f"{what} told {told[what] / scale:8.1f} used {used[what] / scale:8.1f} {unit} = {ratio:.2f}")
    print(f"{name:<10} {'  '.join(cells)}")
    return right


def compare(run):
    estimates = json.loads((run / "estimate.json").read_text())
    told, used = {"memory": 0, "disk": 0}, {"memory": 0, "disk": 0}
    for stage in STAGES:
        if stage not in estimates or not (run / stage / "done.json").is_file():
            continue
        done = json.loads((run / stage / "done.json").read_text())
        one_told = {"memory": estimates[stage]["memory_bytes"], "disk": estimates[stage]["disk_bytes"]}
        one_used = {"memory": done.get("peak_bytes") or 0, "disk": size(run / stage)}
        if stage == "metrics" and (run / "report.html").is_file():
            one_used["disk"] += (run / "report.html").stat().st_size
        row(stage, one_told, one_used)
        told = {"memory": max(told["memory"], one_told["memory"]), "disk": told["disk"] + one_told["disk"]}
        used = {"memory": max(used["memory"], one_used["memory"]), "disk": used["disk"] + one_used["disk"]}
    return row("whole run", told, used)


def main():
    if len(sys.argv) < 2:
        sys.exit(__doc__)
    right = True
    for run in map(pathlib.Path, sys.argv[1:]):
        print(run)
        right &= compare(run)
    if not right:
        sys.exit(1)


if __name__ == "__main__":
    main()
