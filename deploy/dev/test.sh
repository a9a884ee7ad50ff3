#!/usr/bin/env bash
# Runs the tests. With arguments, pytest takes them as they are; without, every test runs, a file's tests on one worker:
# first those that build emulated networks, a few at a time, which mostly wait for the time to pass in them; then all
# others, on every core.
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

failed=()
"${pytest[@]}" -m netns --numprocesses "$at_once" "${parallel[@]}" "${emulated[@]}" || failed+=("emulated networks")
"${pytest[@]}" -m "not netns" --numprocesses "$at_once" "${parallel[@]}" || failed+=("all others")
if ((${#failed[@]})); then
  printf 'test: failed: %s\n' "$(
    IFS=,
    echo "${failed[*]}"
  )" >&2
  exit 1
fi
