"""Transient faults under control: control returns, and not while the force is wrong.

A controller with the exact set tracks a viscous damper; the rig and its instruments have the faults
of :mod:`benchmarks.faults` that end and that the signals can show.
"""

from __future__ import annotations

import sys
import zlib
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from benchmarks.dampers import DAMPERS
from benchmarks.faults import SCENARIOS, STREAMS, Scenario
from benchmarks.figure import Measured, in_processes, some_of
from mr_damper_ros.control.force_controller import Command, ForceController, ForceControlSettings
from mr_damper_ros.emulation.commanded_rig import commanded
from mr_damper_ros.emulation.emulator import (
    HIGHEST_CURRENT,
    THESIS_FORCE_NOISE,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
    SupplySetpoint,
)
from mr_damper_ros.emulation.faults import Instruments, faults_of
from mr_damper_ros.rig.blocks import Meter
from mr_damper_ros.signals.blocks import BlockError, CurrentError, RigBlock, check_live

BLOCK, PERIOD = 10, 1e-3
_LENGTH = BLOCK * PERIOD
BEGIN, END, DURATION = 8.0, 12.0, 24.0
"""Times [s] at which the fault begins and ends, and at which the trial ends."""

DAMPING = 9000.0
"""Desired damping [N s/m]."""

WRONG = 0.2
"""Error of a wrong force, relative to the peak of the last ten seconds."""

_STEADY = 0.3
"""Time [s] for which the force must be valid and right to count as recovered."""

FAULTS = [
    each
    for each in SCENARIOS
    if each.faults and not (each.lasts or each.unknowable or each.other_damper)
]


class Returned(NamedTuple):
    """Time [s] from the recovery of the force to control, infinite without a return.

    It is NaN if the force never recovers, because the damper has changed. ``while_wrong`` counts
    the returns from the safe current while the force was wrong.
    """

    name: str
    after: float
    while_wrong: int


def returned(scenario: Scenario, seed: int = 0) -> Returned:
    """Control through a fault."""
    damper = DAMPERS["viscous_tanh"]
    known = replace(damper, peak_velocity_range=(0.0, 0.5), current_range=(0.0, HIGHEST_CURRENT))
    times = f"@{BEGIN:g}-{END:g}"
    faults = faults_of(
        [text + times for text in scenario.faults.split()],
        zlib.crc32(scenario.name.encode()) + seed,
    )
    supply, motion = SupplySetpoint(0.0), STREAMS[scenario.stream][0](seed)
    rig = EmulatedRig(
        EmulatedDamper(damper),
        motion,
        supply,
        settings=RigSettings(force_noise=0.0, seed=seed),
        faults=faults,
    )
    rig.live = True
    instruments, meter = Instruments(faults), Meter(0.1, step=0.005)
    controller = ForceController(ForceControlSettings(highest_current=HIGHEST_CURRENT))
    controller.predictor.set_parameters(known)
    rng = np.random.default_rng(seed)
    # For each block: whether control is permitted, the safe current is commanded, the predicted
    # force is valid; and the predicted and the true force [N].
    rows: list[tuple[bool, bool, bool, float, float]] = []
    current = 0.0

    def answer(sent: RigBlock, wanted: float, now_ns: int) -> Command | None:
        for reading in meter.read(sent, sent.current, sent.supply_ahead_ns):
            try:
                controller.predictor.add_current(*reading)
            except CurrentError:
                continue
        try:
            samples = sent.samples
            check_live(samples)
        except BlockError:
            return None
        controller.want(samples.end_ns, wanted)
        command = controller.command(samples, now_ns)
        controller.predictor.catch_up()
        return command

    def choose(made: RigBlock) -> float:
        nonlocal current
        noise = rng.standard_normal((2, made.sample_count))
        shown = replace(
            made,
            displacement=made.displacement + 1e-6 * noise[0],
            force=made.force + THESIS_FORCE_NOISE * noise[1],
        )
        step = float(made.displacement[-1] - made.displacement[0])
        wanted = DAMPING * step / (PERIOD * (made.sample_count - 1))
        now_ns = rig.settings.start_ns + round(len(rows) * _LENGTH * 1e9)
        commands = [answer(sent, wanted, now_ns) for sent, _ in instruments.read(shown)]
        command = commands[-1] if commands else None
        true = float(made.force[-1])
        if command is None:
            rows.append((False, False, False, np.nan, true))
        else:
            current = command.current
            said = command.prediction
            force = float(said.force[-1]) if said.force.size else np.nan
            valid = not said.newest_doubt
            rows.append((not command.doubt, command.falls_back, valid, force, true))
        return current

    for _ in commanded(rig, supply, choose, BLOCK, DURATION):
        pass
    permitted, fallen, valid, predicted, true = np.array(rows).T
    time = np.arange(true.size) * _LENGTH
    peak = [np.abs(true[max(place - 1000, 0) : place + 1]).max() for place in range(true.size)]
    right = np.abs(predicted - true) <= WRONG * np.array(peak)
    count = round(_STEADY / _LENGTH)
    steady = np.convolve((valid > 0.0) & right, np.ones(count), mode="valid") >= count
    recovered = np.flatnonzero(steady & (time[: steady.size] >= END))
    back = np.flatnonzero(permitted > 0.0)
    back = back[back >= recovered[0]] if recovered.size else back[:0]
    after = np.nan
    if recovered.size:
        after = time[back[0]] - time[recovered[0]] if back.size else np.inf
    while_wrong, lost = 0, False
    for place in range(true.size):
        if lost and permitted[place] and time[place] >= BEGIN:
            known = ~np.isnan(predicted[place - BLOCK : place])
            before = right[place - BLOCK : place][known]
            while_wrong += before.size > 0 and not before.mean() > 0.5
        lost = bool(fallen[place]) or (lost and not permitted[place])
    return Returned(scenario.name, float(after), while_wrong)


def figures(every: int = 1, seed: int = 0) -> Measured:
    """The slowest return after a fault, and the returns to control while the force was wrong."""
    chosen = some_of(FAULTS, every, seed)
    results = in_processes(returned, chosen, [seed] * len(chosen))
    print(*results, sep="\n", file=sys.stderr)
    ended = [each for each in results if not np.isnan(each.after)]
    slowest = max(ended, key=lambda each: each.after)
    wrong = [each for each in results if each.while_wrong]
    return {
        "return_s": (slowest.after, f"{slowest.name}; of {len(ended)} of {len(results)} faults."),
        "returned_while_wrong": (
            float(sum(each.while_wrong for each in wrong)),
            "; ".join(f"{each.name}: {each.while_wrong}" for each in wrong),
        ),
    }
