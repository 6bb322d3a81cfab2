#!/usr/bin/env bash
# Builds the wheel, installs it alone into an environment, and runs what needs no ROS: the Python
# example of the README, and the programs that turn a recording into code.
set -euo pipefail
CDPATH="" cd -- "$(dirname -- "${BASH_SOURCE[0]}")/.."
. scripts/common.bash
unset PYTHONPATH PYTHONHOME VIRTUAL_ENV AMENT_PREFIX_PATH

place=build/wheel
python=$(find_python 13)
rm -rf "$place"
mkdir -p "$place"
say "Building the wheel with $("$python" --version)"
"$python" -m venv "$place/tools"
pip_install "$place/tools" build==1.2.2
"$place/tools/bin/python" -m build --outdir "$place" . >"$place/build.log" 2>&1 \
  || { tail -n 20 "$place/build.log" >&2; fail "the wheel could not be built."; }

# Its metadata, without the nodes, would stand for those of the workspace if the clone is on PYTHONPATH.
rm -rf mr_damper_ros.egg-info

say "Trying it in an empty environment"
"$python" -m venv "$place/env"
without_hashes requirements/constraints.txt >"$place/versions.txt"
pip_install "$place/env" -c "$place/versions.txt" "$place"/*.whl
mkdir -p "$place/trial/doc"
cp doc/example.csv "$place/trial/doc"
sed -n '/^```python$/,/^```$/p' README.md | sed '1d; /^```$/,$d' >"$place/trial/readme.py"
cd "$place/trial"
PATH=$PWD/../env/bin:$PATH
set -x
python readme.py
test -s damper.yaml -a -s damper.png
mr-damper import doc/example.csv --columns time:s,displacement:mm,force:N --current 0.5 --output run
mr-damper identify run --output set.yaml --plot figures
mr-damper validate set.yaml run
mr-damper plan --velocity 0.02 0.1 --current 0 1.5 --amplitude 0.01 --force 2000 run
mr-damper export set.yaml --format c --output code
installed="from importlib.metadata import files; print(*(f.name for f in files('mr_damper_ros') if 'bin' in f.parts))"
test "$(../env/bin/python -c "$installed")" = mr-damper
for command in check demo live watch; do
  code=0
  said=$(mr-damper "$command" 2>&1) || code=$?
  test "$code" = 2
  [[ $said == *"ROS 2"* && $said != *Traceback* ]]
done
