#!/usr/bin/env bash
# What the first half hour on a GPU should measure, in parts of at most nine minutes each:
#
#     tools/gpu/first_look.sh DEVICE OUT [PART...]
#
# DEVICE is what `--device` takes (`wgpu`, `vulkan:0`, ...). Figures go to OUT as they are measured, so a part
# that is cut short still counts; OUT/figures.txt holds one line a figure, which `docs/gpu.md` explains.
# Parts, in the order in which they are run where none is named:
#
#     doctor     the self-test cold and warm; the demo head on the CPU and on the GPU, with dB side by side
#     kernels    time of each kernel by timestamps, at 24,576, 262,144 and 1,048,576 samples of a step
#     steps      milliseconds of a step by samples and by launches of a submission; deterministic twice; T-Face
#     product    a capture in preset `standard`, whole, with the time of each stage
#     resume     a training moved between devices; `--memory`; two processes on one device
#
# It needs bash, awk and this program, no network: TIFACE names the program (default: target/release/tiface)
# and CAPTURE a capture (default: the demo head's, made on the way). SHARE is the share of the steps to make,
# in hundredths (default: 100; `tools/test.sh all` makes one hundredth on a driver in software).
set -u -o pipefail

[ $# -ge 2 ] || { sed -n '2,20s/^# \{0,1\}//p' "$0" >&2; exit 2; }
device=$1
out=$(mkdir -p "$2" && cd "$2" && pwd) || exit 2
shift 2
parts=("$@")
[ -z "${CAPTURE:-}" ] || CAPTURE=$(cd "$CAPTURE" && pwd) || exit 2
[ ${#parts[@]} -gt 0 ] || parts=(doctor kernels steps product resume)

root=$(cd "$(dirname "$0")/../.." && pwd)
program=${TIFACE:-${CARGO_TARGET_DIR:-$root/target}/release/tiface}
program=$(cd "$(dirname "$program")" && pwd)/$(basename "$program")
[ -x "$program" ] || { echo "no program at $program; TIFACE names one" >&2; exit 2; }
share=${SHARE:-100}
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
# neither the user's settings nor verdicts of earlier self-tests
export XDG_CONFIG_HOME=$work/none XDG_CACHE_HOME=$work/cache

# say FIGURE WORDS...: one line, seen and kept
say() { printf '%s\n' "$*" | tee -a "$out/figures.txt"; }

# wrong WORDS...: the same; the script ends with an error, also where a subshell calls this
wrong() { say "WRONG: $*"; : > "$work/failed"; }

# some STEPS: the share of them, 4 at least
some() { awk -v n="$1" -v share="$share" 'BEGIN { n = int(n * share / 100); print n < 4 ? 4 : n }'; }

seconds() { date +%s.%N; }

# timed NAME COMMAND...: runs it with its output in OUT/NAME.txt and says how long it took
timed() {
  local name=$1 begin end code
  shift
  begin=$(seconds)
  timeout 540 "$@" > "$out/$name.txt" 2>&1
  code=$?
  end=$(seconds)
  say "$name: $(awk -v a="$begin" -v b="$end" 'BEGIN { printf "%.1f", b - a }') s, exit $code"
  return $code
}

# number KEY FILE: the last number of that key in a file of JSON
number() { grep -o "\"$1\": *[-0-9.e+]*" "$2" 2> /dev/null | tail -n 1 | sed 's/.*: *//'; }

# own_test FILE: name, seconds and verdict of DEVICE in what `doctor --json` wrote; `doctor` tests
# all devices, and fails if any of them does
own_test() {
  awk -v device="${device%%+*}" '
    BEGIN { numbered = split(device, want, ":") > 1 }
    {
      parts = split($0, part, /\{"name":"/)
      for (p = 2; p <= parts; p++) {
        # a device, or one of the checks of the device before it
        if (match(part[p], /^[a-z0-9]+:[0-9]+","adapter":/)) {
          name = substr(part[p], 1, index(part[p], "\"") - 1)
          api = name; sub(/:.*/, "", api)
          chosen = 0
          if (want[1] == "wgpu" || want[1] == api)
            chosen = numbered ? seen++ == want[2] : part[p] !~ /"kind":"software"/ && !seen++
          if (chosen) { own = name; verdict = "passed" }
        }
        if (!chosen) continue
        if (part[p] ~ /"passed":false/ || part[p] ~ /"error":"/) verdict = "FAILED"
        if (match(part[p], /"seconds":[0-9.e+-]+/)) seconds = substr(part[p], RSTART + 10, RLENGTH - 10)
      }
    }
    END { if (own != "") printf "%s %.1f %s\n", own, seconds, verdict }' "$1"
}

# The Vulkan loader, and the driver that each ICD file names: in a container one of them, or a
# library that the driver needs, is often missing.
loader() {
  local known files file folder library lacks
  [ "$(uname)" = Linux ] || return 0
  known=$(PATH=$PATH:/usr/sbin:/sbin ldconfig -p 2> /dev/null)
  library=$(awk '$1 == "libvulkan.so.1" { print $NF; exit }' <<< "$known")
  say "loader: ${library:-no libvulkan.so.1 is known to ldconfig}"
  files=${VK_DRIVER_FILES:-${VK_ICD_FILENAMES:-}}
  if [ -n "$files" ]; then
    files=${files//:/$'\n'}
  else
    for folder in /etc /usr/local/share /usr/share "${XDG_DATA_HOME:-$HOME/.local/share}"; do
      for file in "$folder"/vulkan/icd.d/*.json; do [ ! -e "$file" ] || files+=$file$'\n'; done
    done
  fi
  [ -n "$files" ] || say "ICD: no file names a driver"
  while read -r file; do
    [ -n "$file" ] || continue
    library=$(sed -n 's/.*"library_path" *: *"\([^"]*\)".*/\1/p' "$file" 2> /dev/null | head -n 1)
    case $library in
      "") say "ICD: $file cannot be read, or names no driver"; continue ;;
      /*) ;;
      */*) library=$(dirname "$file")/$library ;;
      *) library=$(awk -v name="$library" '$1 == name { print $NF; found = 1; exit } END { if (!found) print name }' <<< "$known") ;;
    esac
    if [ -e "$library" ]; then
      lacks=$(ldd "$library" 2> /dev/null | awk '/not found/ { printf " %s", $1 }')
      say "ICD: $file names $library${lacks:+, which lacks$lacks}"
    else
      say "ICD: $file names $library, which is not here"
    fi
  done <<< "$files"
}

# per_step NAME LOG: milliseconds of a step between reports, the first fifth left out
per_step() {
  awk -v name="$1" '
    function value(key) {
      if (!match($0, "\"" key "\": *[-0-9.e+]+")) return ""
      text = substr($0, RSTART, RLENGTH); sub(/.*: */, "", text); return text
    }
    value("step") != "" { step[++n] = value("step"); at[n] = value("elapsed_s"); psnr = value("psnr"); samples = value("samples") }
    END {
      first = int(n / 5) + 1
      if (n < 2 || step[n] == step[first]) { printf "%s: too few reports for a time\n", name; exit }
      printf "%s: %.3f ms a step over %d steps, %s dB, %s samples\n", name,
        1000 * (at[n] - at[first]) / (step[n] - step[first]), step[n] - step[first], psnr, samples
    }' "$2" | tee -a "$out/figures.txt"
}

# train NAME STAGE STEPS OPTIONS...: trains one field in a run of its own and says how long a step takes
train() {
  local name=$1 stage=$2 steps
  steps=$(some "$3")
  shift 3
  timed "$name" "$program" "$stage" "$(capture)" --run "$work/$name" --device "$device" --set "$stage.steps=$steps" --quiet "$@" &&
    per_step "$name" "$work/$name/$stage/log.jsonl" || wrong "$name did not train, see $name.txt"
}

# The capture: the one that is named, or photographs of the demo head, whose fields are hardly trained here.
capture() {
  if [ -n "${CAPTURE:-}" ]; then echo "$CAPTURE"; return; fi
  # what this prints is the folder
  [ -d "$work/demo/capture" ] ||
    "$program" demo --run "$work/demo" --device cpu --quiet "${photographs[@]}" "${tiny[@]}" > "$out/capture.txt" 2>&1 ||
    wrong "no photographs of the demo head, see capture.txt" >&2
  echo "$work/demo/capture"
}

photographs=(--size 256x320 --views 32)
# Settings under which every stage takes seconds; an update of the occupancy grid evaluates the field in each
# of its cells.
tiny=(--preset draft --set iface.steps=4 --set iface.samples=1024 --set iface.levels=6 --set iface.log2_table=12
  --set iface.occupancy_resolution=32
  --set tface.steps=4 --set tface.fields=1 --set tface.rays=256 --set tface.voxels_start=4096 --set tface.voxels_final=13824
  --set baseline.steps=4 --set mesh.resolution=48
  --set mesh.texture_px=256 --set mesh.triangles=4000)
# The paper's preset expects a box that fits the head.
paper=(--preset paper --set capture.box=head)
standard=(--preset standard)
demo=(--preset draft --quiet)
small=(--preset draft)
sizes=(24576 65536 262144 1048576)
most_tasks=(4 32 128)
if [ "$share" -lt 100 ]; then
  photographs=(--size 64x80 --views 12) sizes=(24576) most_tasks=(32)
  paper=("${tiny[@]}") standard=("${tiny[@]}") demo=("${tiny[@]}" --quiet) small=("${tiny[@]}")
fi
# samples N: as many samples of a step, fewer of them with a small share
samples() { [ "$share" -ge 100 ] && echo "$1" || echo $(($1 / 64)); }

part_doctor() {
  local of stage name seconds verdict
  loader
  for of in cold warm; do
    timed "doctor_$of" "$program" doctor --json
    read -r name seconds verdict <<< "$(own_test "$out/doctor_$of.txt")"
    say "doctor_$of of ${name:-$device}: ${seconds:-no} s, ${verdict:-not listed}"
    [ "$verdict" = passed ] || wrong "the self-test of $device, see doctor_$of.txt"
  done
  timed demo_gpu "$program" demo --run "$work/demo_gpu" --device "$device" "${photographs[@]}" "${demo[@]}" || wrong "no demo on $device, see demo_gpu.txt"
  timed demo_cpu "$program" demo --run "$work/demo_cpu" --device cpu "${photographs[@]}" "${demo[@]}" || wrong "no demo on the CPU, see demo_cpu.txt"
  for of in gpu cpu; do
    for stage in iface tface; do per_step "demo_$of $stage" "$work/demo_$of/$stage/log.jsonl"; done
    cp "$work/demo_$of/metrics/metrics.json" "$out/metrics_$of.json" 2> /dev/null
    "$program" metrics "$work/demo_$of" > "$out/metrics_$of.txt" 2>&1
    say "demo_$of: held-out views, last method: $(number psnr "$out/metrics_$of.json") dB"
  done
}

part_kernels() {
  local n log=$work/kernels.log
  capture > /dev/null
  for n in "${sizes[@]}"; do
    [ "$n" != 65536 ] || continue
    mkdir -p "$work/profile"
    rm -f "$log"
    printf '[profiling]\nlogger = { level = "basic", file = "%s", append = false }\n' "$log" > "$work/profile/cubecl.toml"
    (cd "$work/profile" && train "kernels_$n" iface 200 "${paper[@]}" --set "iface.samples=$(samples $n)")
    [ -s "$log" ] || { wrong "no kernel was timed at $n samples"; continue; }
    # lines are `| 61.601µs | Name`
    awk -F'|' '
      {
        split($2, t, /[^0-9.]+/); v = t[2] == "" ? t[1] : t[2]; gsub(/ /, "", $2); gsub(/ /, "", $3)
        scale = $2 ~ /ns$/ ? 1e-6 : $2 ~ /µs$/ ? 1e-3 : $2 ~ /ms$/ ? 1 : 1e3
        sum[$3] += v * scale; count[$3]++
      }
      END { for (k in sum) printf "%10.3f ms in all, %6d launches, %9.4f ms each  %s\n", sum[k], count[k], sum[k] / count[k], k }
    ' "$log" | sort -rn > "$out/kernels_$n.txt"
    say "kernels at $n samples, the slowest:"
    head -n 6 "$out/kernels_$n.txt" | tee -a "$out/figures.txt"
  done
}

part_steps() {
  local n tasks
  for n in "${sizes[@]}"; do
    train "samples_$n" iface 3000 "${paper[@]}" --set "iface.samples=$(samples $n)"
  done
  for tasks in "${most_tasks[@]}"; do
    CUBECL_WGPU_MAX_TASKS=$tasks train "tasks_$tasks" iface 3000 "${standard[@]}" --set "iface.samples=$(samples 24576)"
  done
  for n in 1 2; do
    train "deterministic_$n" iface 1000 "${paper[@]}" --deterministic --set "iface.samples=$(samples 262144)"
  done
  if cmp -s "$work"/deterministic_{1,2}/iface/checkpoint.safetensors; then
    say "deterministic: the same bytes twice"
  else
    wrong "--deterministic gave other bytes the second time"
  fi
  train tface_paper tface 2000 "${paper[@]}"
  [ "$share" -lt 100 ] || train tface_standard tface 1000 --preset standard
}

part_product() {
  timed product "$program" run "$(capture)" --run "$work/product" --device "$device" --quiet "${standard[@]}" ||
    wrong "the capture was not reconstructed, see product.txt"
  "$program" status "$work/product" --json > "$out/product_status.json" 2>&1
  for stage in "$work"/product/*/done.json; do
    say "product: $(basename "$(dirname "$stage")") took $(number elapsed_s "$stage") s"
  done
  cp "$work/product/metrics/metrics.json" "$out/metrics_product.json" 2> /dev/null
}

part_resume() {
  local steps half size=("${small[@]}" --set "iface.samples=$(samples 262144)")
  steps=$(some 2000)
  half=$((steps / 2))
  local moved=("$program" iface "$(capture)" --run "$work/moved" --quiet "${size[@]}" --set iface.checkpoint_s=0.05 --set "iface.steps=$steps")
  timeout -s INT 30 "${moved[@]}" --device "$device" > "$out/resume_1.txt" 2>&1
  timed resume_on_cpu "${moved[@]}" --device cpu || wrong "the CPU did not go on, see resume_on_cpu.txt"
  per_step "resumed ($half and on)" "$work/moved/iface/log.jsonl"
  timeout 120 "$program" iface "$(capture)" --run "$work/little" --device "$device" --memory 0.05 --quiet "${size[@]}" > "$out/memory.txt" 2>&1
  local code=$?
  if [ $code = 1 ] && grep -q "memory" "$out/memory.txt"; then
    say "--memory 0.05: refused with a remedy"
  else
    wrong "--memory 0.05 ended with exit $code, see memory.txt"
  fi
  # two trainings at once, each of its own run
  for n in 1 2; do
    timeout 240 "$program" iface "$(capture)" --run "$work/both_$n" --device "$device" --quiet "${size[@]}" \
      --set "iface.steps=$(some 500)" > "$out/both_$n.txt" 2>&1 &
  done
  wait %1; local first=$?
  wait %2; local second=$?
  say "two at once on $device: exit $first and $second (75: the device is in use)"
}

{ nvidia-smi || true; } > "$out/smi.txt" 2>&1
for part in "${parts[@]}"; do
  declare -F "part_$part" > /dev/null || { echo "no part $part" >&2; exit 2; }
  begin=$SECONDS
  say "== $part on $device"
  "part_$part"
  say "== $part: $((SECONDS - begin)) s"
done
[ ! -e "$work/failed" ] || exit 1
