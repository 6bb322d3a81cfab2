"""The topic that commands a current, for the supply node and for a bridge that has a supply."""

from __future__ import annotations

from collections.abc import Callable

from mr_damper_msgs.msg import CurrentCommand
from rclpy.node import Node

from mr_damper_ros.nodes.command_topic import CommandTopic
from mr_damper_ros.nodes.diagnostics import OK, WARN, Finding
from mr_damper_ros.rig.commander import CurrentCommander, Origin

COMMAND_TOPIC = "supply/current_command"


class CurrentCommands(CommandTopic):
    """Hands commands of the current on; ``heard`` is called after each that holds."""

    kind, topic, what = CurrentCommand, COMMAND_TOPIC, "the current"

    def __init__(
        self, node: Node, commander: CurrentCommander, heard: Callable[[], None] = lambda: None
    ) -> None:
        self._commander = commander
        self._heard = heard
        super().__init__(node, commander)

    def _obey(self, message: CurrentCommand, stamp_ns: int, age: float, now: float) -> str:
        refusal = self._commander.command(message.current, stamp_ns, age, now)
        if not refusal:
            self._heard()
        return refusal

    def _state(self, now: float) -> Finding:
        origin = self._commander.origin(now)
        level = WARN if origin is Origin.TIMED_OUT else OK
        values = {"origin": origin.name, "cut": self._commander.cut}
        return Finding(level, f"the current is {origin.value}", values)
