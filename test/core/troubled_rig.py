"""Emulated rigs with one fault each, which `check_rig` must name."""

from __future__ import annotations

from functools import cache

import numpy as np

from mr_damper_ros.emulation.emulator import EmulatedDamper, EmulatedRig, RigSettings
from mr_damper_ros.emulation.faults import Instruments, faults_of
from mr_damper_ros.emulation.motions import (
    BandLimitedMotion,
    Excitation,
    SineMotion,
    chirp,
    stepped,
)
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.rig_check.record import HeardBlock, RigRecord, Trouble

SECONDS = 30.0
RATE = 1000.0
BLOCK = 20
SECOND = 10**9
MOTIONS: dict[str, Excitation] = {
    "steps": stepped(0.005, 0.5, 3.0, SECONDS),
    "sine": SineMotion(0.005, 1.0),
    "fast": SineMotion(0.002, 4.0),
    "chirp": chirp(0.005, 0.5, 3.0, SECONDS),
    "random": BandLimitedMotion(0.01, 0.3, 4.0, 1),
}


@cache
def record(
    faults: str = "", motion: str = "steps", current: float = 1.0, seed: int = 0
) -> RigRecord:
    """Messages of an emulated rig with these faults."""
    found = faults_of(faults.split(), seed)
    rig = EmulatedRig(
        EmulatedDamper(THESIS_28_CELSIUS),
        MOTIONS[motion],
        current,
        settings=RigSettings(displacement_noise=2e-6, seed=seed),
        faults=found,
    )
    instruments = Instruments(found)
    heard = RigRecord()
    for count in range(round(SECONDS * RATE / BLOCK)):
        made = rig.next_block(BLOCK)
        for block, _ in instruments.read(made):
            heard.blocks.append(
                HeardBlock(
                    block.start_ns,
                    block.sequence,
                    block.period,
                    block.displacement,
                    block.force,
                    made.stamp_ns(BLOCK - 1),
                )
            )
            if count % 5 == 0 and np.isfinite(block.current[0]):
                stamp = block.start_ns + block.supply_ahead_ns
                heard.measured.append((stamp, float(block.current[0])))
                heard.commanded.append((made.start_ns, current))
    return heard


FAULTS = {
    "swapped": Trouble.SWAPPED,
    "force_gain:-1": Trouble.INVERTED,
    "displacement_gain:-1": Trouble.INVERTED,
    "displacement_gain:1000": Trouble.UNIT,
    "force_gain:0.001": Trouble.UNIT,
    "force_offset:800": Trouble.OFFSET,
    "force_delay:0.003": Trouble.SKEW,
    "displacement_delay:0.004": Trouble.SKEW,
    "force_noise:60": Trouble.NOISE,
    "displacement_noise:3e-5": Trouble.NOISE,
    "force_hum:20": Trouble.HUM,
    "displacement_hum:2e-5": Trouble.HUM,
    "force_clip:600": Trouble.CLIPPED,
    "displacement_clip:0.004": Trouble.CLIPPED,
    "force_coarse:40": Trouble.COARSE,
    "displacement_coarse:0.0005": Trouble.COARSE,
    "force_spikes:500": Trouble.SPIKES,
    "force_stuck": Trouble.STUCK,
    "force_nan": Trouble.NOT_FINITE,
    "wrong_period:2": Trouble.RATE,
    "stamp_jitter:0.5": Trouble.JITTER,
    "lost_blocks:0.02": Trouble.LOST,
    "doubled_blocks:0.05": Trouble.REPEATED,
    "reordered_blocks:0.05": Trouble.REPEATED,
    "clock_jump:60@15": Trouble.RESTARTED,
    "late_blocks": Trouble.BURSTS,
    "current_missing": Trouble.NO_CURRENT,
    "current_offset:0.2": Trouble.CURRENT,
    "supply_clock:2": Trouble.CURRENT_CLOCK,
    "tempo:0": Trouble.AT_REST,
}
"""Expected name of each fault."""
