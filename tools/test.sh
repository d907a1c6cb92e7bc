#!/usr/bin/env bash
# The whole check, as the README gives it: format, lints, documentation, tests, and what independent
# readers say about our files. Nothing is skipped in silence; any failure fails the whole.
#
#     tools/test.sh              every part
#     tools/test.sh lint unit    only these parts, of: lint unit integration readers guides demo fuzz
#
# lint         format, clippy with all features and with none, documentation
# unit         unit tests, examples in the documentation
# integration  the program as a user runs it: commands, hostile files, kills
# readers      exported shapes in independent readers, and the annotation page in a browser
# guides       the commands of the guides, many heads under kills, the first look at a GPU
# demo         the demo head, trained for a few steps, in all readers and in a browser
# fuzz         a minute for every reader of foreign bytes
set -u -o pipefail
cd "$(dirname "$0")/.."

known=(lint unit integration readers guides demo fuzz)
parts=("$@")
[ $# -gt 0 ] || parts=("${known[@]}")
for part in "${parts[@]}"; do
  [[ " ${known[*]} " == *" $part "* ]] || { echo "unknown part $part; the parts are ${known[*]}" >&2; exit 2; }
done
wanted() { [[ " ${parts[*]} " == *" $1 "* ]]; }

target=${CARGO_TARGET_DIR:-target}
scratch=$(mktemp -d)
trap 'kill "${fuzzers[@]}" $gpu_tests 2> /dev/null; rm -rf "$scratch"' EXIT
results=()
failed=0
fuzzers=()
gpu_tests=

# step NAME COMMAND...: runs the command and records its result and time
step() {
  local name=$1 begin=$SECONDS
  shift
  printf '\n== %s\n   %s\n' "$name" "$*"
  if "$@"; then
    results+=("ok      $name ($((SECONDS - begin)) s)")
  else
    results+=("FAILED  $name ($((SECONDS - begin)) s)")
    failed=1
  fi
}

readers() {
  [ -x .venv/bin/python ] || "${PYTHON:-python3}" -m venv .venv || return
  .venv/bin/python -m pip install --quiet --disable-pip-version-check -r tools/readers/requirements.txt || return
  # open3d's wheel leaves four shared libraries to the system
  if ! .venv/bin/python -c 'import open3d' 2> /dev/null && command -v apt-get > /dev/null; then
    local sudo=
    [ "$(id -u)" = 0 ] || sudo=sudo
    $sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends \
      libusb-1.0-0 libgl1 libgomp1 libx11-6 > /dev/null || return
  fi
  .venv/bin/python -c 'import open3d, trimesh' &&
    npm ci --silent --no-audit --no-fund --prefix tools/readers
}

# Tests print what they skip; the summary repeats those lines, so that a skipped test is not taken for a passed one.
# One build serves them all: with the networks and with the kernels of GPUs.
tests() {
  local log
  log=$(mktemp "$scratch/tests.XXXXXX")
  cargo test --release --features matting,wgpu --no-fail-fast "$@" 2>&1 | tee "$log"
  local ended=${PIPESTATUS[0]}
  grep -h '^skipped:' "$log" | sort -u >> "$scratch/skipped"
  return "$ended"
}

# Unit tests on a GPU, beside the steps that follow: a driver in software compiles kernels on one processor, for minutes.
# The lock of the device is in the folder for temporary files.
gpu_tests_begin() {
  mkdir -p "$scratch/gpu"
  TMPDIR=$scratch/gpu tests --lib gpu -- --nocapture > "$scratch/gpu.log" &
  gpu_tests=$!
}

gpu_tests_end() {
  local ended=0
  wait "$gpu_tests" || ended=1
  gpu_tests=
  cat "$scratch/gpu.log"
  return $ended
}

# A Vulkan driver in software for the kernels of GPUs, whatever adapters the machine has; the summary names it where apt
# cannot install it.
vulkan_is_here() {
  driver() { find /usr/share/vulkan/icd.d -name 'lvp_icd*.json' 2> /dev/null | head -n 1; }
  if [ -z "$(driver)" ] && command -v apt-get > /dev/null; then
    local sudo=
    [ "$(id -u)" = 0 ] || sudo=sudo
    $sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends mesa-vulkan-drivers > /dev/null
  fi
  [ -n "$(driver)" ] || return
  VK_DRIVER_FILES=$(driver)
  export VK_DRIVER_FILES
  echo "$VK_DRIVER_FILES"
}

# A minute for every reader of foreign bytes, a quarter of it from each of four seeds, at low priority beside the other
# steps.
fuzz_begins() {
  local seed
  for seed in 1 2 3 4; do
    TIFACE_FUZZ_S=15 TIFACE_FUZZ_SEED=$seed nice -n 19 \
      cargo test --release --features matting,wgpu --test fuzz -- --nocapture > "$scratch/fuzz.$seed" 2>&1 &
    fuzzers+=($!)
  done
}

fuzz_ends() {
  local ended=0 fuzzer
  for fuzzer in "${fuzzers[@]}"; do wait "$fuzzer" || ended=1; done
  cat "$scratch"/fuzz.*
  return $ended
}

# A check in Python that says aloud what it had to skip.
check() {
  .venv/bin/python "$1" "$target/release/tiface" | tee "$scratch/check.log"
  local ended=${PIPESTATUS[0]}
  grep -h '^skipped:' "$scratch/check.log" >> "$scratch/skipped"
  return "$ended"
}

example() { "$target/release/examples/$1" "$2"; }

# Blender as a module has its own environment, since it brings its own numpy. It is skipped, and the summary says so, only
# if pip cannot install it (no wheel for this system, no network) or the system cannot load it.
blender_is_here() {
  [ -x .venv-blender/bin/python ] || "${PYTHON:-python3}" -m venv .venv-blender || return
  .venv-blender/bin/python -m pip install --quiet --disable-pip-version-check \
    -r tools/readers/requirements-blender.txt || return
  .venv-blender/bin/python -c 'import bpy' 2> /dev/null && return
  # its wheel leaves the libraries of a display to the system, even where nothing is displayed
  command -v apt-get > /dev/null || return
  local sudo=
  [ "$(id -u)" = 0 ] || sudo=sudo
  $sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends \
    libx11-6 libxi6 libxxf86vm1 libxfixes3 libxrender1 libsm6 libgl1 libegl1 libxkbcommon0 > /dev/null
  .venv-blender/bin/python -c 'import bpy'
}

# A browser for the pages; skipped, and the summary says so, where apt cannot install one.
browser_is_here() {
  "${CHROMIUM:-/usr/bin/chromium}" --version 2> /dev/null && return
  [ -z "${CHROMIUM:-}" ] && command -v apt-get > /dev/null || return
  local sudo=
  [ "$(id -u)" = 0 ] || sudo=sudo
  $sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends chromium > /dev/null
  /usr/bin/chromium --version
}

# COLMAP and FFmpeg, which find the cameras of photographs and of videos; tests skip aloud where apt cannot install them.
colmap_is_here() {
  command -v colmap && command -v ffmpeg && return
  command -v apt-get > /dev/null || return
  local sudo=
  [ "$(id -u)" = 0 ] || sudo=sudo
  $sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends colmap ffmpeg > /dev/null
  command -v colmap && command -v ffmpeg
}

# Everything that reads files, on one export: readers_agree NAME GLB [--lit] OPTIONS...
readers_agree() {
  local name=$1 glb=$2 lit=
  shift 2
  [ "${1:-}" != --lit ] || { lit=--lit; shift; }
  step "readers agree on $name" .venv/bin/python tools/readers/check_export.py "$glb" "$@"
  step "the Khronos validator accepts $name" node tools/readers/validate.mjs "$glb"
  if [ $blender = yes ]; then
    step "Blender agrees on $name" .venv-blender/bin/python tools/readers/check_blender.py "$glb" $lit "$@"
  fi
}

train_demo() {
  "$target/release/tiface" demo --run "$scratch/demo" --preset draft --set iface.steps=600 \
    --set tface.steps=400 --set baseline.steps=200 --set mesh.resolution=128 --set mesh.format=glb,obj,ply \
    --set mesh.lobes=2 --set render.method=tface,volume,raycast,textured
}

# The demo head again, with fewer triangles, another material and a smaller texture.
export_demo() {
  "$target/release/tiface" export "$scratch/demo" --material lit --triangles 3000 --texture 512 --format glb,obj,ply \
    --out "$scratch/exported/"
}

# The pages of the demo head, as a person opens them.
demo_pages() {
  "$target/release/tiface" preview "$scratch/demo" --size 512 --out "$scratch/demo/preview.png" &&
    "$target/release/tiface" report "$scratch/demo" "$scratch/demo/capture" --out "$scratch/demo/runs.html" &&
    node tools/page/check_report.mjs "$scratch/demo" &&
    node tools/page/check_watch.mjs "$target/release/tiface" "$scratch/demo"
}

# Tools of others, set up once by the first part that needs them.
readers_ready=no
need_readers() {
  [ $readers_ready = yes ] && return
  readers_ready=yes
  step "independent readers are installed" readers
  blender=yes
  printf '\n== Blender is installed\n'
  if ! blender_is_here; then
    blender=no
    results+=("SKIPPED Blender: tools/readers/requirements-blender.txt could not be installed, or not be loaded")
  fi
  browser=yes
  printf '\n== a browser is installed\n'
  if ! browser_is_here; then
    browser=no
    results+=("SKIPPED the annotation page, reports, and lobes in three.js: neither CHROMIUM nor /usr/bin/chromium runs, and apt cannot install it")
  fi
}

vulkan_ready=no
need_vulkan() {
  [ $vulkan_ready = yes ] && return
  vulkan_ready=yes
  printf '\n== Vulkan in software is installed\n'
  if ! vulkan_is_here; then
    results+=("SKIPPED a Vulkan in software for the kernels of GPUs: apt cannot install mesa-vulkan-drivers")
  fi
}

need_colmap() {
  printf '\n== COLMAP and FFmpeg are installed\n'
  colmap_is_here || results+=("SKIPPED COLMAP or FFmpeg, which find cameras: apt cannot install colmap and ffmpeg")
}

built=no
need_program() {
  [ $built = yes ] && return
  built=yes
  step "build" cargo build --release --features matting,wgpu --bins --examples
}

lint() {
  step "format" cargo fmt --all -- --check
  # Everything is checked once with all features, and once without any; then built once.
  step "lints, all features" cargo clippy --release --all-targets --features matting,wgpu -- -D warnings
  step "lints, no features" cargo clippy --release -- -D warnings
  step "documentation" env RUSTDOCFLAGS="-D warnings" cargo doc --release --features matting,wgpu --no-deps
}

unit() {
  need_vulkan
  step "unit tests are built" cargo test --release --features matting,wgpu --lib --bins --no-run
  gpu_tests_begin
  step "unit tests" tests --lib --bins -- --nocapture --skip gpu
  step "examples in the documentation" tests --doc -- --nocapture
}

integration() {
  need_program
  need_vulkan
  need_colmap
  step "integration tests" tests --test '*' -- --nocapture
}

shapes() {
  need_readers
  need_program
  mkdir -p "$scratch/click"
  step "the annotation page is written" example click_page "$scratch/click/page.html"
  if [ $browser = yes ]; then
    step "a browser clicks on the page" node tools/page/check_page.mjs "$scratch/click/page.html"
  fi
  step "a sphere is written" example sphere_to_glb "$scratch/sphere"
  readers_agree "the sphere" "$scratch/sphere/sphere.glb"
  step "a textured globe is written" example textured_sphere "$scratch/globe"
  readers_agree "the globe" "$scratch/globe/globe.glb"
  step "three.js agrees on the globe" node tools/readers/check_three.mjs "$scratch/globe/globe.glb"
  # with a normal map and a second texture
  cp "$scratch/globe/globe.png" "$scratch/globe/globe_rich.png"
  readers_agree "the rich globe" "$scratch/globe/globe_rich.glb"
  step "three.js agrees on the rich globe" node tools/readers/check_three.mjs "$scratch/globe/globe_rich.glb"
  # with soft layers, which trimesh and open3d take for part of the surface
  cp "$scratch/globe/globe.png" "$scratch/globe/globe_soft.png"
  step "the Khronos validator accepts the soft globe" node tools/readers/validate.mjs "$scratch/globe/globe_soft.glb"
  step "three.js agrees on the soft globe" node tools/readers/check_three.mjs "$scratch/globe/globe_soft.glb"
  if [ $blender = yes ]; then
    step "Blender agrees on the soft globe" .venv-blender/bin/python tools/readers/check_blender.py "$scratch/globe/globe_soft.glb" --up 0 0 1
  fi
  step "a published checkpoint is converted" .venv/bin/python tools/reference/tensorf_checkpoint.py --check tests/reference
}

guides() {
  need_readers
  need_vulkan
  need_colmap
  need_program
  step "the engine of many heads is installed" .venv/bin/python -m pip install --quiet --disable-pip-version-check \
    -r tools/fleet/requirements.txt
  if [ -n "${VK_DRIVER_FILES:-}" ]; then
    step "a first look at a GPU runs" env SHARE=1 CARGO_TARGET_DIR="$target" tools/gpu/first_look.sh vulkan:0 "$scratch/look"
  fi
  step "many heads outlive kills" check tools/fleet/check_fleet.py
  step "the figures of the documents are those of runs" .venv/bin/python tools/reference/figures.py check
  step "the commands of the guides work" check tools/guides/check_guides.py
}

demo() {
  need_readers
  need_program
  step "the demo head is reconstructed" train_demo
  readers_agree "the demo head" "$scratch/demo/mesh/head.glb" --up 0 0 1
  step "three.js agrees on the demo head" node tools/readers/check_three.mjs "$scratch/demo/mesh/head.glb"
  step "the demo head is exported" export_demo
  readers_agree "the exported head" "$scratch/exported/head.glb" --lit --up 0 0 1
  if [ $browser = yes ]; then
    step "a browser opens its pages" demo_pages
    step "three.js shows its lobes" node tools/readers/check_lobes.mjs "$scratch/demo"
  fi
  if [ $blender = yes ]; then
    step "Blender imports the run" .venv-blender/bin/python tools/readers/check_addon.py "$scratch/demo"
    step "Blender shows its lobes" .venv-blender/bin/python tools/readers/check_lobes.py "$scratch/demo"
  fi
}

wanted lint && lint
wanted unit && unit
wanted integration && integration
wanted fuzz && fuzz_begins
wanted readers && shapes
wanted guides && guides
wanted demo && demo
wanted unit && step "unit tests of GPU kernels" gpu_tests_end
wanted fuzz && step "no input makes a reader panic, hang or fill the memory" fuzz_ends

# how long which step took, and what could not run
printf '\n== summary\n'
printf '%s\n' "${results[@]}"
[ -s "$scratch/skipped" ] && { printf 'tests that this machine could not run:\n'; cat "$scratch/skipped"; }
exit $failed
