#!/usr/bin/env bash
# How much of the readers' code the inputs of tests/fuzz.rs reach: a line for each file, and all of them
# together.
#
#     rustup component add llvm-tools
#     TIFACE_FUZZ_S=60 tools/coverage.sh
#
# Only the packages of this workspace are instrumented; what they depend on stays as it was built. The program
# that cargo builds beside the tests is removed in the end: instrumented, it is up to a hundred times as slow.
set -eu -o pipefail
cd "$(dirname "$0")/.."

bin=$(rustc --print sysroot)/lib/rustlib/$(rustc -vV | sed -n 's/^host: //p')/bin
[ -x "$bin/llvm-cov" ] || { echo "llvm-cov is missing: rustup component add llvm-tools" >&2; exit 2; }
scratch=$(mktemp -d)
trap 'rm -rf "$scratch" "${CARGO_TARGET_DIR:-target}/release/tiface"' EXIT
printf '#!/bin/sh\nexec "$@" -Cinstrument-coverage\n' > "$scratch/rustc"
chmod +x "$scratch/rustc"
export RUSTC_WORKSPACE_WRAPPER=$scratch/rustc CARGO_INCREMENTAL=0
tests=$(cargo test --release --features matting,wgpu --test fuzz --no-run --message-format=json |
  sed -n 's/.*"executable":"\([^"]*\/fuzz-[^"]*\)".*/\1/p')
LLVM_PROFILE_FILE=$scratch/%p.profraw "$tests" --nocapture
"$bin/llvm-profdata" merge -sparse "$scratch"/*.profraw -o "$scratch/fuzz.profdata"
"$bin/llvm-cov" report "$tests" --instr-profile "$scratch/fuzz.profdata" \
  crates/tiface-base/src/io crates/tiface-capture/src crates/tiface-surface/src/files src/mask/prompts.rs src/field/checkpoint.rs \
  src/config src/config.rs |
  awk '/^Filename|TOTAL|\.rs/ { printf "%-44s %9s lines %9s reached\n", $1, $8, $10 }'
