"""Checks the files of a finished run that people script against the JSON Schemas of docs/schemas.

    python3.11 -m venv .venv && .venv/bin/pip install -r tools/readers/requirements.txt
    .venv/bin/python tools/readers/check_schemas.py RUN...

Checked: metrics/metrics.json, cameras.json, and done.json and log.jsonl of each stage are valid; and that the schemas would
find a change: each key of these files is left out, renamed and given a value of another type in turn, which all must be
refused, but for the keys that a file may lack and the maps whose keys are names. Exits 1 after printing every disagreement.
"""

import copy
import json
import pathlib
import sys

from jsonschema import Draft202012Validator

SCHEMAS = pathlib.Path(__file__).resolve().parents[2] / "docs/schemas"
# what a file may lack
OPTIONAL = {
    "metrics": {"blend", "truth_percent_of_head", "own_exposure", "own_pose", "region", "parts", "mean_square_opacity_outside",
                "lpips", "mesh"},
    "cameras": {"fit", "exposure", "held_out", "refined", "fitted", "measured", "used", "mask_reading", "side_turn", "turn",
                "mask_turn", "k4", "k5", "k6", "sx1", "sy1", "omega", "projection"},
    "done": {"cleaned"},
    "log": set(),
}
# maps from names to values, whose keys are free
MAPS = {"metrics": {()}, "done": {("fingerprint", "settings"), ("fingerprint", "inputs"), ("products",), ("sha256",), ("cleaned",)},
        "log": {()}, "cameras": set()}
# what differs from stage to stage, or is described elsewhere
FREE = {"metrics": {"mesh"}, "done": {"summary"}, "cameras": {"mask_reading"}, "log": set()}


def other(value):
    """A value of another type, which no schema here allows in its place."""
    if isinstance(value, (dict, list)):
        return "a text"
    return {} if value is None or isinstance(value, (int, float)) else 7


def short(value):
    """The value with one item of each list of objects, which are all alike."""
    if isinstance(value, dict):
        return {key: short(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [short(inner) for inner in (value[:1] if value and isinstance(value[0], dict) else value)]
    return value


def objects(value, path=()):
    """Every object in a value, with its path."""
    if isinstance(value, dict):
        yield path, value
    for key, inner in value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ():
        yield from objects(inner, path + (key,))


def at(value, path):
    for key in path:
        value = value[key]
    return value


def unnoticed(kind, valid, value):
    """Changes of a value that its schema does not find, one of each kind for each key."""
    for path, found in objects(short(value)):
        if FREE[kind] & set(path):
            continue
        for key in found:
            names = path in MAPS[kind] and not (kind == "log" and key in ("step", "steps", "elapsed_s")) and key != "truth"
            for change in ("missing", "renamed", "of another type"):
                if change != "of another type" and names or change == "missing" and key in OPTIONAL[kind]:
                    continue
                if change == "of another type" and key in FREE[kind]:
                    continue
                changed = copy.deepcopy(short(value))
                owner = at(changed, path)
                inner = owner.pop(key)
                if change == "renamed":
                    owner[f"{key}s"] = inner
                if change == "of another type":
                    owner[key] = other(inner)
                if valid.is_valid(changed):
                    yield f"{'.'.join(map(str, path + (key,)))} {change} is not found"


def values_of(file):
    text = file.read_text(encoding="utf-8")
    if file.suffix == ".json":
        return [json.loads(text)]
    # the first lines, and the last
    lines = text.splitlines()
    return [json.loads(line) for line in lines[:2] + lines[-1:]]


def main():
    wrong, counts = [], {}
    valid = {}
    for kind in OPTIONAL:
        schema = json.loads((SCHEMAS / f"{kind}.schema.json").read_text(encoding="utf-8"))
        Draft202012Validator.check_schema(schema)
        valid[kind] = Draft202012Validator(schema)
    for run in map(pathlib.Path, sys.argv[1:]):
        files = [("metrics", run / "metrics/metrics.json"), ("cameras", run / "cameras.json")]
        for stage in sorted(run.glob("*/done.json")):
            files += [("done", stage), ("log", stage.with_name("log.jsonl"))]
        if len(files) < 4:
            wrong.append(f"{run} has no finished stage")
        for kind, file in files:
            if not file.is_file():
                wrong.append(f"{file} is missing")
                continue
            for value in values_of(file):
                counts[kind] = counts.get(kind, 0) + 1
                errors = [f"{file}, {error.json_path}: {error.message[:200]}" for error in valid[kind].iter_errors(value)]
                wrong += errors or [f"{file}: {what}" for what in unnoticed(kind, valid[kind], value)]
    print(", ".join(f"{count} of {kind}" for kind, count in sorted(counts.items())))
    for line in wrong:
        print("WRONG", line)
    return 1 if wrong or not counts else 0


if __name__ == "__main__":
    sys.exit(main())
