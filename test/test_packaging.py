"""Built and installed files: both packages, their messages, programs and data."""

import ast
import json
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from mr_damper_ros.processes.dependencies import missing_dependency

ROOT = Path(__file__).resolve().parent.parent
PROGRAMS = (
    *("bridge", "campaign", "controller", "identifier", "live", "model", "replay", "supply"),
    *("suspension", "mr-damper"),
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


ROSDEP = ROOT / "test" / "rosdep_noble_jazzy.txt"
"""Keys that rosdep knows; the file says where they come from."""


def rosdep_keys() -> set[str]:
    lines = ROSDEP.read_text(encoding="utf-8").splitlines()
    return {line for line in lines if not line.startswith("#")}


def keys_in(path: Path, *tags: str) -> set[str]:
    """Keys in a package.xml, of the dependencies of these kinds or of all kinds."""
    root = ElementTree.parse(path).getroot()
    return {
        element.text or ""
        for element in root
        if (element.tag in tags if tags else element.tag.endswith("depend"))
    }


@pytest.mark.parametrize("name", ["package.xml", "msg_defs/package.xml"])
def test_rosdep_resolves_every_key(name):
    """One unknown key stops ``rosdep install`` before it installs anything."""
    assert keys_in(ROOT / name) - rosdep_keys() - {"mr_damper_msgs"} == set()


KEYS = {"mcap": "mcap-ros2-support"}
"""Keys that differ from the module names; this one installs the module with another package."""


def key_of(module: str) -> str:
    """The rosdep key of a module: that of a Python package or the name of a package of ROS."""
    candidates = (KEYS.get(module, ""), f"python3-{module}", f"python3-{module}-pip")
    return next((key for key in candidates if key in rosdep_keys()), module)


OPTIONAL = {"asammdf", "nptdms", "numba", "openpyxl", "pyvisa"}
"""Optional packages."""

BROUGHT_BY_MCAP = {"lz4", "zstandard"}
"""Packages that mcap needs for compressed bags."""


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


def needed_modules() -> set[str]:
    """Modules that are imported and not optional."""
    return imported_modules() - OPTIONAL - BROUGHT_BY_MCAP


def test_package_xml_names_everything_that_is_imported():
    named = keys_in(ROOT / "package.xml", "depend", "exec_depend")
    needed = {key_of(module) for module in needed_modules()}
    assert needed <= named
    # ros2launch is the command that starts the launch files.
    assert named - needed == {"ros2launch"}


DISTRIBUTIONS = {"yaml": "PyYAML"}
"""pip names that differ from the module names."""


def python_packages() -> dict[str, str]:
    """Modules outside ROS that are needed, with their pip names."""
    found = (
        name for name in needed_modules() if name in KEYS or key_of(name).startswith("python3-")
    )
    return {name: DISTRIBUTIONS.get(name, name) for name in found}


def test_a_wheel_requires_everything_that_is_imported_without_ros():
    """Only the package of the live page, which needs a rig or a recording, is an extra."""
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    lists = [
        re.search(pattern, text, re.DOTALL)
        for pattern in (r"install_requires=\[(.*?)\]", r'"live": \[(.*?)\]')
    ]
    required = [set(re.findall(r'"(\w+)', found[1])) for found in lists if found]
    assert required == [set(python_packages().values()) - {"aiohttp"}, {"aiohttp"}]


def test_the_pip_lines_of_optional_packages_are_those_of_the_extras():
    texts = [*(ROOT / "doc").rglob("*.md"), *(ROOT / "mr_damper_ros").rglob("*.py")]
    told = {
        version
        for path in texts
        for version in re.findall(r"[\w.-]+==[\d.]*\d", path.read_text(encoding="utf-8"))
    }
    text = (ROOT / "setup.py").read_text(encoding="utf-8")
    optional = re.search(r"extras_require=\{(.*?)\}", text, re.DOTALL)
    assert optional
    assert told == set(re.findall(r'"([\w-]+==[\d.]+)"', optional[1]))


def test_a_missing_python_package_is_named_with_its_pip_line():
    for module, package in python_packages().items():
        sentence = missing_dependency(ModuleNotFoundError(name=f"{module}.part"))
        assert f"`pip install {package}`" in sentence


def test_a_missing_package_of_ros_is_named():
    # The command ros2 launch, which imports the launch files, needs the other two itself.
    for module in needed_modules() - python_packages().keys() - {"launch", "launch_ros"}:
        assert module in missing_dependency(ModuleNotFoundError(name=module))


def test_an_import_that_fails_for_another_reason_keeps_its_traceback():
    assert missing_dependency(ModuleNotFoundError(name="mr_damper_ros.no_such_module")) == ""


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


def test_all_programs_lie_where_ros2_run_looks():
    folder = prefix_of("mr_damper_ros") / "lib" / "mr_damper_ros"
    found = sorted(path.name for path in folder.iterdir() if path.stat().st_mode & 0o111)
    assert found == sorted(PROGRAMS)


def test_files_of_the_package_are_installed():
    share = prefix_of("mr_damper_ros") / "share" / "mr_damper_ros"
    expected = {Path("package.xml")}
    for pattern in ("config/**/*", "launch/**/*.py", "bags/**/*"):
        expected |= {path.relative_to(ROOT) for path in ROOT.glob(pattern) if path.is_file()}
    missing = sorted(str(path) for path in expected if not (share / path).is_file())
    assert missing == []
    marker = share.parent / "ament_index" / "resource_index" / "packages" / "mr_damper_ros"
    assert marker.is_file()
