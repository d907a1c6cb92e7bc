#!/usr/bin/env bash
# One task of the fleet: task.sh ATTEMPT MARK LOG CAPTURE COMMAND...
#
# Engines retry whatever fails. What would fail again the same way is not tried again: MARK keeps the exit
# code of the last attempt, and only 75 ("not now") and ends by a signal are worth another one. A word CAPTURE
# in the command stands for the capture, or for its copy under $SCRATCH.
set -u
attempt=$1 mark=$2 log=$3 capture=$4
shift 4
mkdir -p "$(dirname "$mark")" "$(dirname "$log")" || exit 1

# Who ends for good: everything but 75 and signals (128 and more).
permanent() { [ "$1" -ne 0 ] && [ "$1" -ne 75 ] && [ "$1" -lt 128 ]; }

if [ "$attempt" -gt 1 ] && last=$(cat "$mark" 2> /dev/null) && permanent "$last"; then
  echo "not tried again: it ended with exit code $last, which another attempt does not change; see $log" >&2
  exit "$last"
fi
rm -f "$mark"

if [ -n "$capture" ] && [ -n "${SCRATCH:-}" ]; then
  # by what it is and holds: one that was mended, or another of the same name, is copied again
  key=$( (realpath "$capture"; find -L "$capture" -type f -printf '%P %s %T@\n' | sort) | sha256sum | cut -c1-16)
  local=$SCRATCH/$key/$(basename "$capture")
  mkdir -p "$SCRATCH/$key" || exit 1
  exec 9> "$local.lock" # several stages of a head may begin at once
  flock 9
  if [ ! -d "$local" ]; then
    rm -rf "$local.part"
    cp -rL "$capture" "$local.part" && mv "$local.part" "$local" || exit 1
  fi
  exec 9>&-
  capture=$local
fi
words=()
for word in "$@"; do
  [ "$word" = CAPTURE ] && word=$capture
  words+=("$word")
done

# Signals of the engine are for the program, which saves and ends; bash alone would wait for it and say nothing.
stop= child=
trap 'stop=1; [ -z "$child" ] || kill -TERM "$child" 2> /dev/null' TERM INT
# 75 is often another process on the same stage, which an engine that was killed left behind: it ends by itself.
patience=${TIFACE_PATIENCE:-600} pause=1 begun=$SECONDS
while :; do
  [ -z "$stop" ] || exit 143
  "${words[@]}" >> "$log" 2>&1 &
  child=$!
  wait "$child"
  code=$?
  # a wait that a signal ended is not the program's end
  while kill -0 "$child" 2> /dev/null; do
    wait "$child"
    code=$?
  done
  [ "$code" -eq 75 ] && [ $((SECONDS - begun)) -lt "$patience" ] || break
  # who has too little memory waits for the engine's next attempt, which asks for more
  tail -n 5 "$log" | grep -q 'out of memory' && break
  sleep "$pause"
  pause=$((pause < 30 ? pause * 2 : 30))
done
if permanent "$code"; then
  echo "$code" > "$mark"
  tail -n 5 "$log" >&2
fi
exit "$code"
