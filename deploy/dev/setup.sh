#!/usr/bin/env bash
# Makes a checkout ready to work in: Debian packages, .venv with the locked dependencies, the example interfaces and
# the console commands. Safe to run again at any time; returns at once when there is nothing to do.
#
#   deploy/dev/setup.sh
#
# Environment:
#   PYTHON=python3.12            interpreter for a new .venv (default: the first of python3.11, python3.12, python3 that fits)
#   PLR_SYSTEM_PACKAGES=skip     go on although Debian packages are missing; what needs them fails or is skipped
set -euo pipefail
cd "$(dirname "$0")/../.."

venv=.venv
stamp=$venv/.setup.stamp
# Administration tools stand in directories that a plain user's PATH lacks.
export PATH=$PATH:/usr/sbin:/sbin

say() { echo "setup: $*"; }
fail() {
  echo "setup: $*" >&2
  exit 1
}

supported() { "$1" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 12))' 2>/dev/null; }

find_python() {
  local candidate
  for candidate in ${PYTHON:-} python3.11 python3.12 python3; do
    if supported "$candidate"; then
      "$candidate" -c 'import sys; print(sys.executable)'
      return
    fi
  done
  fail "CPython 3.11 or 3.12 is needed (on Debian 12: apt-get install python3)"
}

# Prints the Debian packages that are missing, one a line. Looks for what they bring, not for their names: a tool that
# came some other way is as good.
missing_packages() {
  local python=$1 pair
  local tools=(
    cmake:cmake g++:g++                       # interface package
    nft:nftables ip:iproute2 ping:iputils-ping ethtool:ethtool # network lab
    unshare:util-linux flock:util-linux capsh:libcap2-bin
    iperf3:iperf3                             # benchmarks: a TCP flow at the same bottleneck
    turnserver:coturn turnutils_stunclient:coturn # third-party STUN
    promtool:prometheus amtool:prometheus-alertmanager systemd-analyze:systemd # checks of deploy/
  )
  {
    for pair in "${tools[@]}"; do
      command -v "${pair%%:*}" >/dev/null || echo "${pair#*:}"
    done
    "$python" - <<'PYTHON'
import importlib.util, os, sys, sysconfig
version = f"python{sys.version_info[0]}.{sys.version_info[1]}"
if importlib.util.find_spec("ensurepip") is None or importlib.util.find_spec("venv") is None:
    print(f"{version}-venv")
if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
    print(f"{version}-dev")
PYTHON
  } | sort -u
}

# Installs Debian packages without letting any of them start a service (prometheus, its Alertmanager and coturn would), now or at boot.
install_packages() {
  local policy=/usr/sbin/policy-rc.d unit
  say "installing Debian packages: $*"
  if [[ ! -e $policy ]]; then
    printf '#!/bin/sh\nexit 101\n' >"$policy"
    chmod 755 "$policy"
    trap 'rm -f /usr/sbin/policy-rc.d' EXIT
  fi
  export DEBIAN_FRONTEND=noninteractive
  local log
  log=$(mktemp)
  if ! { apt-get update && apt-get -o DPkg::Lock::Timeout=300 install --yes --no-install-recommends "$@"; } >"$log" 2>&1 </dev/null; then
    tail -n 30 "$log" >&2
    fail "apt-get could not install: $*"
  fi
  rm -f "$log"
  if [[ -d /run/systemd/system ]]; then
    for unit in prometheus prometheus-alertmanager coturn; do
      if [[ " $* " == *" $unit "* ]]; then
        systemctl --quiet disable "$unit" || true
      fi
    done
  fi
}

fingerprint() {
  {
    sha256sum requirements/dev.txt requirements/bootstrap.txt pyproject.toml deploy/dev/setup.sh
    "$venv/bin/python" -VV
  } | sha256sum | cut -d' ' -f1
}

# One set-up at a time: several `make` in one checkout wait for each other.
if command -v flock >/dev/null; then
  exec 9<"$PWD"
  flock 9
fi

python=$(find_python)
if [[ -x $venv/bin/python ]] && ! supported "$venv/bin/python"; then
  say "$venv no longer works: making it again"
  rm -rf "$venv"
fi
base=$python
if [[ -x $venv/bin/python ]]; then
  base=$venv/bin/python
fi

mapfile -t missing < <(missing_packages "$base")
if ((${#missing[@]})); then
  if [[ ${PLR_SYSTEM_PACKAGES:-} == skip ]]; then
    say "continuing without these Debian packages: ${missing[*]}"
  elif ((EUID == 0)) && command -v apt-get >/dev/null; then
    install_packages "${missing[@]}"
  else
    fail "run first, as root: apt-get install --no-install-recommends ${missing[*]}   (or set PLR_SYSTEM_PACKAGES=skip)"
  fi
fi

if [[ ! -x $venv/bin/python ]]; then
  say "making $venv with $python"
  "$python" -m venv "$venv"
fi

if [[ ! -f $stamp || $(<"$stamp") != "$(fingerprint)" ]]; then
  say "installing the locked dependencies"
  "$venv/bin/python" -m pip --quiet --disable-pip-version-check install --require-hashes -r requirements/bootstrap.txt
  # No isolated builds: they would fetch a setuptools that is not locked.
  install=("$venv/bin/uv" pip install --quiet --python "$venv/bin/python" --no-build-isolation)
  "${install[@]}" --require-hashes -r requirements/dev.txt
  "${install[@]}" --no-deps --editable .
  fingerprint >"$stamp"
fi

deploy/dev/interfaces.sh "$venv"
