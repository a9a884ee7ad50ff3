#!/usr/bin/env bash
# Checks the subject of a commit message in the file $1: `package: verb object`, at most 72 characters.
set -euo pipefail
subject=$(head -n 1 "$1")
if [[ ! $subject =~ ^(Merge\ |Revert\ |[a-z][a-z0-9,\ -]*:\ [a-z]) ]]; then
  echo "subject: write 'package: verb object', not '$subject'" >&2
  exit 1
fi
if ((${#subject} > 72)); then
  echo "subject: ${#subject} characters, 72 are allowed: '$subject'" >&2
  exit 1
fi
