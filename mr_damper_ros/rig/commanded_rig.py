"""A plant whose damper's current is chosen block by block: off line what nodes do in real time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from mr_damper_ros.control.force_controller import Command, ForceController
from mr_damper_ros.rig.plant_rig import PlantMotion, PlantRig
from mr_damper_ros.rig.rig_block import RigBlock
from mr_damper_ros.rig.supply_knob import SupplyKnob
from mr_damper_ros.signals.blocks import SampleBlock


class CommandedBlock(NamedTuple):
    """What was measured, what was the case, and the current [A] that is commanded thereafter."""

    measured: RigBlock
    motion: PlantMotion
    current: float


Choice = Callable[[RigBlock], float]
"""Chooses a current [A] after every block."""


def commanded(
    rig: PlantRig, knob: SupplyKnob, choose: Choice, block_size: int, duration: float
) -> Iterator[CommandedBlock]:
    """Let the plant move for ``duration`` [s]; a choice takes effect with the next block."""
    period = rig.settings.period
    for number in range(1, round(duration / period / block_size) + 1):
        measured = rig.next_block(block_size)
        assert rig.motion is not None
        current = choose(measured)
        knob.turn(number * block_size * period, current)
        yield CommandedBlock(measured, rig.motion, current)


class ForceChoice:
    """Chooses the current for the force [N] that ``wanted`` gives, as the controller node does."""

    def __init__(self, controller: ForceController, wanted: Callable[[RigBlock], float]) -> None:
        self.controller = controller
        self._wanted = wanted
        self.last: Command | None = None

    def __call__(self, measured: RigBlock) -> float:
        """The current [A] after a block."""
        controller = self.controller
        block = SampleBlock(
            measured.start_ns,
            measured.sequence,
            measured.period,
            measured.displacement,
            measured.force,
        )
        # The current changes between blocks alone.
        controller.predictor.add_current(measured.start_ns, float(measured.current[0]))
        controller.want(block.end_ns, self._wanted(measured))
        self.last = controller.command(block)
        controller.catch_up()
        return self.last.current
