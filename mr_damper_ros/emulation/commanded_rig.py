"""Off-line simulation of an emulated rig with closed-loop current control.

The current is chosen after each block, as by the nodes in real time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

from mr_damper_ros.control.force_controller import Command, ForceController, ForceControlSettings
from mr_damper_ros.emulation.emulator import MeasuredRig, SupplySetpoint
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.tracking.engine import Engine
from mr_damper_ros.tracking.predictor import Prediction
from mr_damper_ros.tracking.reports import Report


class CommandedBlock(NamedTuple):
    """The measured block and the current [A] commanded after it.

    ``motion``: the true motion, a :class:`PlantMotion`; None without a plant.
    """

    measured: RigBlock
    current: float
    motion: Any


Choice = Callable[[RigBlock], float]
"""Chooses a current [A] after every block."""


def commanded(
    rig: MeasuredRig, supply: SupplySetpoint, choose: Choice, block_size: int, duration: float
) -> Iterator[CommandedBlock]:
    """Run the rig for ``duration`` [s] and yield its blocks.

    The current chosen after a block takes effect in the next block.
    """
    period = rig.settings.period
    for number in range(1, round(duration / period / block_size) + 1):
        measured = rig.next_block(block_size)
        current = choose(measured)
        supply.set(number * block_size * period, current)
        yield CommandedBlock(measured, current, rig.motion)


class ForceChoice:
    """Chooses the current for a desired force, as the controller node does, from a known set.

    ``wanted`` returns the desired force [N] after a block. With an ``engine``, the damper is
    identified during the run, as the identifier and model nodes do, and the controller follows the
    published reports and parameters. ``predicted`` is the engine's prediction for the last block.
    """

    def __init__(
        self,
        settings: ForceControlSettings,
        known: ParameterSet,
        wanted: Callable[[RigBlock], float],
        engine: Engine | None = None,
    ) -> None:
        self.controller = ForceController(settings)
        self.controller.predictor.set_parameters(known)
        self._wanted = wanted
        self._engine = engine
        self.last: Command | None = None
        self.predicted: Prediction | None = None
        self.reports: list[Report] = []

    def __call__(self, measured: RigBlock) -> float:
        """The current [A] to supply after this block."""
        controller, engine = self.controller, self._engine
        block = measured.samples
        # The current changes only between blocks.
        current = measured.start_ns, float(measured.current[0])
        controller.predictor.add_current(*current)
        controller.want(block.end_ns, self._wanted(measured))
        self.last = controller.command(block)
        controller.predictor.catch_up()
        if engine is not None:
            engine.add_current(*current)
            self.predicted = engine.predict(block)
            for publication in engine.take_publications():
                self.reports.append(publication.report)
                controller.predictor.follow_report(publication.report)
                found = publication.parameters
                if found is not None:
                    controller.predictor.follow_set(found)
        return self.last.current
