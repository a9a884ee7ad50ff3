#!/usr/bin/env bash
# Runs the tests. With arguments, pytest takes them as they are; without, every test runs, a file's tests on one worker:
# first those that build emulated networks, a few at a time, which mostly wait for the time to pass in them, and of these
# one by one those that want all cores; then all others, on every core.
set -uo pipefail
cd "$(dirname "$0")/../.."

pytest=(.venv/bin/python -m pytest)
if (($#)); then
  exec "${pytest[@]}" "$@"
fi
# The files that the first run is about; to load all others takes as long as a dozen tests.
mapfile -t emulated < <(grep -rl --include='test_*.py' 'mark\.netns' tests | sort)
cores=$(nproc)
at_once=$((cores < 4 ? cores + 1 : 4))
parallel=(--dist loadfile --no-loadscope-reorder --durations 15)

failed=() unsteady=()

# run NAME PROCESSES ARGUMENT... - run tests; what fails is tried again, alone. These tests happen in real time, on machines
# that do other things too and stand still for a second now and then. A defect fails twice; so do more than eight.
run() {
  local name=$1 processes=$2 cache=.pytest_cache/${1// /-} status count
  shift 2
  rm -rf "$cache"
  "${pytest[@]}" -o cache_dir="$cache" "$@" --numprocesses "$processes" "${parallel[@]}"
  status=$?
  ((status == 0)) && return
  count=$(.venv/bin/python -c 'import json, sys; print(len(json.load(open(sys.argv[1]))))' "$cache/v/cache/lastfailed")
  if ((status != 1 || count > 8)); then
    failed+=("$name")
    return
  fi
  printf 'test: %d of %s failed; trying again, alone\n' "$count" "$name" >&2
  unsteady+=("$(.venv/bin/python -c 'import json, sys; print(*json.load(open(sys.argv[1])))' "$cache/v/cache/lastfailed")")
  "${pytest[@]}" -o cache_dir="$cache" --last-failed "$@" || failed+=("$name")
}

run "emulated networks" "$at_once" -m "netns and not busy" "${emulated[@]}"
run "busy networks" 1 -m "netns and busy" "${emulated[@]}"
run "all others" "$at_once" -m "not netns"
if ((${#unsteady[@]})); then
  printf 'test: failed at first and tried again: %s\n' "${unsteady[*]}" >&2
fi
if ((${#failed[@]})); then
  printf 'test: failed: %s\n' "$(
    IFS=,
    echo "${failed[*]}"
  )" >&2
  exit 1
fi
