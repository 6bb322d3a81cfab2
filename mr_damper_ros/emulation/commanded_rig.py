"""A rig whose current is chosen block by block: off line what the nodes do in real time."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

from mr_damper_ros.control.force_controller import Command, ForceController
from mr_damper_ros.emulation.emulator import MeasuredRig, SupplyKnob
from mr_damper_ros.emulation.plant_rig import PlantMotion, PlantRig
from mr_damper_ros.signals.blocks import RigBlock, SampleBlock
from mr_damper_ros.tracking.engine import Engine
from mr_damper_ros.tracking.predictor import Prediction
from mr_damper_ros.tracking.reports import Report


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
    for measured, current in turned(rig, knob, choose, block_size, duration):
        assert rig.motion is not None
        yield CommandedBlock(measured, rig.motion, current)


def turned(
    rig: MeasuredRig, knob: SupplyKnob, choose: Choice, block_size: int, duration: float
) -> Iterator[tuple[RigBlock, float]]:
    """The blocks of ``duration`` [s] and the current [A] that is chosen after each."""
    period = rig.settings.period
    for number in range(1, round(duration / period / block_size) + 1):
        measured = rig.next_block(block_size)
        current = choose(measured)
        knob.turn(number * block_size * period, current)
        yield measured, current


class ForceChoice:
    """Chooses the current for the force [N] that ``wanted`` gives, as the controller node does.

    With an ``engine`` the damper is identified meanwhile, as by identifier and model, and the
    controller takes what that publishes; ``predicted`` is the engine's prediction of the block.
    """

    def __init__(
        self,
        controller: ForceController,
        wanted: Callable[[RigBlock], float],
        engine: Engine | None = None,
    ) -> None:
        self.controller = controller
        self._wanted = wanted
        self._engine = engine
        self.last: Command | None = None
        self.predicted: Prediction | None = None
        self.reports: list[Report] = []

    def __call__(self, measured: RigBlock) -> float:
        """The current [A] after a block."""
        controller, engine = self.controller, self._engine
        block = SampleBlock(
            measured.start_ns,
            measured.sequence,
            measured.period,
            measured.displacement,
            measured.force,
        )
        # The current changes between blocks alone.
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
                    controller.predictor.set_parameters(found, found.stamp_ns or None)
        return self.last.current
