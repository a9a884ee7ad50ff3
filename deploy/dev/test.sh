#!/usr/bin/env bash
# Runs the tests. With arguments, pytest takes them as they are; without, every test runs:
# first those that build emulated networks, one by one, since they measure; then all others, several at a time, since
# they mostly wait. A file's tests stay on one worker.
set -uo pipefail
cd "$(dirname "$0")/../.."

pytest=(.venv/bin/python -m pytest)
if (($#)); then
  exec "${pytest[@]}" "$@"
fi

failed=()
"${pytest[@]}" -m netns || failed+=("emulated networks")
"${pytest[@]}" -m "not netns" --numprocesses logical --maxprocesses 4 --dist loadfile || failed+=("all others")
if ((${#failed[@]})); then
  printf 'test: failed: %s\n' "$(
    IFS=,
    echo "${failed[*]}"
  )" >&2
  exit 1
fi
