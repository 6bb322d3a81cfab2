"""The topic that commands the motion, for a bridge whose machine moves as it is told."""

from __future__ import annotations

from mr_damper_msgs.msg import ExcitationCommand
from rclpy.node import Node
from std_msgs.msg import Header

from mr_damper_ros.kinematics.periodic_motion import MotionKind, PeriodicMotion
from mr_damper_ros.nodes.command_topic import CommandTopic
from mr_damper_ros.nodes.diagnostics import OK, Finding
from mr_damper_ros.rig.commander import MotionCommander

EXCITATION_TOPIC = "rig/excitation_command"

_KINDS = (MotionKind.SINE, MotionKind.SWEEP, MotionKind.RANDOM)
"""In the order of their numbers in ExcitationCommand.msg."""


class MotionCommands(CommandTopic):
    """Hands commands of the motion on to the commander of a machine."""

    kind, topic, what = ExcitationCommand, EXCITATION_TOPIC, "the motion"

    def __init__(self, node: Node, commander: MotionCommander) -> None:
        self._commander = commander
        super().__init__(node, commander)

    def _obey(self, message: ExcitationCommand, stamp_ns: int, age: float, now: float) -> str:
        try:
            motion = motion_of(message)
        except ValueError as error:
            return self._commander.refuse(str(error))
        return self._commander.command(motion, stamp_ns, age, now)

    def _state(self, now: float) -> Finding:
        if not self._commander.commanded:
            return Finding(OK, "the machine moves by itself until a command comes")
        motion = self._commander.wanted(now)
        if motion is None:
            return Finding(OK, "the machine rests")
        return Finding(OK, f"{motion.sentence} commanded")


def command_message(header: Header, motion: PeriodicMotion | None) -> ExcitationCommand:
    """The command of a motion, None for rest."""
    if motion is None:
        return ExcitationCommand(header=header)
    return ExcitationCommand(
        header=header,
        amplitude=motion.amplitude,
        frequency=motion.frequency,
        motion=_KINDS.index(motion.kind),
        highest_frequency=motion.highest_frequency,
        period=motion.period,
        seed=motion.seed,
    )


def motion_of(message: ExcitationCommand) -> PeriodicMotion | None:
    """The motion of a command, None for rest. Raises ValueError where it makes no sense."""
    if message.amplitude == 0.0:
        return None
    if message.motion >= len(_KINDS):
        raise ValueError(f"the motion {message.motion} is unknown")
    kind = _KINDS[message.motion]
    if kind is MotionKind.SINE:
        return PeriodicMotion(kind, message.amplitude, message.frequency)
    return PeriodicMotion(
        kind,
        message.amplitude,
        message.frequency,
        message.highest_frequency,
        message.period,
        message.seed,
    )
