"""Identify a damper and predict its force: from a bag, or from the bridge where none is given.

ros2 launch mr_damper_ros identify.launch.py
ros2 launch mr_damper_ros identify.launch.py bag:=/path/to/bag rate:=2.0
ros2 launch mr_damper_ros identify.launch.py namespace:=left bridge_config:=/path/to/bridge.yaml
"""

import os

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    EqualsSubstitution,
    LaunchConfiguration,
    NotEqualsSubstitution,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "mr_damper_ros"

# Recorded names are absolute; made relative, they follow the namespace.
RECORDED_TOPICS = ("mts/samples", "supply/current", "temperature")

PROFILES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
"""Where either is set, it holds; Fast DDS of Jazzy reads the first."""


def generate_launch_description() -> LaunchDescription:
    bag = LaunchConfiguration("bag")

    def config(node: str) -> PathJoinSubstitution:
        return PathJoinSubstitution([FindPackageShare(PACKAGE), "config", f"{node}.yaml"])

    def value(name: str, kind: type) -> ParameterValue:
        return ParameterValue(LaunchConfiguration(name), value_type=kind)

    arguments = [
        DeclareLaunchArgument(
            "bag", default_value="", description="Bag to play; empty starts the bridge instead."
        ),
        DeclareLaunchArgument(
            "rate", default_value="1.0", description="Speed; 0.0 is as fast as possible."
        ),
        DeclareLaunchArgument(
            "loop", default_value="false", description="Play the recording again and again."
        ),
        DeclareLaunchArgument(
            "namespace", default_value="", description="Namespace; one for each damper."
        ),
        DeclareLaunchArgument(
            "use_sim_time",
            default_value=NotEqualsSubstitution(bag, ""),
            description="Take the time from /clock, which a bag that is played provides.",
        ),
        *(
            DeclareLaunchArgument(
                f"{node}_config",
                default_value=config(node),
                description=f"Parameter file of the {node}.",
            )
            for node in ("bridge", "replay", "identifier", "model")
        ),
    ]

    # Nodes that are started again are found at once.
    profiles = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", "fastdds.xml"])
    environment = {} if any(map(os.environ.get, PROFILES)) else {PROFILES[0]: profiles}

    def node(name: str, **details: object) -> Node:
        return Node(
            package=PACKAGE,
            executable=name,
            name=name,
            namespace=LaunchConfiguration("namespace"),
            output="screen",
            additional_env=environment,
            **details,
        )

    # Identifier and model are there before the first sample.
    source = {
        "rate": value("rate", float),
        "loop": value("loop", bool),
        "wait_for_subscribers": 2,
    }
    time = {"use_sim_time": value("use_sim_time", bool)}
    nodes = [
        node(
            "replay",
            condition=IfCondition(NotEqualsSubstitution(bag, "")),
            parameters=[LaunchConfiguration("replay_config"), {**source, "bag": value("bag", str)}],
            remappings=[(f"/{topic}", topic) for topic in RECORDED_TOPICS],
        ),
        node(
            "bridge",
            condition=IfCondition(EqualsSubstitution(bag, "")),
            parameters=[LaunchConfiguration("bridge_config"), source],
        ),
        node("identifier", parameters=[LaunchConfiguration("identifier_config"), time]),
        node("model", parameters=[LaunchConfiguration("model_config"), time]),
    ]
    return LaunchDescription([*arguments, *nodes])
