"""Bridge and controller together: the emulated rig gives the desired force."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from mr_damper_msgs.msg import CurrentCommand, DesiredForce, MtsSamples
from support import Listener

from mr_damper_ros.emulation.plant_rig import invented_damper
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.messages import from_field, header, to_nanoseconds

VALUES = {**invented_damper(0.01).as_dict(), "compliance": 0.0, "stiffness": 0.0, "offset": 0.0}
DAMPER = ParameterSet(
    np.array([VALUES[name] for name in MODELS["sigmoid_lag"].parameter_names]),
    set_id="known",
    model="sigmoid_lag",
    peak_velocity_range=(0.0, 0.5),
    current_range=(0.0, 2.0),
)

WANTED = 400.0
"""[N], in the direction that the damper moves."""


def test_the_emulated_rig_gives_the_desired_force(
    start: Any, listener: Listener, tmp_path: Path
) -> None:
    path = tmp_path / "known.yaml"
    DAMPER.save(path)
    commands = listener.listen(CurrentCommand, "supply/current_command")
    demand = listener.node.create_publisher(DesiredForce, "damper/desired_force", quality.stream(1))
    errors: list[float] = []

    def want(message: MtsSamples) -> None:
        """A force of one size that resists the motion."""
        u = from_field(message.displacement)
        velocity = float(u[-1] - u[0])
        stamp_ns = to_nanoseconds(message.header.stamp)
        force = math.copysign(WANTED, velocity)
        demand.publish(DesiredForce(header=header(stamp_ns, "damper"), force=force))
        # Not where the motion turns.
        if abs(velocity) > 2e-4 and commands and commands[-1].current > 0.0:
            errors.append(abs(float(from_field(message.force)[-1]) - force))

    listener.listen(MtsSamples, "mts/samples", take=want)
    start("controller", parameter_file=path, demand_timeout=1.0, maximum_error=0.0, max_age=2.0)
    listener.wait_for_publishers("supply/current_command")
    start(
        "bridge",
        emulated__damper=path,
        emulated__current=0.0,
        emulated__coil_time_constant=0.0,
        wait_for_subscribers=1,
    )
    listener.until(lambda: len(errors) >= 400, "controlled motion")
    # Median error of the force, of the wanted one: on a busy computer commands come late.
    assert np.median(errors[200:]) < 0.25 * WANTED
    assert len({round(command.current, 2) for command in commands[-200:]}) > 2
