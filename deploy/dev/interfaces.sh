#!/usr/bin/env bash
# Builds examples/plr_demo_interfaces and installs it into the virtual environment, beside the ROS wheels and laid
# out like them, so that `import plr_demo_interfaces.srv` needs no environment variable. On a robot whose ROS comes
# from apt, build the package with colcon instead.
#
#   deploy/dev/interfaces.sh [VENV]     default .venv; does nothing when the installed build is up to date
set -euo pipefail
cd "$(dirname "$0")/../.."

venv=$(realpath "${1:-.venv}")
python=$venv/bin/python
source=examples/plr_demo_interfaces
stamp=$venv/.plr_demo_interfaces.stamp

# The sources, what builds them and what they are built against.
fingerprint=$(
  {
    find "$source" -type f -print0 | sort -z | xargs -0 sha256sum
    sha256sum deploy/dev/ros_wheels.cmake deploy/dev/interfaces.sh requirements/dev.txt
    "$python" -VV
  } | sha256sum | cut -d' ' -f1
)
if [[ -f $stamp && $(<"$stamp") == "$fingerprint" ]]; then
  exit 0
fi

# Short-lived and outside the checkout: an aborted build leaves nothing that a later one could trip over.
build=$(mktemp -d "${TMPDIR:-/tmp}/plr_demo_interfaces.XXXXXX")
trap 'rm -rf "$build"' EXIT
echo "building $source"

# A shell that has sourced a ROS set-up file would mix that ROS with the wheels.
unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONPATH COLCON_PREFIX_PATH
# The generators are run by their `#!/usr/bin/env python3` line.
export PATH=$venv/bin:$PATH

run() {
  if ! "$@" >"$build/log" 2>&1; then
    cat "$build/log" >&2
    echo "building $source failed: $*" >&2
    exit 1
  fi
}

run cmake -S "$source" -B "$build/cmake" \
  -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF \
  -DCMAKE_PREFIX_PATH="$venv" -DCMAKE_INSTALL_PREFIX="$venv" \
  -DCMAKE_PROJECT_INCLUDE="$PWD/deploy/dev/ros_wheels.cmake" \
  -DPython3_EXECUTABLE="$python" -DPYTHON_EXECUTABLE="$python"
run cmake --build "$build/cmake" --parallel "$(nproc)"
run cmake --install "$build/cmake"
run env -C / "$python" -c "import plr_demo_interfaces.srv as srv; srv.DetectPeople.__class__.__import_type_support__()"

echo "$fingerprint" >"$stamp"
