"""Identify a damper and predict its force: from a bag, or from the bridge where none is given.

ros2 launch mr_damper_ros identify.launch.py
ros2 launch mr_damper_ros identify.launch.py bag:=/path/to/bag rate:=2.0
ros2 launch mr_damper_ros identify.launch.py live:=true
ros2 launch mr_damper_ros identify.launch.py control:=true parameters:=/path/to/damper.yaml
ros2 launch mr_damper_ros identify.launch.py namespace:=left bridge_config:=/path/to/bridge.yaml

It ends some seconds after the bag, and as soon as a node fails, then with exit code 1.
"""

import os
from collections.abc import Callable, Mapping
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown, TimerAction
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from launch import LaunchContext, LaunchDescription

PACKAGE = "mr_damper_ros"
SHARE = Path(get_package_share_directory(PACKAGE))

RECORDED_TOPICS = ("mts/samples", "supply/current", "temperature")
"""Recorded names are absolute; made relative, they follow the namespace."""

PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where either is set, it holds; Fast DDS of Jazzy reads the first."""

LAST_FITS = 5.0
"""Seconds after the end of the bag, in which the last windows are fitted."""

TAKES_PARAMETERS = {
    "identifier": "initial_parameters",
    "model": "parameter_file",
    "controller": "parameter_file",
}
"""What each node calls a set that the user gives."""

YES_OR_NO = ["true", "false", "True", "False"]


def arguments() -> list[DeclareLaunchArgument]:
    """What the user may set."""

    def argument(
        name: str, default: str, description: str, choices: list[str] | None = None
    ) -> DeclareLaunchArgument:
        return DeclareLaunchArgument(
            name, default_value=default, description=description, choices=choices
        )

    return [
        argument("bag", "", "Bag to play; empty starts the bridge instead."),
        argument("rate", "1.0", "Speed; 0.0 is as fast as possible."),
        argument("loop", "false", "Play the recording again and again.", YES_OR_NO),
        argument(
            "topics",
            "inputs",
            "Topics of the bag to play, as recorded, separated by blanks; inputs: those of the "
            "test machine, not what an identifier and a model have published then.",
        ),
        argument(
            "at_end",
            "stop",
            f"What to do at the end of the bag: stop, {LAST_FITS:g} s later, or stay. With a rate "
            "of 0.0 many windows may still wait to be fitted then.",
            ["stop", "stay"],
        ),
        argument(
            "control",
            "false",
            "Command the supply too, so that the damper gives the force on damper/desired_force.",
            YES_OR_NO,
        ),
        argument(
            "parameters",
            "",
            "Parameter file of what is known of the damper: the identifier starts from it, in its "
            "law, and model and controller begin with it. Empty: what the parameter files say.",
        ),
        argument("namespace", "", "Namespace; one for each damper."),
        argument(
            "live",
            "false",
            "Serve a page that shows the running system; the node live says where.",
            YES_OR_NO,
        ),
        argument(
            "use_sim_time",
            "auto",
            "Take the time from the clock topic; auto: where a bag is played, which provides it.",
            ["auto", *YES_OR_NO],
        ),
        argument(
            "clock",
            "/clock",
            "Topic of that time. Where two bags are played at once, give each launch its own, such "
            "as /left/clock.",
        ),
        argument(
            "enclave",
            "/mr_damper",
            "Where the nodes' enclaves lie in the keystore, such as /mr_damper/model; used where "
            "ROS_SECURITY_ENABLE is true.",
        ),
        *(
            argument(
                f"{node}_config",
                str(SHARE / "config" / f"{node}.yaml"),
                f"Parameter file of the {node}.",
            )
            for node in ("bridge", "replay", "identifier", "model", "live", "controller")
        ),
    ]


def check(values: Mapping[str, str]) -> None:
    """Raise RuntimeError, before anything is started, where a value cannot be used."""
    try:
        rate = float(values["rate"])
    except ValueError:
        rate = -1.0
    if not rate >= 0.0:
        raise RuntimeError(f"rate must be a number of at least 0, not {values['rate']!r}")
    if values["bag"] and not Path(values["bag"]).exists():
        raise RuntimeError(f"there is no bag {values['bag']}")
    for name, value in values.items():
        given = name.endswith("_config") or (name == "parameters" and value)
        if given and not Path(value).is_file():
            raise RuntimeError(f"{name}: there is no file {value}")


def after(name: str, values: Mapping[str, str]) -> Callable[..., list[TimerAction] | None]:
    """What follows the end of a node."""

    def handle(event: object, context: LaunchContext) -> list[TimerAction] | None:
        if context.is_shutdown:
            return None
        code = event.returncode  # type: ignore[attr-defined]
        if code:
            raise RuntimeError(f"{name} has ended with exit code {code}")
        if name == "replay" and values["at_end"] == "stop":
            return [TimerAction(period=LAST_FITS, actions=[Shutdown(reason="end of the bag")])]
        return None

    return handle


def nodes(context: LaunchContext) -> list[Node]:
    """The nodes that the arguments ask for."""
    values = {item.name: LaunchConfiguration(item.name).perform(context) for item in arguments()}
    check(values)
    played = bool(values["bag"])
    followers = ["identifier", "model"]
    if values["control"].lower() == "true":
        followers.append("controller")
    source = {
        "rate": float(values["rate"]),
        "loop": values["loop"].lower() == "true",
        # They are there before the first sample.
        "wait_for_subscribers": len(followers),
    }
    sim_time = played if values["use_sim_time"] == "auto" else values["use_sim_time"]
    time = {"use_sim_time": str(sim_time).lower() == "true"}
    clock = [("/clock", values["clock"])]
    # Nodes that are started again are found at once.
    profiles = str(SHARE / "config" / "fastdds.xml")
    environment = {} if any(map(os.environ.get, PROFILES)) else {PROFILES[0]: profiles}

    def text(name: str) -> ParameterValue:
        return ParameterValue(values[name], value_type=str)

    known = {
        name: {option: text("parameters")} if values["parameters"] else {}
        for name, option in TAKES_PARAMETERS.items()
    }

    def node(
        name: str, parameters: dict[str, object], remappings: list[tuple[str, str]] | None = None
    ) -> Node:
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=values["namespace"],
            parameters=[values[f"{name}_config"], {**parameters, **known.get(name, {})}],
            remappings=remappings or [],
            ros_arguments=["--enclave", f"{values['enclave'].rstrip('/')}/{name}"],
            additional_env=environment,
            output="screen",
            on_exit=after(name, values),
        )

    if played:
        recorded = [(f"/{topic}", topic) for topic in RECORDED_TOPICS]
        play = {**source, "bag": text("bag"), "topics": text("topics")}
        first = node("replay", play, recorded + clock)
    else:
        first = node("bridge", source)
    shown = ["live"] if values["live"].lower() == "true" else []
    return [first, *(node(name, time, clock) for name in (*followers, *shown))]


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([*arguments(), OpaqueFunction(function=nodes)])
