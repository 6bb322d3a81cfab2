"""The parts of launch and launch_ros used by the launch file, for systems without them.

It resolves the arguments as `ros2 launch` does and returns the nodes that would be started; what
launch does with them later is not imitated.
"""

import importlib.util
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any


@dataclass
class Context:
    """Replaces launch's context."""

    launch_configurations: dict[str, str] = field(default_factory=dict)
    is_shutdown: bool = False


@dataclass
class Argument:
    name: str
    default_value: str
    description: str
    choices: list[str] | None


@dataclass
class Configuration:
    name: str

    def perform(self, context: Context) -> str:
        return context.launch_configurations[self.name]


class Action:
    """An action with its constructor arguments as attributes."""

    def __init__(self, **details: Any) -> None:
        self.__dict__.update(details)


@dataclass
class Value:
    value: str
    value_type: type


def load(path: Path, monkeypatch: Any) -> ModuleType:
    """The launch file as a module that uses this stand-in."""

    def module(name: str, **content: object) -> None:
        made = ModuleType(name)
        made.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, made)

    module("launch", LaunchContext=Context, LaunchDescription=list)
    module(
        "launch.actions",
        DeclareLaunchArgument=Argument,
        **dict.fromkeys(("OpaqueFunction", "Shutdown", "TimerAction"), Action),
    )
    module("launch.substitutions", LaunchConfiguration=Configuration)
    module("launch_ros")
    module("launch_ros.actions", Node=Action)
    module("launch_ros.parameter_descriptions", ParameterValue=Value)
    spec = importlib.util.spec_from_file_location("launched", path)
    loaded = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(loaded)
    return loaded


def nodes(description: list[Any], given: Mapping[str, str]) -> list[Action]:
    """The nodes for these arguments; raises RuntimeError where launch would."""
    context = Context(dict(given))
    started = []
    for entity in description:
        if isinstance(entity, Argument):
            value = context.launch_configurations.setdefault(entity.name, entity.default_value)
            if entity.choices is not None and value not in entity.choices:
                raise RuntimeError(f"{entity.name}: {value} is none of {entity.choices}")
        else:
            started += entity.function(context)
    return started


def command_line(node: Action) -> tuple[list[str], dict[str, object]]:
    """ROS arguments and parameters with which launch would start a node."""
    made = vars(node)
    if "parameters" not in made:
        return list(made["arguments"]), {}
    arguments = [*made.get("ros_arguments", ()), "-r", f"__node:={node.name}"]
    if node.namespace:
        arguments += ["-r", f"__ns:=/{node.namespace.lstrip('/')}"]
    for old, new in made.get("remappings", ()):
        arguments += ["-r", f"{old}:={new}"]
    file, parameters = node.parameters
    values = {k: v.value if isinstance(v, Value) else v for k, v in parameters.items()}
    return ["--ros-args", *arguments, "--params-file", file, "--"], values
