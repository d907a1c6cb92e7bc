#!/usr/bin/env bash
# The net under a refactoring. Trains a short demo and, where the captures are there, a short `lps` with
# masks from clicks, through every stage; prints one line `sha256  what` for every picture, mesh and tensor.
# Training is deterministic, so two builds of one meaning print the same list:
#
#     tools/same.sh > before.txt     # then change the code, then
#     tools/same.sh | diff before.txt -
#
# TIFACE names the program (default: target/release/tiface, built first); TIFACE_SHARED the folder with
# data/captures/lps; SAME_KEEP a folder to keep the runs in. Only what a run made is hashed: no times, no
# settings, no fingerprints. A checkpoint counts by its tensors, one line each, not by its header.
set -eu -o pipefail
cd "$(dirname "$0")/.."

program=${TIFACE:-}
if [ -z "$program" ]; then
  cargo build --release --quiet
  program=${CARGO_TARGET_DIR:-target}/release/tiface
fi
shared=${TIFACE_SHARED:-../shared}
scratch=${SAME_KEEP:-$(mktemp -d)}
[ -n "${SAME_KEEP:-}" ] || trap 'rm -rf "$scratch"' EXIT
mkdir -p "$scratch"
if [ -e "$scratch/demo" ] || [ -e "$scratch/lps" ]; then
  echo "$scratch holds runs already: what is done would not be made again, and nothing compared" >&2
  exit 2
fi
# nothing of the user's own configuration
export XDG_CONFIG_HOME=$scratch/none

settings=(
  --preset draft --device cpu --quiet
  --set iface.steps=200 --set iface.rays=512 --set iface.samples=8192
  --set tface.steps=120 --set tface.fields=2 --set tface.rays=1024
  --set tface.voxels_start=32768 --set tface.voxels_final=110592
  --set baseline.steps=60 --set baseline.rays=512
  --set mesh.resolution=96 --set mesh.triangles=6000 --set mesh.texture_px=512
  --set mesh.normal_map=true --set mesh.format=glb,obj,ply
  --set render.method=baseline,tface,volume,raycast,textured
  --set ensemble.members=tface,volume --set ensemble.weights=0.7,0.3
)
# more settings, for comparing with a program that wants them under another name
read -r -a extra <<< "${SAME_EXTRA:-}"

"$program" demo --run "$scratch/demo" "${settings[@]}" "${extra[@]}" >&2
heads=(demo)
if [ -d "$shared/data/captures/lps" ]; then
  lps=$shared/data/captures/lps
  "$program" run "$lps" --run "$scratch/lps" --prompts "$lps/prompts.json" "${settings[@]}" "${extra[@]}" >&2
  heads+=(lps)
else
  echo "skipped: lps, for $shared/data/captures/lps is absent (TIFACE_SHARED names its folder)" >&2
fi

cd "$scratch"
python3 - "${heads[@]}" << 'PYTHON'
import hashlib, json, pathlib, sys

made = {".png", ".jpg", ".exr", ".glb", ".obj", ".mtl", ".ply", ".safetensors"}
for head in sys.argv[1:]:
    for path in sorted(pathlib.Path(head).rglob("*")):
        if path.suffix not in made or "capture" in path.parts[1:2]:
            continue
        data = path.read_bytes()
        if path.suffix != ".safetensors":
            print(hashlib.sha256(data).hexdigest(), path)
            continue
        end = 8 + int.from_bytes(data[:8], "little")
        for name, tensor in sorted(json.loads(data[8:end]).items()):
            if name != "__metadata__":
                first, last = tensor["data_offsets"]
                digest = hashlib.sha256(data[end + first:end + last]).hexdigest()
                print(digest, f"{path}:{name}", tensor["dtype"], *tensor["shape"])
PYTHON
