"""Runs every command of the guides as it stands there, on tiny heads.

    python tools/guides/check_guides.py target/release/tiface [GUIDE.md ...]

Blocks of `sh` run line by line in one folder per guide, where captures lie as the guide has them; a user's own
configuration makes them small. Blocks of `python` run with this interpreter. `sh colmap` needs COLMAP and photographs of
something real; it is left out aloud where they are not. `sh cluster` needs GPUs or a cluster: what the engine would do
there is planned alone. `yaml kubernetes` is a job for Kubernetes, and only read.
"""

import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tools"))
from tiny_heads import SETTINGS, photograph  # noqa: E402

GUIDES = [ROOT / "docs" / name for name in ("artist.md", "export.md", "researcher.md", "many-heads.md")]


def blocks(text):
    """Kind and lines of each fenced block; a line that ends in a backslash goes on."""
    for kind, body in re.findall(r"^```(\S[^\n]*)\n(.*?)^```", text, re.M | re.S):
        yield kind.strip(), body


def clicks(capture):
    """Clicks as a person would make them on three photographs: the middle of the head, and two corners."""
    names = [f["file_path"] for f in json.loads((capture / "transforms_train.json").read_text())["frames"]]
    points = [{"x": x, "y": y, "label": label} for x, y, label in ((32, 40, 1), (32, 28, 1), (2, 2, 0), (61, 2, 0))]
    return {"frames": [{"file_path": name, "points": points} for name in (names[0], names[3], names[6])]}


def prepare(tiface, folder, environment):
    """Captures as the guides name them: captures/002_00 and 003_00 with masks, head with COLMAP's cameras and none."""
    for name, size in (("002_00", "64x80"), ("003_00", "66x80")):
        made = photograph(tiface, folder / "photographed" / name, size, environment)
        (folder / "captures").mkdir(exist_ok=True)
        shutil.move(made, folder / "captures" / name)
    subprocess.run([tiface, "convert", "captures/002_00", "--to", "colmap", "--out", "head", "--quiet"], cwd=folder, env=environment, check=True)
    for masks in (folder / "head").glob("*mask*"):
        shutil.rmtree(masks)


def run(guide, tiface, seen):
    folder = Path(tempfile.mkdtemp(prefix=f"{guide.stem}-"))
    shown = folder / "program"
    shown.mkdir()
    (shown / "tiface").symlink_to(tiface)
    settings = folder / "settings/tiface"
    settings.mkdir(parents=True)
    environment = {
        **os.environ,
        "PATH": f"{shown}:{Path(sys.executable).parent}:{os.environ['PATH']}",
        "XDG_CONFIG_HOME": str(folder / "settings"),
        "NO_COLOR": "1",
    }
    prepare(tiface, folder, environment)
    (settings / "config.toml").write_text(SETTINGS)
    (folder / "tools").symlink_to(ROOT / "tools")
    count = 0
    for kind, body in blocks(guide.read_text()):
        if kind == "sh colmap":
            why = colmap(body, environment)
            print(f"skipped: {guide.name}: COLMAP: {why}" if why else f"{guide.name}: COLMAP placed the cameras")
        elif kind == "python":
            subprocess.run([sys.executable, "-c", body], cwd=folder, env=environment, check=True)
            count += 1
        elif kind == "sh":
            for line in body.replace("\\\n", " ").splitlines():
                if line.strip() and not line.startswith("#"):
                    if "--prompts prompts.json" in line and not (folder / "prompts.json").is_file():
                        # what a person does in the browser in between
                        (folder / "prompts.json").write_text(json.dumps(clicks(folder / "captures/002_00")))
                    done = subprocess.run(["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True)
                    expected = re.search(r"# exit code (\d+)", line)
                    assert done.returncode == int(expected[1] if expected else 0), f"{guide.name}: `{line}` ended with {done.returncode}\n{done.stdout}{done.stderr}"
                    count += 1
        elif kind == "sh cluster":
            count += cluster(guide, body, folder, environment)
        elif kind == "yaml kubernetes":
            kubernetes(body)
        else:
            assert kind == "text", f"{guide.name}: a block of `{kind}` is not tested"
        seen.append(kind)
    print(f"{guide.name}: {count} commands")
    assert count
    shutil.rmtree(folder)


def colmap(body, environment):
    """Runs COLMAP on photographs of something real; the reason where that cannot be done."""
    photographs = ROOT.parent / "shared/data/captures/fox/images"
    if not shutil.which("colmap"):
        return "it is not installed"
    if not photographs.is_dir():
        return "there are no photographs of something real"
    with tempfile.TemporaryDirectory() as folder:
        images = Path(folder) / "photographs"
        images.mkdir(parents=True)
        for i, photograph in enumerate(sorted(photographs.iterdir())):
            if i < 12:
                shutil.copy(photograph, images)
        done = subprocess.run(["bash", "-e", "-c", body], cwd=folder, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        found = subprocess.run(["tiface", "inspect", "head"], cwd=folder, env=environment, capture_output=True, text=True)
        assert "COLMAP" in found.stdout, found.stdout + found.stderr
    return ""


def cluster(guide, body, folder, environment):
    """Plans what the engine would do on GPUs and clusters; the number of these commands."""
    count = 0
    for line in body.replace("\\\n", " ").splitlines():
        words = line.split()
        if words[:2] == ["pip", "install"]:
            done = subprocess.run([sys.executable, "-m", *words, "--quiet"], cwd=folder, env=environment, capture_output=True, text=True)
            if done.returncode:
                print(f"skipped: {guide.name}: a plan for a cluster: `{line}` failed: {done.stderr.strip()[-200:]}")
                return count
        elif words[:1] == ["snakemake"]:
            # captures lie here and not where all nodes would look for them; what is done already is planned
            # as well, so that the recipe is asked for each task's threads, memory, time and words
            line = line.replace("=/data/", "=") + " --dry-run --forceall --printshellcmds"
            done = subprocess.run(["bash", "-c", line], cwd=folder, env=environment, capture_output=True, text=True)
            answer = done.stdout + done.stderr
            assert done.returncode == 0, f"{guide.name}: `{line}` ended with {done.returncode}\n{answer}"
            assert " iface CAPTURE " in answer and "--device wgpu" in answer and "gpu=1" in answer, answer
        else:
            continue
        count += 1
    return count


def kubernetes(text):
    """Reads a job of Kubernetes, which must use as many threads as it requests cores."""
    import yaml  # comes with the engine, which a guide installs first

    job = yaml.safe_load(text)
    pod = job["spec"]["template"]["spec"]["containers"][0]
    threads = {e["name"]: e["value"] for e in pod["env"]}["RAYON_NUM_THREADS"]
    assert job["kind"] == "Job" and threads == pod["resources"]["requests"]["cpu"], job


def main():
    tiface = str(Path(sys.argv[1]).resolve())
    seen = []
    for guide in [Path(p).resolve() for p in sys.argv[2:]] or GUIDES:
        run(guide, tiface, seen)


main()
