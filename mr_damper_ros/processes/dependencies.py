"""Sentences about packages that must be installed and are not."""

from __future__ import annotations

from importlib.util import find_spec

_PIP_NAMES = {
    **{name: name for name in ("aiohttp", "matplotlib", "mcap", "numpy", "rosbags", "scipy")},
    "yaml": "PyYAML",
}
"""Python packages that this package needs, by module."""

_OF_ROS = {"ament_index_python", "builtin_interfaces", "rcl_interfaces", "rclpy", "std_srvs"}
"""Packages of ROS that this package needs, apart from those whose names end in ``_msgs``."""

_ROSDEP = "PIP_BREAK_SYSTEM_PACKAGES=1 rosdep install --from-paths src --ignore-src"


def missing_dependency(error: ModuleNotFoundError) -> str:
    """How to install what is missing, in one sentence; empty if this package does not need it."""
    name = (error.name or "").partition(".")[0]
    if name in _PIP_NAMES:
        return (
            f"the Python package {name} is missing: in a workspace, `{_ROSDEP}` installs it, "
            f"elsewhere `pip install {_PIP_NAMES[name]}`"
        )
    if name not in _OF_ROS and not name.endswith("_msgs"):
        return ""
    if name == "rclpy" or find_spec("rclpy") is None:
        return (
            f"it needs ROS 2, but Python does not find {name}: source the setup.bash of the "
            "workspace in which this package was built, or env.bash of its folder"
        )
    if name == "mr_damper_msgs":
        return (
            "the package mr_damper_msgs is missing: build it too (in a workspace: "
            "ln -s mr_damper_ros/msg_defs src/mr_damper_msgs, then colcon build) and source "
            "install/setup.bash"
        )
    return f"the ROS package {name} is missing: in a workspace, `{_ROSDEP}` installs it"
