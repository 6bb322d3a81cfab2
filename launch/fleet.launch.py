"""Identify many dampers at once, each with its own namespace and bridge.

One process runs all identifiers, which share its workers; another process runs all models.

ros2 launch mr_damper_ros fleet.launch.py dampers:="left right"
ros2 launch mr_damper_ros fleet.launch.py dampers:=8 bridge_config:=/path/to/{damper}.yaml

The launch ends with exit code 1 as soon as a node fails.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchContext, LaunchDescription

PACKAGE = "mr_damper_ros"
SHARE = Path(get_package_share_directory(PACKAGE))

NODES = ("bridge", "identifier", "model")

HOSTED = NODES[1:]
"""Nodes of which one process runs those of all dampers."""

PLACE = "{damper}"
"""Placeholder for the name of the damper in the path of a parameter file."""

NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""A namespace that ROS accepts."""


def arguments() -> list[DeclareLaunchArgument]:
    """The launch arguments."""
    return [
        DeclareLaunchArgument(
            "dampers",
            default_value="2",
            description="Names of the dampers, separated by blanks, which are also their "
            "namespaces; or the number of dampers, which are then called damper_1, damper_2, ...",
            choices=None,
        ),
        *(
            DeclareLaunchArgument(
                f"{node}_config",
                default_value=str(SHARE / "config" / f"{node}.yaml"),
                description=f"Parameter file of the {node}; {PLACE}: the damper's name.",
                choices=None,
            )
            for node in NODES
        ),
    ]


def names_of(text: str) -> list[str]:
    """The names of the dampers; raises RuntimeError if a name is invalid."""
    if text.isdecimal():
        names = [f"damper_{number}" for number in range(1, int(text) + 1)]
    else:
        names = text.split()
    if not names:
        raise RuntimeError("dampers is empty: give names or a number")
    for name in names:
        if not NAME.fullmatch(name):
            raise RuntimeError(f"a damper cannot be called {name!r}: use letters, digits and _")
    if len(set(names)) < len(names):
        raise RuntimeError("two dampers have the same name")
    return names


def failed(name: str) -> Callable[..., None]:
    """Handler of the end of a node; raises RuntimeError if the node has failed."""

    def handle(event: object, context: LaunchContext) -> None:
        code = event.returncode  # type: ignore[attr-defined]
        if code and not context.is_shutdown:
            raise RuntimeError(f"{name} has ended with exit code {code}")

    return handle


def file_of(values: Mapping[str, str], node: str, damper: str) -> str:
    """Parameter file of a node of a damper; raises RuntimeError if it does not exist."""
    path = values[f"{node}_config"].replace(PLACE, damper)
    if not Path(path).is_file():
        raise RuntimeError(f"{node}_config: there is no file {path}")
    return path


def nodes(context: LaunchContext) -> list[Node]:
    """The processes of identifiers and models, and a bridge for each damper."""
    values = {item.name: LaunchConfiguration(item.name).perform(context) for item in arguments()}
    dampers = names_of(values["dampers"])
    places = {
        node: [f"{damper}={file_of(values, node, damper)}" for damper in dampers] for node in HOSTED
    }
    all_of_them = [
        Node(
            package=PACKAGE,
            executable=node,
            arguments=[text for place in places[node] for text in ("--namespace", place)],
            output="screen",
            on_exit=failed(node),
        )
        for node in HOSTED
    ]
    bridges = [
        Node(
            package=PACKAGE,
            executable="bridge",
            name="bridge",
            namespace=damper,
            # Sending starts when identifier and model have subscribed.
            parameters=[file_of(values, "bridge", damper), {"wait_for_subscribers": len(HOSTED)}],
            output="screen",
            on_exit=failed(f"{damper}/bridge"),
        )
        for damper in dampers
    ]
    return all_of_them + bridges


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([*arguments(), OpaqueFunction(function=nodes)])
