"""Identification of a stream without a node: samples in, reports and sets out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import known
import pytest
from step_worker import StepWorker

from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.tracking.identifier import Identifier, PipelineSettings, Publication
from mr_damper_ros.tracking.tracker import TrackerSettings, WindowTracker
from mr_damper_ros.tracking.window_assembler import WindowAssembler, WindowSettings

START = ParameterSet(known.weaker(0.8), set_id="start")
RUN = known.run(samples=3000)


class StateByHand:
    """Replaces the state folder; a state is written when :meth:`write` is called."""

    def __init__(self) -> None:
        self.given = 0
        self.written = 0
        self.fault = ""
        self.path = None

    @property
    def progress(self) -> tuple[int, int]:
        return self.given, self.written

    def keep(self) -> None:
        self.given += 1

    def keep_now(self) -> str:
        self.given += 1
        self.written = self.given
        return ""

    def write(self) -> None:
        self.written = self.given

    def close(self) -> None:
        self.write()


def identifier(disk: Any) -> Identifier:
    tracker = WindowTracker(TrackerSettings(method="least_squares", global_period=0), START)
    worker: Any = StepWorker()
    return Identifier(
        WindowAssembler(WindowSettings(1.0, 1.0, looks=0)),
        tracker,
        worker,
        PipelineSettings(),
        disk,
    )


def feed(made: Identifier, samples: int = 3000) -> None:
    made.add_current(known.T0, RUN.current)
    for block in known.blocks(RUN.displacement[:samples], RUN.force[:samples], [100]):
        assert made.add_block(block) == []
    made.add_current(known.T0 + 10**11, RUN.current)


def worked_off(made: Identifier) -> list[Any]:
    events: list[Any] = []
    worker: Any = made.worker
    while worker.function is not None:
        worker.work()
        events += made.poll()
    return events


def test_a_set_is_given_out_once_it_is_on_disk() -> None:
    disk = StateByHand()
    made = identifier(disk)
    feed(made, 1000)
    assert worked_off(made) == []
    assert disk.given == 1
    disk.write()
    (found,) = made.poll()
    assert isinstance(found, Publication)
    assert found.parameters is not None
    assert made.take_notices() == []


@pytest.mark.parametrize(
    "switch", [lambda made: made.reset(), lambda made: made.replace(START)], ids=["reset", "load"]
)
def test_another_set_forgets_what_runs_and_is_kept(switch: Callable[[Identifier], str]) -> None:
    disk = StateByHand()
    made = identifier(disk)
    feed(made, 1000)
    worked_off(made)
    made.flush()
    given = disk.given
    assert switch(made) == ""
    assert made.tracker.parameters is START
    assert disk.written == given + 1
