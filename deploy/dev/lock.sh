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

compile --extra sidecar --extra controlplane --extra ros --extra interfaces --extra dev --extra bench pyproject.toml \
  --output-file requirements/dev.txt "$@"
# The same with what builds the site: `make docs` adds it to an environment that has the rest.
compile --constraint requirements/dev.txt --extra docs pyproject.toml --output-file requirements/docs.txt "$@"
# One for each thing that is deployed, the same versions as above: the operator's `plr`, a robot or cloud whose rclpy
# comes from apt, the same with a ROS of its own, the control plane.
deployed() {
  local name=$1
  shift
  compile --constraint requirements/dev.txt pyproject.toml --output-file "requirements/runtime$name.txt" "$@"
}
deployed "" "$@"
deployed -sidecar --extra sidecar "$@"
deployed -ros --extra sidecar --extra ros "$@"
deployed -controlplane --extra controlplane "$@"
# What builds the packages that have no wheel, and ours. setuptools brings a packaging of its own, but prefers one that it
# finds: Ubuntu 24.04's, in an environment that sees the system's packages, is too old for it.
printf '%s\n' packaging setuptools | compile --constraint requirements/dev.txt - --output-file requirements/build.txt "$@"
# The same with the installer of a checkout, for pip to fetch.
{
  grep '^uv==' requirements/constraints.txt
  echo setuptools
} | compile --constraint requirements/dev.txt - --output-file requirements/bootstrap.txt "$@"
