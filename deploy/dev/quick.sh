#!/usr/bin/env bash
# The inner loop, in about a minute: checks what differs from the branch that this one left, or from COMMIT.
#
#   deploy/dev/quick.sh [COMMIT]
#
# Static checks of changed files; unit tests of the folders whose sources or tests changed; a slice of the simulations.
# `make lint test` decides what lands.
set -uo pipefail
cd "$(dirname "$0")/../.."

since=${1:-$(git merge-base HEAD origin/main 2>/dev/null || git rev-parse HEAD)}
mapfile -t changed < <({
  git diff --name-only --diff-filter=d "$since"
  git ls-files --others --exclude-standard
} | sort -u)
mapfile -t sources < <(printf '%s\n' "${changed[@]}" | grep '\.py$')

declare -A folders=()
for file in "${sources[@]}"; do
  case $file in
  tests/unit/*/*) folder=$(dirname "$file") ;;
  sidecar/* | controlplane/* | protos/* | lab/* | bench/* | deploy/*) folder=tests/unit/$(dirname "$file") ;;
  *) continue ;;
  esac
  compgen -G "$folder/test_*.py" >/dev/null && folders[$folder]=1
done
# Whole requests through both cores, and from reports to a mapping that is explained.
slice=(tests/sim/test_hedging.py tests/sim/test_dual_stack.py tests/sim/test_explain.py)

status=0
if ((${#sources[@]})); then
  .venv/bin/ruff check --quiet "${sources[@]}" || status=1
  .venv/bin/ruff format --check --quiet "${sources[@]}" || status=1
  .venv/bin/mypy --no-error-summary || status=1
  .venv/bin/lint-imports --cache-dir .import_linter_cache >/dev/null 2>&1 || {
    echo "quick: an import points upward; .venv/bin/lint-imports names it" >&2
    status=1
  }
fi
for file in "${sources[@]}"; do
  case $file in tests/unit/test_*.py | tests/sim/test_*.py) folders[$file]=1 ;; esac
done
folders[tests/unit/test_layout.py]=1
echo "quick: ${#sources[@]} changed sources, unit tests of ${#folders[@]} folders, ${#slice[@]} simulations"
.venv/bin/python -m pytest --quiet --numprocesses "$(nproc)" --dist loadfile "${!folders[@]}" "${slice[@]}" || status=1
exit "$status"
