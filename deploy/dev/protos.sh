#!/usr/bin/env bash
# Generates the Python stubs of protos/plr/v1/*.proto, beside the .proto files.
#
#   deploy/dev/protos.sh           write them
#   deploy/dev/protos.sh --check   compare them with the committed ones; exit 1 if they differ
set -euo pipefail
cd "$(dirname "$0")/../.."

generate() {
  # protoc finds the plug-ins for typed stubs on the PATH.
  PATH=$PWD/.venv/bin:$PATH .venv/bin/python -m grpc_tools.protoc -I. \
    --python_out="$1" --mypy_out="quiet:$1" --grpc_python_out="$1" --mypy_grpc_out="quiet:$1" plr/protos/plr/v1/*.proto
}

case ${1:-} in
  "")
    generate .
    ;;
  --check)
    fresh=$(mktemp -d)
    trap 'rm -rf "$fresh"' EXIT
    generate "$fresh"
    # Both directions: a stub left over from a .proto that is gone is drift as well.
    if ! diff -ru --exclude='*.proto' --exclude='__init__.py' --exclude='__pycache__' --exclude='py.typed' \
      "$fresh/plr/protos/plr/v1" protos/plr/v1; then
      echo "protos: the stubs do not match the .proto files; run: make protos" >&2
      exit 1
    fi
    ;;
  *)
    echo "usage: deploy/dev/protos.sh [--check]" >&2
    exit 2
    ;;
esac
