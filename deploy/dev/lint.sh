#!/usr/bin/env bash
# All static checks. Runs every one even if an earlier one fails, and names those that failed at the end.
set -uo pipefail
cd "$(dirname "$0")/../.."

failed=()
check() {
  local name=$1
  shift
  echo "lint: $name"
  "$@" || failed+=("$name")
}

import_rules() {
  # The linter draws a banner; only a broken contract is worth its output.
  local report
  report=$(.venv/bin/lint-imports --no-cache 2>&1) || {
    echo "$report"
    return 1
  }
}

check "ruff check" .venv/bin/ruff check --quiet .
check "ruff format" .venv/bin/ruff format --check --quiet .
check "mypy" .venv/bin/mypy --no-error-summary
check "import rules" import_rules
check "generated stubs" deploy/dev/protos.sh --check
check "generated pages" .venv/bin/python -m deploy.dev.pages --check

if ((${#failed[@]})); then
  printf 'lint: failed: %s\n' "$(
    IFS=,
    echo "${failed[*]}"
  )" >&2
  exit 1
fi
echo "lint: ok"
