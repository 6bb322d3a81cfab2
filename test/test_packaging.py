"""Built and installed files: both packages, their messages, programs and data."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = (
    *("bridge", "campaign", "controller", "identifier", "live", "model", "replay", "supply"),
    *("suspension", "check_rig", "demo", "export", "identify", "identify_many", "import_record"),
    *("plan_run", "replay_recording", "validate", "watch"),
)
MESSAGES = sorted(path.stem for path in (ROOT / "msg_defs" / "msg").glob("*.msg"))


def prefix_of(package: str) -> Path:
    """Installation folder of the package; skips the test if it is not built."""
    packages = pytest.importorskip("ament_index_python.packages")
    try:
        return Path(packages.get_package_prefix(package))
    except packages.PackageNotFoundError:
        pytest.skip(f"{package} is not built, or env.bash is not sourced")


def version_in(path: Path) -> str:
    found = re.search(r"<version>(.*?)</version>", path.read_text(encoding="utf-8"))
    assert found
    return found[1]


def said(*arguments: str) -> str:
    """Output of Python with these arguments, which must succeed."""
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    return done.stdout.strip()


def test_colcon_sees_both_packages():
    pytest.importorskip("colcon_core")
    code = "from colcon_core.command import main; raise SystemExit(main())"
    listed = sorted(
        line.split("\t")
        for line in said("-c", code, "--log-base", "/dev/null", "list").splitlines()
    )
    assert listed == [
        ["mr_damper_msgs", "msg_defs", "(ros.ament_cmake)"],
        ["mr_damper_ros", ".", "(ros.ament_python)"],
    ]


@pytest.mark.parametrize("name", ["package.xml", "msg_defs/package.xml"])
def test_package_xml_is_valid(name):
    pytest.importorskip("lxml")
    pytest.importorskip("catkin_pkg")
    said("scripts/check_package_xml.py", name)


def test_one_version_everywhere():
    version = version_in(ROOT / "package.xml")
    assert version_in(ROOT / "msg_defs" / "package.xml") == version
    assert said("setup.py", "--version") == version
    assert f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    heading = re.search(
        r"^(\S+) \(.*\)\n-+$", (ROOT / "CHANGELOG.rst").read_text(encoding="utf-8"), re.MULTILINE
    )
    assert heading
    assert heading[1] == version


KEYS = {
    "matplotlib": "python3-matplotlib",
    "mpl_toolkits": "python3-matplotlib",
    "numpy": "python3-numpy",
    "rosbags": "python3-rosbags-pip",
    "scipy": "python3-scipy",
    "threadpoolctl": "python3-threadpoolctl",
    "yaml": "python3-yaml",
}
"""rosdep keys of packages outside ROS; the others are named like their modules."""

OPTIONAL = {"cma", "distributed", "nptdms", "numba", "openpyxl", "pyarrow", "pyvisa", "serial"}
"""Optional packages."""

BROUGHT_BY_ROSBAGS = {"lz4", "backports", "compression"}
"""Packages that rosbags needs for compressed bags; Python 3.14 includes compression."""


def imported_modules() -> set[str]:
    """Top-level names of all imports outside the standard library."""
    names: set[str] = set()
    for folder in ("mr_damper_ros", "launch"):
        for path in (ROOT / folder).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    names |= {alias.name.partition(".")[0] for alias in node.names}
                elif isinstance(node, ast.ImportFrom):
                    names.add((node.module or "").partition(".")[0])
    return names - set(sys.stdlib_module_names) - {"mr_damper_ros"}


def test_package_xml_names_everything_that_is_imported():
    root = ElementTree.parse(ROOT / "package.xml").getroot()
    named = {element.text for tag in ("depend", "exec_depend") for element in root.iter(tag)}
    needed = {
        KEYS.get(module, module) for module in imported_modules() - OPTIONAL - BROUGHT_BY_ROSBAGS
    }
    assert needed <= named
    # ros2launch is the command that starts the launch files.
    assert named - needed == {"ros2launch"}


DISTRIBUTIONS = {"mpl_toolkits": "matplotlib", "yaml": "PyYAML"}
"""pip names that differ from the module names."""


def test_a_wheel_requires_everything_that_is_imported_without_ros():
    needed = {DISTRIBUTIONS.get(name, name) for name in imported_modules() & set(KEYS)}
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    required = re.search(r"install_requires=\[(.*?)\]", text, re.DOTALL)
    assert required
    assert set(re.findall(r'"(\w+)', required[1])) == needed


def test_a_link_to_the_messages_is_all_that_a_workspace_needs(tmp_path):
    """As in colcon and rosdep: neither searches inside a package, and both follow links."""
    packages = pytest.importorskip("catkin_pkg.packages")
    (tmp_path / "mr_damper_ros").symlink_to(ROOT)
    assert packages.find_package_paths(str(tmp_path)) == ["mr_damper_ros"]
    (tmp_path / "mr_damper_msgs").symlink_to("mr_damper_ros/msg_defs")
    assert sorted(packages.find_package_paths(str(tmp_path))) == ["mr_damper_msgs", "mr_damper_ros"]


def typestore():
    """Types of ROS 2 Jazzy in rosbags, and the messages of this repository."""
    typesys = pytest.importorskip("rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    types = {}
    for name in MESSAGES:
        text = (ROOT / "msg_defs" / "msg" / f"{name}.msg").read_text(encoding="utf-8")
        types.update(typesys.get_types_from_msg(text, f"mr_damper_msgs/msg/{name}"))
    store.register(types)
    return store


@pytest.mark.parametrize("name", MESSAGES)
def test_rosbags_and_the_built_messages_agree_on_the_type_hash(name):
    share = prefix_of("mr_damper_msgs") / "share" / "mr_damper_msgs"
    built = json.loads((share / "msg" / f"{name}.json").read_text(encoding="utf-8"))
    hashes = {entry["type_name"]: entry["hash_string"] for entry in built["type_hashes"]}
    type_name = f"mr_damper_msgs/msg/{name}"
    assert typestore().hash_rihs01(type_name) == hashes[type_name]


@pytest.mark.parametrize("program", PROGRAMS)
def test_programs_lie_where_ros2_run_looks(program):
    path = prefix_of("mr_damper_ros") / "lib" / "mr_damper_ros" / program
    assert path.is_file()
    assert path.stat().st_mode & 0o111


def test_files_of_the_package_are_installed():
    share = prefix_of("mr_damper_ros") / "share" / "mr_damper_ros"
    expected = {Path("package.xml")}
    for pattern in ("config/**/*", "launch/**/*.py", "bags/**/*"):
        expected |= {path.relative_to(ROOT) for path in ROOT.glob(pattern) if path.is_file()}
    missing = sorted(str(path) for path in expected if not (share / path).is_file())
    assert missing == []
    marker = share.parent / "ament_index" / "resource_index" / "packages" / "mr_damper_ros"
    assert marker.is_file()
