"""Identify a damper and predict its force, from a bag or, without a bag, from the bridge.

ros2 launch mr_damper_ros identify.launch.py
ros2 launch mr_damper_ros identify.launch.py bag:=/path/to/bag rate:=2.0
ros2 launch mr_damper_ros identify.launch.py live:=true
ros2 launch mr_damper_ros identify.launch.py control:=true parameters:=/path/to/damper.yaml
ros2 launch mr_damper_ros identify.launch.py namespace:=left bridge_config:=/path/to/bridge.yaml

The launch ends some seconds after the bag. If a node fails, it ends at once with exit code 1.
"""

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
"""Recorded topics, which are absolute, are remapped to these relative names in the namespace."""

LAST_FITS = 5.0
"""Seconds after the end of the bag for the fits of the last windows."""

TAKES_PARAMETERS = {
    "identifier": "initial_parameters",
    "model": "parameter_file",
    "controller": "parameter_file",
}
"""Parameter of each node that names the parameter file of the user."""

YES_OR_NO = ["true", "false", "True", "False"]


def arguments() -> list[DeclareLaunchArgument]:
    """The launch arguments."""

    def argument(
        name: str, default: str, description: str, choices: list[str] | None = None
    ) -> DeclareLaunchArgument:
        return DeclareLaunchArgument(
            name, default_value=default, description=description, choices=choices
        )

    return [
        argument("bag", "", "Bag to play; empty: the bridge is started instead."),
        argument("rate", "1.0", "Speed relative to the recording; 0.0: as fast as possible."),
        argument("loop", "false", "Repeat the recording for ever.", YES_OR_NO),
        argument(
            "topics",
            "inputs",
            "Topics of the bag to play, as recorded, separated by blanks; inputs: topics of the "
            "test machine, without recorded results of an identifier or a model.",
        ),
        argument(
            "at_end",
            "stop",
            f"Action at the end of the bag: stop (after {LAST_FITS:g} s) or stay. With a rate of "
            "0.0, many windows may still wait for their fits at that time.",
            ["stop", "stay"],
        ),
        argument(
            "control",
            "false",
            "Also command the supply, so that the damper gives the force on damper/desired_force.",
            YES_OR_NO,
        ),
        argument(
            "parameters",
            "",
            "Parameter file of the damper: identifier, model and controller start with this set, "
            "and the identifier uses its law. Empty: as in the configuration files.",
        ),
        argument("namespace", "", "Namespace; one for each damper."),
        argument(
            "live",
            "false",
            "Serve a page that shows the running system; the node live logs its address.",
            YES_OR_NO,
        ),
        argument(
            "use_sim_time",
            "auto",
            "Take the time from the clock topic; auto: only if a bag is played.",
            ["auto", *YES_OR_NO],
        ),
        argument(
            "clock",
            "/clock",
            "Topic of the clock. If two bags are played at once, give each launch its own topic, "
            "such as /left/clock.",
        ),
        argument(
            "enclave",
            "/mr_damper",
            "Parent of the nodes' enclaves in the keystore; the model uses /mr_damper/model. Only "
            "used if ROS_SECURITY_ENABLE is true.",
        ),
        *(
            argument(
                f"{node}_config",
                str(SHARE / "config" / f"{node}.yaml"),
                f"Configuration file of the {node}.",
            )
            for node in ("bridge", "replay", "identifier", "model", "live", "controller")
        ),
    ]


def check(values: Mapping[str, str]) -> None:
    """Raise RuntimeError, before a node is started, if a value is invalid."""
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
    """Handler of the end of a node; raises RuntimeError if the node has failed."""

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
    """The nodes selected by the arguments."""
    values = {item.name: LaunchConfiguration(item.name).perform(context) for item in arguments()}
    check(values)
    played = bool(values["bag"])
    followers = ["identifier", "model"]
    if values["control"].lower() == "true":
        followers.append("controller")
    source = {
        "rate": float(values["rate"]),
        "loop": values["loop"].lower() == "true",
        # Sending starts when these nodes have subscribed.
        "wait_for_subscribers": len(followers),
    }
    sim_time = played if values["use_sim_time"] == "auto" else values["use_sim_time"]
    time = {"use_sim_time": str(sim_time).lower() == "true"}
    clock = [("/clock", values["clock"])]

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
