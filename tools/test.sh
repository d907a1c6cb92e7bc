#!/usr/bin/env bash
# The whole check, as the README gives it: format, lints, documentation, tests, and what independent
# readers say about our files. Nothing is skipped in silence; any failure fails the whole.
#
#     tools/test.sh            everything
#     tools/test.sh --no-demo  without training the demo head (the readers then see the sphere and the globe)
set -u -o pipefail
cd "$(dirname "$0")/.."

demo=yes
for option in "$@"; do
  case "$option" in
    --no-demo) demo=no ;;
    *) echo "unknown option $option" >&2; exit 2 ;;
  esac
done

target=${CARGO_TARGET_DIR:-target}
scratch=$(mktemp -d)
trap 'kill "${fuzzers[@]}" 2> /dev/null; rm -rf "$scratch"' EXIT
results=()
failed=0
fuzzers=()

# step NAME COMMAND...: runs it, shows it, remembers how it ended
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

# Tests skip aloud what a machine cannot give; here those lines are shown again, so that nobody
# takes a skipped test for a passed one. One build serves them all: with the networks and with the kernels of GPUs.
tests() {
  cargo test --release --features matting,wgpu --no-fail-fast -- --nocapture 2>&1 | tee "$scratch/tests.log"
  local ended=${PIPESTATUS[0]}
  grep -h '^skipped:' "$scratch/tests.log" | sort -u > "$scratch/skipped"
  return "$ended"
}

# A Vulkan in software for the kernels of GPUs, rather than whichever adapter is here; left out aloud where apt cannot
# get it.
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

# A minute for every reader of foreign bytes, a quarter of it from each of four beginnings, beside whatever else is done:
# it takes what the other steps leave of the processors.
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

# Blender as a module has its own environment: it brings its own numpy. Only when pip cannot get it
# (no wheel for this system, no network) or the system cannot load it is it left out, and the summary says so.
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

# A browser for the page to click on; left out aloud where there is none and apt cannot get it.
browser_is_here() {
  "${CHROMIUM:-/usr/bin/chromium}" --version 2> /dev/null && return
  [ -z "${CHROMIUM:-}" ] && command -v apt-get > /dev/null || return
  local sudo=
  [ "$(id -u)" = 0 ] || sudo=sudo
  $sudo apt-get update -qq && $sudo apt-get install -y -qq --no-install-recommends chromium > /dev/null
  /usr/bin/chromium --version
}

# Everything that reads files, on one export
readers_agree() {
  local name=$1 glb=$2
  shift 2
  step "readers agree on $name" .venv/bin/python tools/readers/check_export.py "$glb" "$@"
  step "the Khronos validator accepts $name" node tools/readers/validate.mjs "$glb"
  if [ $blender = yes ]; then
    step "Blender agrees on $name" .venv-blender/bin/python tools/readers/check_blender.py "$glb" "$@"
  fi
}

train_demo() {
  "$target/release/tiface" demo --run "$scratch/demo" --preset draft --set iface.steps=600 \
    --set tface.steps=400 --set baseline.steps=200 --set mesh.resolution=128 --set mesh.format=glb,obj,ply \
    --set mesh.lobes=2 --set render.method=tface,volume,raycast,textured
}

# The pages of the demo head, as a person opens them.
demo_pages() {
  "$target/release/tiface" preview "$scratch/demo" --size 512 --out "$scratch/demo/preview.png" &&
    "$target/release/tiface" report "$scratch/demo" "$scratch/demo/capture" --out "$scratch/demo/runs.html" &&
    node tools/page/check_report.mjs "$scratch/demo" &&
    node tools/page/check_watch.mjs "$target/release/tiface" "$scratch/demo"
}

step "independent readers are here" readers
step "format" cargo fmt --all -- --check
# Everything is checked once with all features, and once without any; then built once.
step "lints, all features" cargo clippy --release --all-targets --features matting,wgpu -- -D warnings
step "lints, no features" cargo clippy --release -- -D warnings
step "documentation" env RUSTDOCFLAGS="-D warnings" cargo doc --release --features matting,wgpu --no-deps
step "build" cargo build --release --features matting,wgpu --bins --examples
printf '\n== Vulkan is here\n'
if ! vulkan_is_here; then
  results+=("SKIPPED a Vulkan in software for the kernels of GPUs: apt cannot install mesa-vulkan-drivers")
fi
step "tests" tests
fuzz_begins
blender=yes
printf '\n== Blender is here\n'
if ! blender_is_here; then
  blender=no
  results+=("SKIPPED Blender: tools/readers/requirements-blender.txt could not be installed, or not be loaded")
fi
browser=yes
printf '\n== a browser is here\n'
if ! browser_is_here; then
  browser=no
  results+=("SKIPPED the page to click on, reports, and lobes in three.js: neither CHROMIUM nor /usr/bin/chromium runs, and apt cannot install it")
fi
mkdir -p "$scratch/click"
step "the page to click on is written" example click_page "$scratch/click/page.html"
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
step "the engine of many heads is here" .venv/bin/python -m pip install --quiet --disable-pip-version-check \
  -r tools/fleet/requirements.txt
if [ -n "${VK_DRIVER_FILES:-}" ]; then
  step "a first look at a GPU runs" env SHARE=1 CARGO_TARGET_DIR="$target" tools/gpu/first_look.sh vulkan:0 "$scratch/look"
fi
step "many heads outlive kills" check tools/fleet/check_fleet.py
step "the commands of the guides work" check tools/guides/check_guides.py
if [ $demo = yes ]; then
  step "the demo head is reconstructed" train_demo
  readers_agree "the demo head" "$scratch/demo/mesh/head.glb" --up 0 0 1
  step "three.js agrees on the demo head" node tools/readers/check_three.mjs "$scratch/demo/mesh/head.glb"
  if [ $browser = yes ]; then
    step "a browser opens its pages" demo_pages
    step "three.js shows its lobes" node tools/readers/check_lobes.mjs "$scratch/demo"
  fi
  if [ $blender = yes ]; then
    step "Blender shows its lobes" .venv-blender/bin/python tools/readers/check_lobes.py "$scratch/demo"
  fi
else
  results+=("SKIPPED the demo head, as asked by --no-demo")
fi
step "no input makes a reader panic, hang or fill the memory" fuzz_ends

# how long which step took, and what could not run
printf '\n== summary\n'
printf '%s\n' "${results[@]}"
[ -s "$scratch/skipped" ] && { printf 'tests that this machine could not run:\n'; cat "$scratch/skipped"; }
exit $failed
