"""Imports between the rooms of the package point in one direction."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "mr_damper_ros"

ROOMS = (
    *("settings", "processes", "signals", "kinematics", "models", "data_check", "estimation"),
    *("tracking", "control", "io", "emulation", "rig", "report", "api", "campaign"),
    *("live", "nodes", "tools"),
)
"""Each room may import only from those before it. The first two know nothing of dampers."""

ROS = ("rclpy", "rcl_interfaces", "mr_damper_msgs", "sensor_msgs", "diagnostic_msgs", "std_msgs")


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def modules() -> list[Path]:
    return sorted(PACKAGE.rglob("*.py"))


def inside(path: Path) -> str:
    return path.relative_to(PACKAGE).as_posix()


def room(path: Path) -> str:
    """Room of a module; empty for modules at the top of the package."""
    return path.relative_to(PACKAGE).parts[0] if path.parent != PACKAGE else ""


def imported(path: Path) -> Iterator[str]:
    """Full names of all imports of a module, including local ones and those under TYPE_CHECKING."""
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                package = ("mr_damper_ros", *path.relative_to(PACKAGE).parts[: -node.level])
                base = ".".join((*package, base)).rstrip(".")
            yield from (f"{base}.{name.name}" for name in node.names)


def rooms_known_to(path: Path) -> set[str]:
    names = (name.split(".") for name in imported(path))
    places = {parts[1] for parts in names if parts[0] == "mr_damper_ros" and len(parts) > 1}
    return places & {*ROOMS}


def allowed(place: str) -> set[str]:
    """Rooms from which a room may import."""
    return set(ROOMS) if place == "" else set(ROOMS[: ROOMS.index(place) + 1])


def test_every_module_is_in_a_room() -> None:
    assert {room(path) for path in modules()} - {""} <= set(ROOMS)


def test_imports_point_one_way() -> None:
    wrong = {
        (inside(path), known)
        for path in modules()
        for known in rooms_known_to(path) - allowed(room(path))
    }
    assert wrong == set(), "a room may not know one that comes after it"


def test_nothing_knows_what_is_not_installed_and_the_nodes_alone_know_ros() -> None:
    outside = {"studies", "benchmarks", "test"}
    wrong = {
        (inside(path), name)
        for path in modules()
        for name in imported(path)
        if name.split(".")[0] in (outside if room(path) == "nodes" else outside.union(ROS))
    }
    assert wrong == set()


def test_no_circle_of_imports() -> None:
    names = {f"mr_damper_ros.{inside(path)[:-3].replace('/', '.')}": path for path in modules()}
    known = {
        name: {
            other
            for full in imported(path)
            for other in (full, full.rpartition(".")[0])
            if other in names and other != name
        }
        for name, path in names.items()
    }
    left = dict(known)
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    assert sorted(left) == [], "these modules import one another"
