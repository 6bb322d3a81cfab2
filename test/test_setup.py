"""The set-up reports each obstacle in one sentence, and excludes foreign packages."""

import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

NEEDED = ("scripts", "requirements", "msg_defs", "setup.py", "setup.cfg", "package.xml", "resource")
"""Files of the clone that the set-up checks before it installs anything."""


@pytest.fixture
def place() -> Iterator[Path]:
    """A folder that every user may enter."""
    with tempfile.TemporaryDirectory() as name:
        Path(name).chmod(0o755)
        yield Path(name)


def copy_to(folder: Path) -> Path:
    folder.mkdir()
    for name in NEEDED:
        source = ROOT / name
        if source.is_dir():
            shutil.copytree(source, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, folder / name)
    return folder


def set_up(folder: Path, user: int | None = None) -> subprocess.CompletedProcess[str]:
    environment = {k: v for k, v in os.environ.items() if k not in ("ROS_DISTRO", "PYTHONPATH")}
    return subprocess.run(
        ["bash", str(folder / "scripts" / "setup.bash")],
        env=environment,
        user=user,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def assert_refused(done: subprocess.CompletedProcess[str], part: str) -> None:
    assert done.returncode == 1, done.stdout
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1, done.stderr
    assert done.stderr.startswith("mr_damper_ros: ")
    assert part in done.stderr


@pytest.mark.parametrize("name", ["ação", "日本", "with space", "semi;colon", "brack[et", "a=b"])
def test_a_path_that_cmake_cannot_build_in_is_refused(place: Path, name: str) -> None:
    assert_refused(set_up(copy_to(place / name)), "move the folder to a path without")


def test_a_folder_that_cannot_be_written_is_refused(place: Path) -> None:
    folder = copy_to(place / "clone")
    folder.chmod(0o555)
    user = 65534 if os.geteuid() == 0 else None
    assert_refused(set_up(folder, user), "nothing can be written to")


def test_every_pinned_package_has_a_hash() -> None:
    for name in ("constraints.txt", "dev.txt", "doc.txt", "noble.txt"):
        text = (ROOT / "requirements" / name).read_text(encoding="utf-8")
        entries = text.replace(" \\\n", " ").splitlines()[1:]
        assert len(entries) > 20
        assert [entry for entry in entries if "--hash=sha256:" not in entry] == []


def test_the_tools_replace_no_package_of_the_programs() -> None:
    packages = []
    for name in ("constraints.txt", "dev.txt"):
        lines = (ROOT / "requirements" / name).read_text(encoding="utf-8").splitlines()
        packages.append({line.partition("==")[0] for line in lines if "==" in line})
    assert all(len(names) > 20 for names in packages)
    assert packages[0] & packages[1] == set()


@pytest.mark.skipif(not (ROOT / "install").exists(), reason="nothing is built")
def test_foreign_packages_do_not_take_the_place_of_the_environment(place: Path) -> None:
    if os.environ.get("ROS_DISTRO"):
        pytest.skip("with ROS sourced, PYTHONPATH is the user's")
    (place / "numpy.py").write_text("raise ImportError('the foreign one')\n")
    done = subprocess.run(
        ["bash", "-c", '. "$1/env.bash" && . "$1/env.bash" && python -c "import numpy"', "", ROOT],
        env={**os.environ, "PYTHONPATH": f"{place}:{ROOT}/install"},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines() == [
        f"mr_damper_ros: PYTHONPATH is set without {place}: modules there would replace packages "
        "of this environment."
    ]
