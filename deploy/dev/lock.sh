#!/usr/bin/env bash
# Writes requirements/*.txt, the locked dependencies, from pyproject.toml. Needs the package registry.
#
#   deploy/dev/lock.sh             keep what is locked, add what pyproject.toml newly asks for
#   deploy/dev/lock.sh --upgrade   newest versions that pyproject.toml allows
set -euo pipefail
cd "$(dirname "$0")/../.."

uv=.venv/bin/uv

# uv does not read pip's configuration, so no private index gets in.
compile() {
  "$uv" pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url \
    --no-annotate --constraint requirements/constraints.txt --custom-compile-command "make lock" "$@"
}

compile --all-extras pyproject.toml --output-file requirements/dev.txt "$@"
# The runtime alone, for a deployment whose rclpy comes from the system; the same versions as above.
compile --constraint requirements/dev.txt pyproject.toml --output-file requirements/runtime.txt "$@"
# The same with a ROS of its own.
compile --constraint requirements/dev.txt --extra ros pyproject.toml --output-file requirements/runtime-ros.txt "$@"
# What installs the above: the installer, for pip to fetch, and what builds the packages that have no wheel.
{
  grep '^uv==' requirements/constraints.txt
  echo setuptools
} | compile --constraint requirements/dev.txt - --output-file requirements/bootstrap.txt "$@"
