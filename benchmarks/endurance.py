"""Hours of data through the three nodes, faster than they would come: memory and logs."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path

from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import SetParameters
from rclpy.parameter import Parameter

from benchmarks.figure import Figure
from benchmarks.three_nodes import ThreeNodes
from mr_damper_ros.processes.programs import resident_bytes

RATE = 20.0
"""Speed relative to the data's time."""

_CURRENTS = (1.5, 1.0, 0.5)
"""The supply is set to these [A] in turn: new baselines, a fuller reservoir, refused windows."""

_CURRENT_PERIOD = 20.0
"""Seconds between two settings of the supply."""

_BUILD = Path("build")

_LOOK = 1.0
"""Seconds between two looks at the memory in use."""

_EDGE = 0.1
"""The memory at the start and at the end is the median over this part of the time between."""

_MB = 1e6

_OPTIONS: dict[str, dict[str, object]] = {
    "bridge": {"rate": RATE, "block_size": 100},
    # On a busy computer fits fall behind at this speed: what waits for them is no leak.
    "identifier": {
        "hop": 2.0,
        "waiting_windows": 10,
        "method": "least_squares",
        "global_period": 500,
    },
    "model": {},
}


def figures(hours: float = 8.0, warm_up: float = 1.0) -> list[Figure]:
    """Stream so many hours of data; the first ``warm_up`` hours do not count.

    Within the first hour memory grows by design: nodes keep the currents of an hour.
    """
    growth, errors = soak(hours, warm_up)
    worst = max(growth, key=lambda name: growth[name])
    return [
        Figure(
            "soak_growth_mb",
            growth[worst],
            f"{hours:g} h of data at {RATE:g} x: growth [MB] of the resident memory of the process "
            f"that grows most, from {warm_up:g} h of data to the end",
            (-float("inf"), 5.0),
            ", ".join(f"{name} {value:+.2f}" for name, value in growth.items()),
        ),
        Figure(
            "soak_errors",
            len(errors),
            "lines that tell of an error in the logs of the three nodes, and nodes that ended",
            (0.0, 0.0),
            errors[0] if errors else "",
        ),
    ]


def soak(hours: float, warm_up: float) -> tuple[dict[str, float], list[str]]:
    """Growth [MB] of each process, and what went wrong."""
    _BUILD.mkdir(exist_ok=True)
    with (
        tempfile.TemporaryDirectory(dir=_BUILD, prefix="soak-") as folder,
        ThreeNodes(Path(folder).absolute(), _OPTIONS) as rig,
    ):
        supply = _Supply(rig)
        seconds = 3600.0 / RATE
        _watch(rig, supply, warm_up * seconds)
        used = _watch(rig, supply, (hours - warm_up) * seconds)
        errors = rig.errors + [
            f"the {name} has ended" for name, node in rig.nodes.items() if not node.running
        ]
        if not any(report.accepted for report in rig.reports[-100:]):
            errors.append("no window was accepted at the end")
    edge = max(round(_EDGE * len(next(iter(used.values())))), 1)
    growth = {
        name: (statistics.median(sizes[-edge:]) - statistics.median(sizes[:edge])) / _MB
        for name, sizes in used.items()
    }
    return growth, errors


class _Supply:
    """Turns the knob of the bridge's supply now and then."""

    def __init__(self, rig: ThreeNodes) -> None:
        self._client = rig.observer.node.create_client(SetParameters, "bridge/set_parameters")
        self._next = time.monotonic()
        self._turns = 0

    def turn_if_due(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next += _CURRENT_PERIOD
        self._turns += 1
        current = _CURRENTS[self._turns % len(_CURRENTS)]
        message: ParameterMessage = Parameter("emulated.current", value=current).to_parameter_msg()
        self._client.call_async(SetParameters.Request(parameters=[message]))


def _watch(rig: ThreeNodes, supply: _Supply, duration: float) -> dict[str, list[int]]:
    """Memory [B] of each process, look by look."""
    used: dict[str, list[int]] = {name: [] for name in [*rig.nodes, "worker"]}
    end = time.monotonic() + duration
    while time.monotonic() < end or not used["worker"]:
        supply.turn_if_due()
        rig.observer.spin_for(_LOOK)
        worker = rig.worker
        if worker is None:
            continue  # it would be an error in the log
        for name, node in rig.nodes.items():
            used[name].append(node.resident_bytes)
        used["worker"].append(resident_bytes(worker))
        # What was heard is not the subject: this program's own memory shall not grow either.
        del rig.reports[:-1000], rig.sets[:-1000]
    return used
