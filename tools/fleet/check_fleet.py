"""Six tiny heads go through the fleet while its tasks, its engine and all of it at once are killed.

    python tools/fleet/check_fleet.py target/release/tiface [--kills 20] [--engine-kills 3]

One head is broken on purpose, one has a stage that somebody else holds for a while. The others must come out with the
bytes of undisturbed runs, the broken one must be named with its cause, nothing that was done may be done
again.
Before that the paper's tables are planned on a GPU, a head is mended between two plans, and a task waits for a GPU that
somebody else holds.
"""

import argparse
import fcntl
import hashlib
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from tiny_heads import SETTINGS, photograph  # noqa: E402

HEADS = [f"head_{i}" for i in range(1, 7)]
BROKEN, HELD = HEADS[2], HEADS[4]
# What tells when and how fast things happened.
CLOCKS = {
    "status.json",
    "log.jsonl",
    "done.json",
    ".lock",
    "failed.json",
    "estimate.json",
    "config.toml",
    "report.html",
}


def products(run):
    """Digests of what stages made."""
    files = [path for path in sorted(run.rglob("*")) if path.is_file() and path.name not in CLOCKS]
    out = {}
    for path in files:
        data = path.read_bytes()
        if path.name in ("metrics.json", "weights.json"):
            data = json.dumps(without_seconds(json.loads(data)), sort_keys=True).encode()
        out[str(path.relative_to(run))] = hashlib.sha256(data).hexdigest()
    return out


def without_seconds(value):
    if isinstance(value, dict):
        return {key: without_seconds(v) for key, v in value.items() if "second" not in key}
    return value


def processes(words):
    """Numbers of processes whose command line has all of these words."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                line = (entry / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            except OSError:
                continue
            if all(word in line for word in words):
                found.append(int(entry.name))
    return found


def runs_program(pid, program):
    """Is a process, if it is still there, the program itself and no shell around it?"""
    try:
        return Path(os.readlink(f"/proc/{pid}/exe")) == program
    except OSError:
        return False


def kill(pids):
    killed = 0
    for pid in pids:
        try:
            os.kill(pid, signal.SIGKILL)
            killed += 1
        except ProcessLookupError:
            pass
    return killed


def planned(engine, captures, runs, tiface, config):
    """Rows of the paper's tables that are planned, and the device that each stage is planned on beside a GPU."""
    words = [*engine, "--resources", "gpu=1", "--dry-run", "--printshellcmds", "--config", f"captures={captures}"]
    words += [f"runs={runs}", f"tiface={tiface}", "gpus=1", "experiment=components", "scale=0.01"]
    words += [f"options=--preset draft --config {config}"]
    plan = subprocess.run(words, capture_output=True, text=True, cwd=captures.parent)
    assert plan.returncode == 0, plan.stdout + plan.stderr
    rows = re.findall(r"^ *wildcards: row=(\S+)$", plan.stdout + plan.stderr, re.M)
    devices = re.findall(r" (\w+) CAPTURE .*--device (\w+)", plan.stdout + plan.stderr)
    return sorted(rows), dict(devices)


def virtual_gpu(folder):
    """Variables under which a software driver passes for a GPU; none where that cannot be had.

    Software is used where it is named with a number, and is shared then: only what passes for a GPU is waited for."""
    compiler = shutil.which("cc")
    if not compiler or sys.platform != "linux":
        return {}
    folder.mkdir(parents=True)
    library = folder / "libvirtual_gpu.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", library, HERE / "virtual_gpu.c"], check=True)
    layer = {"name": "VK_LAYER_virtual_gpu", "type": "GLOBAL", "library_path": str(library), "api_version": "1.3.0"}
    layer |= {"implementation_version": "1", "description": "every adapter is a virtual GPU"}
    (folder / "layer.json").write_text(json.dumps({"file_format_version": "1.0.0", "layer": layer}))
    return {"VK_LAYER_PATH": str(folder), "VK_INSTANCE_LAYERS": layer["name"]}


def wait_for_a_gpu(tiface, folder, capture, words):
    """A task whose GPUs are all held ends with exit code 75, or waits, and learns once one is free."""
    shutil.rmtree(folder, ignore_errors=True)
    locks = folder / "locks"
    locks.mkdir(parents=True)
    environment = {**os.environ, "TMPDIR": str(locks)}  # where devices have their locks
    words = ["iface", capture, *words, "--set", "iface.steps=10", "--device", "wgpu", "--quiet"]
    words = [str(word) for word in words]
    held = []

    def hold():
        """Takes the lock of every GPU that is free, as a run finds them; the exit code of the one that finds none."""
        while True:
            known = set(locks.glob("tiface-*.lock"))
            trial = [tiface, *words, "--run", folder / "trial"]
            trial = subprocess.Popen(trial, env=environment, stderr=subprocess.PIPE)
            while trial.poll() is None and set(locks.glob("tiface-*.lock")) == known:
                time.sleep(0.02)
            trial.kill()
            trial.communicate()
            found = set(locks.glob("tiface-*.lock")) - known
            if not found:
                return trial.returncode
            for lock in found:
                held.append(open(lock, "a"))
                fcntl.flock(held[-1], fcntl.LOCK_EX)

    code = hold()
    if not held and (variables := virtual_gpu(folder / "layer")):
        environment |= variables
        code = hold()
    if not held:
        print(f"skipped: a task waits for a GPU: neither one is here nor software that passes for one ({code})")
        return
    assert code == 75, f"all GPUs are held, and a run ended with {code}"
    run, mark, log = folder / "run", folder / "exit", folder / "log.txt"
    words[1] = "CAPTURE"
    task = ["bash", HERE / "task.sh", "1", mark, log, capture, tiface, *words, "--run", run]
    code = subprocess.run(task, env={**environment, "TIFACE_PATIENCE": "0"}).returncode
    assert code == 75 and not mark.exists(), f"ended with {code}: {log.read_text()}"
    waiting = subprocess.Popen(task, env=environment)
    deadline = time.monotonic() + 300
    while log.read_text().count("in use by other processes") < 3:
        assert waiting.poll() is None and time.monotonic() < deadline, log.read_text()
        time.sleep(0.05)
    assert not (run / "iface/done.json").exists()
    for lock in held:
        lock.close()
    assert waiting.wait(300) == 0, log.read_text()
    assert (run / "iface/done.json").is_file()
    print(f"a task waited for a GPU, and learned when it was let go ({len(held)} held)")


def main():
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("tiface", type=Path)
    options.add_argument("--kills", type=int, default=20, help="of tasks")
    options.add_argument("--engine-kills", type=int, default=3)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--keep", type=Path, help="work here and leave it")
    options = options.parse_args()
    tiface = options.tiface.resolve()
    folder = options.keep or Path(tempfile.mkdtemp(prefix="fleet-"))
    folder.mkdir(parents=True, exist_ok=True)
    chance = random.Random(options.seed)
    os.environ["XDG_CONFIG_HOME"] = str(folder)  # no settings of the user
    config = folder / "heads.toml"
    config.write_text(SETTINGS)
    words = ["--preset", "draft", "--config", str(config), "--set", "render.method=tface,volume,raycast"]

    def run(*command, check=True):
        done = subprocess.run([tiface, *map(str, command)], capture_output=True, text=True)
        assert done.returncode == 0 or not check, f"{command}: {done.stderr}"
        return done

    captures, alone, runs = folder / "captures", folder / "alone", folder / "runs"
    captures.mkdir(exist_ok=True)
    for i, head in enumerate(HEADS):
        if not (captures / head).is_dir():
            shutil.move(photograph(tiface, folder / "photographed" / head, f"{60 + 2 * i}x72"), captures / head)
    good = [head for head in HEADS if head != BROKEN]
    frames = captures / BROKEN / "transforms_train.json"
    sound = frames.read_text()
    broken = json.loads(sound)
    broken["frames"][4]["transform_matrix"][0][3] = "north"
    frames.write_text(json.dumps(broken))

    # the tables are made of what can be made; a capture that is mended within its files gets its rows at the
    # next start
    engine_words = [sys.executable, "-m", "snakemake", "--snakefile", HERE / "Snakefile"]
    engine_words = [str(word) for word in [*engine_words, "--profile", HERE / "profiles/local", "--cores", "2"]]
    plan = engine_words, captures, folder / "planned/runs", tiface, config
    rows, _ = planned(*plan)
    assert rows == [f"{head}/paper" for head in good], rows
    frames.write_text(sound)
    rows, devices = planned(*plan)
    assert rows == [f"{head}/paper" for head in HEADS], rows
    frames.write_text(json.dumps(broken))
    # beside a GPU, what computes nothing on it does not ask for it
    assert devices.pop("iface") == devices.pop("mesh") == devices.pop("render") == "wgpu", devices
    assert devices.pop("mask") == devices.pop("metrics") == "cpu", devices
    print("the tables are planned: what cannot be made is left out until it is mended")
    wait_for_a_gpu(tiface, folder / "gpu", captures / good[0], words)

    begun = time.monotonic()
    for head in good:
        run("run", captures / head, "--run", alone / head, *words, "--quiet")
    undisturbed = time.monotonic() - begun

    # somebody holds a stage of one head: not now, but soon
    stage = runs / HELD / "tface"
    stage.mkdir(parents=True, exist_ok=True)
    lock = open(stage / ".lock", "a")
    fcntl.flock(lock, fcntl.LOCK_EX)
    held_until = time.monotonic() + 20

    engine_words += ["--config", f"captures={captures}", f"runs={runs}", f"tiface={tiface}", "threads=1"]
    engine_words += [f"options={' '.join(words)}"]
    log = open(folder / "engine.txt", "a")

    starts = 0

    def start():
        nonlocal starts
        starts += 1
        subprocess.run([*engine_words, "--unlock"], stdout=log, stderr=log, cwd=folder, check=True)
        return subprocess.Popen(engine_words, stdout=log, stderr=log, cwd=folder, start_new_session=True)

    kills = engine_kills = 0
    finished = {}  # checkpoints of fields that are done, as they were first seen

    def look():
        # a task killed between its record and its end is done again by the engine; what was learned must not be
        for record in runs.glob("*/*/done.json"):
            learned = record.with_name("checkpoint.safetensors")
            if learned.is_file():
                finished.setdefault(learned, (learned.stat().st_ino, learned.stat().st_mtime_ns))

    engine = start()
    next_kill = time.monotonic() + 2
    deadline = time.monotonic() + 30 * 60
    while engine.poll() is None or kills < options.kills or engine_kills < options.engine_kills:
        assert time.monotonic() < deadline, "the fleet does not come to its end"
        if engine.poll() is not None:
            assert finished, f"nothing works: {folder / 'engine.txt'}"
            # all is done before enough was killed: begin one head again
            head = chance.choice(good)
            for record in [r for r in finished if f"/{head}/" in str(r)]:
                del finished[record]
            shutil.rmtree(runs / head, ignore_errors=True)
            engine = start()
        time.sleep(0.05)
        look()
        if lock and time.monotonic() > held_until:
            lock.close()
            lock = None
        if time.monotonic() < next_kill:
            continue
        tasks = processes([str(tiface), "--run", str(runs)])
        tasks = [pid for pid in tasks if runs_program(pid, tiface)]
        if kills < options.kills and tasks:
            kills += kill([chance.choice(tasks)])
            next_kill = time.monotonic() + chance.uniform(0.2, 1.5)
        due = options.engine_kills and kills >= (engine_kills + 1) * options.kills // (options.engine_kills + 1)
        if engine_kills < options.engine_kills and due:
            engine_kills += 1
            everything = processes([str(HERE / "Snakefile"), str(runs)]) if engine_kills % 2 == 0 else []
            if everything:
                # the machine goes down: tasks, their shells, the engine
                kill(processes([str(runs)]))
            kill([engine.pid])
            engine.wait()
            engine = start()
            next_kill = time.monotonic() + 2
    code = engine.wait()
    while code != 1 or any(not (runs / head / "metrics/done.json").is_file() for head in good):
        # retries of one stage may be used up; an engine is started again then
        assert time.monotonic() < deadline
        look()
        engine = start()
        code = engine.wait()
    look()
    print(f"{kills} tasks and {engine_kills} engines killed; the engine ended with {code}")

    listed = run("status", *[runs / head for head in HEADS], "--json", check=False)
    objects = [o for o in map(json.loads, listed.stdout.splitlines()) if "run" in o]  # and one for the exit code
    states = {Path(o["run"]).name: o for o in objects}
    assert listed.returncode == 3, listed.stderr
    for head in good:
        assert states[head]["state"] == "done", states[head]
        ours, theirs = products(runs / head), products(alone / head)
        assert len(theirs) > 20 and ours.keys() == theirs.keys(), ours.keys() ^ theirs.keys()
        different = [name for name in theirs if ours[name] != theirs[name]]
        assert not different, f"{head}: {different}"
    cause = states[BROKEN]
    assert cause["state"] == "failed" and "transform_matrix" in cause["error"], cause
    assert len(finished) == 2 * len(good), finished
    for learned, when in finished.items():
        assert (learned.stat().st_ino, learned.stat().st_mtime_ns) == when, f"{learned} was learned again"
    attempts = (runs / ".fleet/log" / f"{BROKEN}.mask.txt").read_text().count("transform_matrix")
    assert 1 <= attempts <= starts, f"what cannot work was tried {attempts} times by {starts} engines"
    page, table = folder / "fleet.html", folder / "fleet.csv"
    assert page.is_file() and len(table.read_text().splitlines()) == len(HEADS) + 1
    assert BROKEN in page.read_text() and "transform_matrix" in table.read_text()
    print(f"{len(good)} heads as if undisturbed ({undisturbed:.0f} s alone), {len(finished)} fields learned once each")
    print(f"{BROKEN}: {cause['error']}")
    if not options.keep:
        shutil.rmtree(folder)


main()
