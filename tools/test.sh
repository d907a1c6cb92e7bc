#!/usr/bin/env bash
# The check that the README gives: every claim once, in 25 minutes on two cores from an empty folder.
#
#     tools/test.sh                    the check: lint unit integration readers demo fuzz
#     tools/test.sh lint unit          only these parts
#     tools/test.sh unit NAME...       only tests whose names contain one of these; likewise integration
#     tools/test.sh all                the check, then every part below
#
# lint         format, width of comments, clippy with all features, a check without any, documentation and its
#              figures
# unit         unit tests, examples in the documentation
# integration  the program as a user runs it: commands, hostile files, kills
# readers      exported shapes in trimesh, open3d, three.js and the Khronos validator
# demo         the demo head, from photographs to views, in all of these readers and Pixar's USD; its files
#              beside their schemas
# fuzz         three seconds for every reader of foreign bytes
#
# `all` adds loops and breadth. Each claim has its test in the check, or is about a program of somebody else:
#
# long         tests marked `#[ignore = "long: …"]`: GPU trainings at full length and of every preset, kills
#              by the dozen, every write that fails, every change of every byte of a model, masks of all views
#              of two captures, sweeps of cases, inputs of `../shared`, gradients of the device against f64.
#              The check makes the same claims on fewer steps, kills, bytes, views and cases, and compares the
#              device with the CPU.
# fuzz         a minute for every reader instead of three seconds
# gpu          `tools/gpu/first_look.sh`, eleven trainings on a driver in software, six minutes. The check
#              trains each field on that driver once, beside the CPU.
# fleet        six heads under kills of tasks and of the engine, two and a half minutes. Only the recipe in
#              `tools/fleet` is not in the check; the kills, waits and exit codes that it relies on are, in
#              `resume`, `accidents` and `cli`.
# guides       every command of four guides, five minutes. The commands themselves are in the check, in `cli`.
# blender      exports, lobes and the import of a run in Blender: a download of 350 MB. The check reads the
#              same files with five other readers.
# browser      the annotation page, the report and the page of many runs in Chromium: a download of 90 MB and
#              scripts of a minute. The check reads the pages' content in unit tests.
set -u -o pipefail
cd "$(dirname "$0")/.."

short=(lint unit integration readers demo fuzz)
long=(long gpu fleet guides blender browser)
known=("${short[@]}" "${long[@]}")
names=()
if [ "${1:-}" = all ]; then
  [ $# = 1 ] || { echo "all takes nothing else" >&2; exit 2; }
  parts=("${known[@]}")
elif [ $# -gt 1 ] && [[ $1 =~ ^(unit|integration)$ ]] && [[ " ${known[*]} " != *" $2 "* ]]; then
  parts=("$1")
  names=("${@:2}")
else
  parts=("${@:-${short[@]}}")
  [ $# -gt 0 ] || parts=("${short[@]}")
fi
for part in "${parts[@]}"; do
  [[ " ${known[*]} " == *" $part "* ]] || { echo "unknown part $part; the parts are ${known[*]}, or all" >&2; exit 2; }
done
wanted() { [[ " ${parts[*]} " == *" $1 "* ]]; }
all=no
[ "${1:-}" != all ] || all=yes

target=${CARGO_TARGET_DIR:-target}
scratch=$(mktemp -d)
declare -A background=()
trap 'kill "${background[@]}" 2> /dev/null; rm -rf "$scratch"' EXIT
results=()
failed=0
# devices have their locks there, and other processes of this machine theirs elsewhere
mkdir "$scratch/tmp"
export TMPDIR=$scratch/tmp

# step NAME COMMAND...: runs the command and records its result and time
step() {
  local name=$1 begin=$SECONDS
  shift
  printf '\n== %s\n   %s\n' "$name" "$*"
  if "$@"; then
    results+=("$(printf 'ok      %4d s  %s' $((SECONDS - begin)) "$name")")
  else
    results+=("$(printf 'FAILED  %4d s  %s' $((SECONDS - begin)) "$name")")
    failed=1
  fi
}
skip() { results+=("SKIPPED         $*"); }

# begin WORD COMMAND...: runs the command beside the steps that follow; end WORD: waits for it and shows what
# it said
begin() {
  local word=$1
  shift
  "$@" > "$scratch/$word.said" 2>&1 &
  background[$word]=$!
}
end() {
  local ended=0
  wait "${background[$1]}" || ended=1
  unset "background[$1]"
  cat "$scratch/$1.said"
  return $ended
}

## Tools of others, installed beside the first build.

apt_installs() {
  command -v apt-get > /dev/null || return
  local sudo=
  [ "$(id -u)" = 0 ] || sudo=sudo
  [ -e "$scratch/apt" ] || $sudo apt-get update -qq
  : > "$scratch/apt"
  $sudo apt-get install -y -qq --no-install-recommends "$@" > /dev/null
}

python_readers() {
  [ -x .venv/bin/python ] || "${PYTHON:-python3}" -m venv .venv || return
  .venv/bin/python -m pip install --quiet --disable-pip-version-check -r tools/readers/requirements.txt || return
  # open3d's wheel leaves four shared libraries to the system
  .venv/bin/python -c 'import open3d' 2> /dev/null || apt_installs libusb-1.0-0 libgl1 libgomp1 libx11-6 || return
  .venv/bin/python -c 'import open3d, trimesh; from pxr import Usd' &&
    npm ci --silent --no-audit --no-fund --prefix tools/readers
}

# Blender as a module has its own environment, since it brings its own numpy. Its wheel leaves the libraries
# of a display to the system, even where nothing is displayed.
blender() {
  [ -x .venv-blender/bin/python ] || "${PYTHON:-python3}" -m venv .venv-blender || return
  .venv-blender/bin/python -m pip install --quiet --disable-pip-version-check \
    -r tools/readers/requirements-blender.txt || return
  .venv-blender/bin/python -c 'import bpy' 2> /dev/null && return
  apt_installs libx11-6 libxi6 libxxf86vm1 libxfixes3 libxrender1 libsm6 libgl1 libegl1 libxkbcommon0
  .venv-blender/bin/python -c 'import bpy'
}

# A Vulkan driver in software for the kernels of GPUs, whatever adapters the machine has.
driver() { find /usr/share/vulkan/icd.d -name 'lvp_icd*.json' 2> /dev/null | head -n 1; }
vulkan() { [ -n "$(driver)" ] || apt_installs mesa-vulkan-drivers; }

browser() {
  "${CHROMIUM:-/usr/bin/chromium}" --version 2> /dev/null && return
  [ -z "${CHROMIUM:-}" ] && apt_installs chromium && /usr/bin/chromium --version
}

# COLMAP and FFmpeg find the cameras of photographs and of videos.
colmap() { { command -v colmap && command -v ffmpeg; } > /dev/null || apt_installs colmap ffmpeg; }

# The engine of many heads.
fleet_engine() {
  python_readers && .venv/bin/python -m pip install --quiet --disable-pip-version-check -r tools/fleet/requirements.txt
}

# installs WORD...: runs these functions, one after the other, and records which failed
installs() {
  local word
  for word in "$@"; do
    "$word" > "$scratch/install.$word" 2>&1 < /dev/null || : > "$scratch/missing.$word"
  done
}
has() { [ ! -e "$scratch/missing.$1" ]; }

install_begins() {
  local words=()
  if wanted unit || wanted integration || wanted long || wanted gpu || wanted fleet; then words+=(vulkan); fi
  if wanted integration || wanted long || wanted guides; then words+=(colmap); fi
  if wanted readers || wanted demo || wanted browser || wanted guides; then words+=(python_readers); fi
  if wanted fleet || wanted guides; then words+=(fleet_engine); fi
  if wanted blender; then words+=(blender); fi
  if wanted browser; then words+=(browser); fi
  begin install installs "${words[@]}"
}

installed=no
install_ends() {
  [ $installed = no ] || return
  installed=yes
  end install
  cat "$scratch"/install.* 2> /dev/null
  has vulkan || skip "a Vulkan in software for the kernels of GPUs: apt cannot install mesa-vulkan-drivers"
  has colmap || skip "COLMAP or FFmpeg, which find cameras: apt cannot install colmap and ffmpeg"
  has blender || skip "Blender: tools/readers/requirements-blender.txt could not be installed, or not be loaded"
  has browser || skip "pages in a browser: neither CHROMIUM nor /usr/bin/chromium runs, and apt cannot install it"
  if wanted readers || wanted demo; then step "independent readers are installed" has python_readers; fi
  if wanted fleet; then step "the engine of many heads is installed" has fleet_engine; fi
  VK_DRIVER_FILES=$(driver)
  if [ -n "$VK_DRIVER_FILES" ]; then export VK_DRIVER_FILES; else unset VK_DRIVER_FILES; fi
}

## One build serves all parts: with the networks and with the kernels of GPUs.

build() {
  cargo test --release --workspace --features matting,wgpu --no-run 2>&1 | tee "$scratch/build.log"
  return "${PIPESTATUS[0]}"
}

built=no
need_build() {
  [ $built = no ] || return
  built=yes
  step "build of program, examples and tests" build
  install_ends
}

# executables WHAT: the paths of programs of tests, as the build named them
executables() { sed -n "s|.*Executable.*$1.* (\(.*\))$|\1|p" "$scratch/build.log"; }
executable() { executables "$1" | tail -n 1; }

# tests LOG PROGRAM OPTIONS...: runs a program of tests. Each test is shown as it ends. The summary has what
# failing ones said, and what was skipped, so that a skipped test is not taken for a passed one. Times are an
# unstable option of Rust's test harness, which the variable allows.
tests() {
  local log=$scratch/$1.log program=$2
  shift 2
  [ -x "$program" ] || { echo "the tests were not built"; return 1; }
  : > "$log"
  RUSTC_BOOTSTRAP=1 "$program" -Z unstable-options --report-time --show-output "$@" > "$log" 2>&1 &
  local pid=$!
  tail -n +1 --pid=$pid -f "$log" | grep -E --line-buffered '^test .* \.\.\. |^test result'
  wait $pid
  local ended=$?
  [ $ended = 0 ] || sed -n '/^failures:/,$p' "$log" | tee -a "$scratch/failures"
  grep -h '^skipped:' "$log" | sort -u >> "$scratch/skipped"
  sed -n 's/^test \(.*\) \.\.\. [a-zA-Z]* <\([0-9.]*\)s>$/\2 \1/p' "$log" >> "$scratch/times"
  return $ended
}

check_tests=tests/check/main.rs
fuzz_tests=tests/fuzz.rs

lint() {
  step "format" cargo fmt --all -- --check
  step "comments of at most 100 columns" "${PYTHON:-python3}" tools/reference/wrap_comments.py --check
  # once with all features, and once without any; then built once
  step "lints" cargo clippy --release --workspace --all-targets --features matting,wgpu -- -D warnings
  step "no features" cargo clippy --release --workspace --lib --bins -- -D warnings
  # alone, without what other packages turn on
  step "tiface-surface alone" cargo check --release -p tiface-surface
  step "tiface-capture alone" cargo check --release -p tiface-capture
  step "documentation" env RUSTDOCFLAGS="-D warnings" cargo doc --release --workspace --features matting,wgpu --no-deps
  step "figures of the documents" "${PYTHON:-python3}" tools/reference/figures.py check
}

# unit_tests OPTIONS...: the unit tests of all packages, one after the other
unit_tests() {
  local program programs ended=0
  programs=$(executables src/lib.rs)
  [ "$(wc -w <<< "$programs")" = 5 ] || { echo "the tests of five packages were not built"; return 1; }
  for program in $programs; do
    tests "$(basename "$program")" "$program" "$@" || ended=1
  done
  return $ended
}

# Kernels are compiled for a driver in software on one CPU, which leaves the other to the integration tests.
unit_begins() {
  need_build
  begin unit unit_tests "${names[@]}"
}
unit_ends() {
  step "unit tests" end unit
  [ ${#names[@]} -gt 0 ] ||
    step "examples in the documentation" cargo test --release --workspace --features matting,wgpu --doc
}

integration() {
  need_build
  step "integration tests" tests check "$(executable $check_tests)" "${names[@]}"
}

# Low priority beside the other steps; for `all` a quarter of a minute from each of four seeds.
fuzz() {
  local seed seeds=1 seconds=3 ended=0
  [ $all = no ] || { seeds="1 2 3 4"; seconds=15; }
  for seed in $seeds; do
    TIFACE_FUZZ_S=$seconds TIFACE_FUZZ_SEED=$seed nice -n 19 "$(executable $fuzz_tests)" --nocapture || ended=1
  done
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

# readers_agree NAME GLB OPTIONS...: everything that reads files, on one export
readers_agree() {
  local name=$1 glb=$2
  shift 2
  step "readers agree on $name" .venv/bin/python tools/readers/check_export.py "$glb" "$@"
  step "the Khronos validator accepts $name" node tools/readers/validate.mjs "$glb"
}

shapes_made=no
make_shapes() {
  [ $shapes_made = no ] || return
  shapes_made=yes
  need_build
  step "a sphere is written" example sphere_to_glb "$scratch/sphere"
  step "a textured globe is written" example textured_sphere "$scratch/globe"
}
# check_export.py reads the texture beside a file: shares_texture GLB
shares_texture() { cp "$scratch/globe/globe.png" "${1%.glb}.png"; }

readers() {
  make_shapes
  local globe=$scratch/globe
  readers_agree "the sphere" "$scratch/sphere/sphere.glb"
  readers_agree "the globe" "$globe/globe.glb"
  step "three.js agrees on the globe" node tools/readers/check_three.mjs "$globe/globe.glb"
  # with a normal map and a second texture
  shares_texture "$globe/globe_rich.glb"
  readers_agree "the rich globe" "$globe/globe_rich.glb"
  step "three.js agrees on the rich globe" node tools/readers/check_three.mjs "$globe/globe_rich.glb"
  # with soft layers, which trimesh and open3d take for part of the surface
  shares_texture "$globe/globe_soft.glb"
  step "the Khronos validator accepts the soft globe" node tools/readers/validate.mjs "$globe/globe_soft.glb"
  step "three.js agrees on the soft globe" node tools/readers/check_three.mjs "$globe/globe_soft.glb"
  step "a published checkpoint is converted" .venv/bin/python tools/reference/tensorf_checkpoint.py --check tests/reference
}

# train_demo STEPS OPTIONS...: the demo head, from photographs to views
train_demo() {
  "$target/release/tiface" demo --run "$scratch/demo" --preset draft --set iface.steps="$1" \
    --set tface.steps=$(($1 * 2 / 3)) --set baseline.steps=$(($1 / 3)) --set mesh.resolution=128 \
    --set mesh.format=glb,obj,ply,usdz --set render.method=tface,volume,raycast,textured "${@:2}"
}
demo_made=no
make_demo() {
  [ $demo_made = no ] || return
  demo_made=yes
  need_build
  # A head that has learned its colors is compared as a picture by the browser and Blender. Before that its
  # surface is soft, and would get layers, which some readers take for a part of it.
  local size=(150 --size 128x160 --views 16 --set mesh.hair=none)
  if wanted browser || wanted blender; then size=(600); fi
  step "the demo head is reconstructed" train_demo "${size[@]}"
  step "the demo head is exported" export_demo
}
# The demo head again, with fewer triangles, another material and a smaller texture; cut below the chin, at
# two levels of detail; and compressed.
export_demo() {
  local export=("$target/release/tiface" export "$scratch/demo")
  "${export[@]}" --material lit --triangles 3000 --texture 512 --format glb,obj,ply,usdz --out "$scratch/exported/" &&
    "${export[@]}" --cut chin --lod 2 --format glb,obj,ply --out "$scratch/cut/" &&
    "${export[@]}" --compress --out "$scratch/small.glb"
}
head=$scratch/demo/mesh/head.glb
exported=$scratch/exported/head.glb

demo() {
  local level
  make_demo
  readers_agree "the demo head" "$head" --up 0 0 1
  step "three.js agrees on the demo head" node tools/readers/check_three.mjs "$head"
  readers_agree "the exported head" "$exported" --up 0 0 1
  for level in head head_lod1; do readers_agree "the cut $level" "$scratch/cut/$level.glb" --up 0 0 1; done
  step "three.js agrees on the cut head" node tools/readers/check_three.mjs "$scratch/cut/head.glb"
  step "three.js decodes the compressed head" node tools/readers/check_compressed.mjs "$scratch/small.glb" "$head"
  # unlit, as the stage left it, and lit, as it was exported
  step "USD agrees on both, by the rules of ARKit" .venv/bin/python tools/readers/check_usdz.py "${head%.glb}.usdz" \
    "${exported%.glb}.usdz"
  local checks=tools/readers
  step "the files of the run are as their schemas say" .venv/bin/python $checks/check_schemas.py "$scratch/demo"
  step "scripts read the run" .venv/bin/python $checks/check_scripts.py "$scratch/demo"
}

## Parts of `all` alone.

long() {
  need_build
  step "long unit tests" long_tests "src crates" unit_tests
  step "long integration tests" long_tests tests/check tests long_check "$(executable $check_tests)"
  if [ -f ../shared/tools/cases.py ]; then
    step "inputs of many shapes are read or named" "${PYTHON:-python3}" ../shared/tools/cases.py "$target/release/tiface" \
      ../shared/data/cases
  else
    skip "inputs of many shapes: ../shared/tools/cases.py is absent"
  fi
}

# Tests that are ignored because they are long; others are ignored because they measure, or are run by a test.
# long_tests FOLDERS COMMAND...: runs a command of tests with the names of those that stand in the folders
long_tests() {
  local folders=$1 marked
  shift
  # shellcheck disable=SC2086
  marked=$(grep -rh -A 4 '#\[ignore = "long: ' $folders | sed -n 's/^ *fn \([a-z0-9_]*\)().*/\1/p')
  [ -n "$marked" ] || { echo "no test is marked as long"; return 1; }
  # shellcheck disable=SC2086
  TIFACE_KILLS=40 "$@" --ignored $marked
}

gpu() {
  need_build
  [ -n "${VK_DRIVER_FILES:-}" ] || return
  step "a first look at a GPU runs" env SHARE=1 CARGO_TARGET_DIR="$target" tools/gpu/first_look.sh vulkan:0 "$scratch/look"
}

fleet() {
  need_build
  step "many heads outlive kills" check tools/fleet/check_fleet.py
}

guides() {
  need_build
  step "the commands of the guides work" check tools/guides/check_guides.py
}

in_blender() { step "$1" .venv-blender/bin/python "${@:2}"; }
blender_agrees() {
  make_shapes
  make_demo
  has blender || return
  local checks=tools/readers
  in_blender "Blender agrees on the sphere" $checks/check_blender.py "$scratch/sphere/sphere.glb"
  in_blender "Blender agrees on the globe" $checks/check_blender.py "$scratch/globe/globe.glb"
  local kind
  for kind in rich soft; do shares_texture "$scratch/globe/globe_$kind.glb"; done
  in_blender "Blender agrees on the rich globe" $checks/check_blender.py "$scratch/globe/globe_rich.glb"
  in_blender "Blender agrees on the soft globe" $checks/check_blender.py "$scratch/globe/globe_soft.glb" --up 0 0 1
  in_blender "Blender agrees on the demo head" $checks/check_blender.py "$head" --up 0 0 1
  in_blender "Blender agrees on the cut head" $checks/check_blender.py "$scratch/cut/head.glb" --up 0 0 1
  in_blender "Blender agrees on the exported head" $checks/check_blender.py "$exported" --lit --up 0 0 1
  in_blender "the Blender extension is packed" tools/blender/make_extension.py "$target/tiface_import.zip"
  in_blender "Blender imports the run with it" $checks/check_addon.py "$scratch/demo"
  in_blender "Blender shows its lobes" $checks/check_lobes.py "$scratch/demo"
}

pages() {
  make_demo
  has browser || return
  mkdir -p "$scratch/click"
  step "the annotation page is written" example click_page "$scratch/click/page.html"
  step "a browser clicks on the page" node tools/page/check_page.mjs "$scratch/click/page.html"
  step "a browser opens the demo's pages" demo_pages
  step "three.js shows its lobes" node tools/readers/check_lobes.mjs "$scratch/demo"
}

# The pages of the demo head, as a person opens them.
demo_pages() {
  "$target/release/tiface" preview "$scratch/demo" --size 512 --out "$scratch/demo/preview.png" &&
    "$target/release/tiface" preview "$scratch/demo" --size 512 --light seen --out "$scratch/demo/preview_seen.png" &&
    "$target/release/tiface" report "$scratch/demo" "$scratch/demo/capture" --out "$scratch/demo/runs.html" &&
    node tools/page/check_report.mjs "$scratch/demo" &&
    node tools/page/check_watch.mjs "$target/release/tiface" "$scratch/demo"
}

install_begins
if wanted lint; then lint; fi
if wanted unit; then unit_begins; fi
if wanted integration; then integration; fi
if wanted unit; then unit_ends; fi
if wanted fuzz; then need_build; begin fuzz fuzz; fi
if wanted readers; then readers; fi
if wanted demo; then demo; fi
if wanted long; then long; fi
if wanted gpu; then gpu; fi
if wanted fleet; then fleet; fi
if wanted guides; then guides; fi
if wanted blender; then blender_agrees; fi
if wanted browser; then pages; fi
if wanted fuzz; then step "no input makes a reader panic, hang or fill the memory" end fuzz; fi

# how long which part took, the slowest tests, and what could not run
printf '\n== summary: %d s\n' "$SECONDS"
printf '%s\n' "${results[@]}"
if [ -s "$scratch/times" ]; then
  printf 'the slowest of %d tests, which took %d s in all:\n' "$(wc -l < "$scratch/times")" \
    "$(awk '{ sum += $1 } END { print int(sum) }' "$scratch/times")"
  sort -rn "$scratch/times" | head -n 20
fi
[ -s "$scratch/failures" ] && { printf 'what failed:\n'; cat "$scratch/failures"; }
[ -s "$scratch/skipped" ] && { printf 'tests that this machine could not run:\n'; sort -u "$scratch/skipped"; }
exit $failed
