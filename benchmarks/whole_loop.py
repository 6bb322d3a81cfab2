"""Identifier, model and controller together, with default settings as users start them.

The loop is that of doc/control.md: a quarter car on a road, the node `suspension` that computes the
desired force, the controller, the identifier and the model, all with the parameter file of the
damper (`parameters:=`). The loop runs offline on the time of the stamps, with the objects of the
nodes.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product, repeat
from typing import NamedTuple

import numpy as np

from benchmarks.dampers import DAMPERS as OTHER_DAMPERS
from benchmarks.dampers import ForeignDamper
from benchmarks.figure import Measured, in_processes, some_of
from benchmarks.motions import random_motion
from benchmarks.motions import switched as switched_current
from mr_damper_ros.api.replay import replay
from mr_damper_ros.control.force_controller import ForceControlSettings
from mr_damper_ros.control.linear_plant import IsoRoad, QuarterCar
from mr_damper_ros.control.semi_active import SuspensionSettings, controller_of
from mr_damper_ros.emulation.commanded_rig import ForceChoice, commanded
from mr_damper_ros.emulation.emulator import (
    HIGHEST_CURRENT,
    HOT_FORCE,
    Damper,
    EmulatedDamper,
    EmulatedRig,
    PlantRig,
    RigSettings,
    SupplySetpoint,
    ThermalModel,
    invented_damper,
)
from mr_damper_ros.emulation.motions import Excitation, SineMotion
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS
from mr_damper_ros.rig.sources.emulated_source import QuarterCarOptions, suspension_state_of
from mr_damper_ros.signals.arrays import Array
from mr_damper_ros.signals.blocks import RigBlock
from mr_damper_ros.signals.recording import Recording
from mr_damper_ros.tracking.engine import Engine, EngineSettings
from mr_damper_ros.tracking.predictor import PredictorSettings
from studies.recordings import rms

BLOCK, PERIOD = 10, 1e-3
_LENGTH = BLOCK * PERIOD

SETTLED = 5.0
"""Time [s] after which results are evaluated: the motion is known, and control is active."""

LAG = 0.01
"""Time constant [s] of the coil, as in the bridge and in config/invented_damper.yaml."""

_UNWATCHED = PredictorSettings(maximum_error=0.0)
"""The measured force is not compared with the predicted one."""


def chosen(
    wanted: Callable[[RigBlock], float],
    known: ParameterSet,
    engine: Engine | None,
    *,
    watched: bool = True,
) -> ForceChoice:
    """The controller with its defaults, as it is started with a parameter file.

    ``watched`` says whether the controller checks the measured force (``maximum_error``).
    """
    settings = ForceControlSettings(highest_current=HIGHEST_CURRENT)
    if not watched:
        settings = replace(settings, predictor=_UNWATCHED)
    return ForceChoice(settings, known, wanted, engine)


def smoothness(commands: Sequence[tuple[float, bool]]) -> tuple[float, float]:
    """Reversals of the current, and starts of falling back to the safe current, per second.

    There is a command [A] for each block, with whether it falls back. Changes of less than 20 mA
    are not counted.
    """
    currents, falls = np.array(commands)[round(SETTLED / _LENGTH) :].T
    moves = np.diff(currents)
    turns = np.diff(np.sign(moves[np.abs(moves) > 0.02]))
    drops = np.diff(falls) > 0.0
    seconds = currents.size * BLOCK * PERIOD
    return float(np.count_nonzero(turns)) / seconds, float(np.count_nonzero(drops)) / seconds


# -- a quarter car ---------------------------------------------------------------------------------

DRIVES = tuple(product(("A", "B", "C", "D"), range(5)))
"""Roads and seeds."""

SPEED = 20.0
DRIVEN = 30.0


class Driven(NamedTuple):
    """Result of a drive.

    ``valid`` is the fraction of samples with valid predicted force [1]. ``nrmse`` is that of the
    valid force, and ``exact`` that of the exact set at the same samples. ``reversals`` of the
    current and ``drops`` to the safe current are counted per second. ``safe`` is the fraction of
    the time at the safe current, ``reach`` the highest permitted current at the end, relative to
    that of the user's set.
    """

    road: str
    seed: int
    valid: float
    nrmse: float
    exact: float
    reversals: float
    drops: float
    safe: float
    reach: float


def driven(road: str, seed: int, duration: float = DRIVEN, *, given: bool = True) -> Driven:
    """Drive on a road; with ``given``, the identifier has the parameter file too."""
    known = invented_damper(LAG)
    supply = SupplySetpoint(0.0)
    rig = PlantRig(
        EmulatedDamper(invented_damper(0.0), HOT_FORCE, built_in=True),
        QuarterCar().plant,
        IsoRoad(road, SPEED, seed),
        supply,
        settings=RigSettings(displacement_noise=1e-6, seed=seed),
        thermal=ThermalModel(initial_temperature=28.0, heat_capacity=430.0),
        coil_time_constant=LAG,
        substeps=2,
    )
    wanted = controller_of(SuspensionSettings())
    choice = chosen(
        lambda _: wanted(suspension_state_of(rig)), known, Engine(start=known if given else None)
    )
    rows: list[list[Array]] = []
    commands = []
    for measured, _, _ in commanded(rig, supply, choice, BLOCK, duration):
        assert choice.predicted is not None
        assert choice.last is not None
        assert rig.motion is not None
        predicted = choice.predicted
        rows.append(
            [
                *(predicted.force, predicted.doubts.astype(float), rig.motion.force),
                *(measured.displacement, measured.force, measured.current),
            ]
        )
        commands.append((choice.last.current, choice.last.falls_back))
    every = np.concatenate(rows, axis=1)
    # Force of the true set, independent of the measurement.
    exact = replay(
        Recording("drive", rig.settings.start_ns, PERIOD, *every[3:]),
        known,
        identify=False,
        settings=EngineSettings(predictor=_UNWATCHED).for_law(known.model),
    )
    late = slice(round(SETTLED / PERIOD), None)
    force, doubts, true = every[:3, late]
    valid = doubts == 0.0
    errors = [rms((each - true)[valid]) for each in (force, exact.predicted[late])]
    nrmse, right = (error / float(np.std(true[valid])) for error in errors)
    safe = np.mean([falls for _, falls in commands[round(SETTLED / _LENGTH) :]])
    share = float(np.mean(valid))
    turns, drops = smoothness(commands)
    reach = choice.controller.highest_known / HIGHEST_CURRENT
    return Driven(road, seed, share, nrmse, right, turns, drops, float(safe), reach)


# -- the documented loop ---------------------------------------------------------------------------

DOCUMENTED = SuspensionSettings(controller="hybrid", damping=25e3, share=0.7)
"""The desired force of the loop in doc/control.md."""

PASSIVE = (0.001, HIGHEST_CURRENT)
"""Constant currents [A] of the two passive dampers."""


class Loop(NamedTuple):
    """Result of the documented loop.

    ``current`` [A] is the mean current, ``attainable`` the share of blocks whose desired force is
    attainable, ``nrmse`` the error of these forces [1]. ``gain`` is the relative reduction of the
    RMS acceleration of the body against the better passive damper.
    """

    seed: int
    current: float
    attainable: float
    nrmse: float
    gain: float


def _constant(current: float, _: PlantRig) -> Callable[[RigBlock], float]:
    return lambda _: current


def documented(seed: int, duration: float = DRIVEN) -> Loop:
    """The loop of doc/control.md on a road of class C, with the identifier."""
    given = QuarterCarOptions()

    def ride(choose: Callable[[PlantRig], Callable[[RigBlock], float]]) -> float:
        supply = SupplySetpoint(0.0)
        rig = PlantRig(
            EmulatedDamper(invented_damper(0.0), HOT_FORCE, built_in=True),
            given.car.plant,
            IsoRoad(given.road, given.speed, seed),
            supply,
            settings=RigSettings(displacement_noise=1e-6, seed=seed),
            thermal=ThermalModel(initial_temperature=28.0, heat_capacity=given.heat_capacity),
            coil_time_constant=LAG,
            substeps=2,
        )
        states = [
            suspension_state_of(rig).acceleration
            for _ in commanded(rig, supply, choose(rig), BLOCK, duration)
        ]
        return float(np.std(states[round(SETTLED / _LENGTH) :]))

    wanted, known = controller_of(DOCUMENTED), invented_damper(LAG)
    commands: list[tuple[float, float]] = []
    errors: list[Array] = []
    forces: list[Array] = []

    def controlled(rig: PlantRig) -> Callable[[RigBlock], float]:
        choice = chosen(lambda _: wanted(suspension_state_of(rig)), known, Engine(start=known))

        def choose(measured: RigBlock) -> float:
            # The force of this block follows from the command after the previous block.
            before = choice.last
            current = choice(measured)
            if before is not None and measured.sequence * PERIOD > SETTLED:
                commands.append((current, before.attainable))
                forces.append(measured.force)
                if before.attainable:
                    errors.append(measured.force - before.wanted)
            return current

        return choose

    acceleration = ride(controlled)
    passive = min(ride(partial(_constant, each)) for each in PASSIVE)
    current, attainable = np.mean(commands, axis=0).tolist()
    nrmse = rms(np.concatenate(errors)) / float(np.std(np.concatenate(forces)))
    return Loop(seed, current, attainable, nrmse, 1.0 - acceleration / passive)


# -- an emulated rig under a switched current ------------------------------------------------------

SWITCHED, SWITCHED_RUNS = 60.0, range(20)
"""Duration [s] of a run, and the seeds."""

THESIS = ParameterSet(THESIS_28_CELSIUS, set_id="thesis", peak_velocity_range=(0.0, 1.0))

DAMPERS: dict[str, Callable[[], Damper]] = {
    "sigmoid": lambda: EmulatedDamper(THESIS),
    "sigmoid_lag": lambda: EmulatedDamper(invented_damper(LAG)),
    "herschel_bulkley": lambda: ForeignDamper("herschel_bulkley"),
    "gas_bouc_wen": lambda: ForeignDamper("gas_bouc_wen"),
}
"""Runs under a switched current; the identifier uses its default law, sigmoid."""

_OF_WINDOWS = ("nelder_mead", "least_squares", "force_scale", "")
"""Methods of reports on single windows; the other methods search in all windows."""


class Switched(NamedTuple):
    """Result of a run under a switched current.

    ``confirmed`` is a fraction of the windows [1]. ``stuck`` means that no window of the last third
    was confirmed.
    """

    name: str
    confirmed: float
    stuck: bool


def switched(seed: int, duration: float = SWITCHED) -> Switched:
    """Identify from a cold start while the current switches; the seed sets the other conditions."""
    damper = list(DAMPERS)[seed % len(DAMPERS)]
    name = "sine 1 Hz"
    motion: Excitation = SineMotion(0.005, 1.0)
    if seed // len(DAMPERS) % 2:
        name, motion = "random 0.5-3 Hz", random_motion(0.004, 0.5, 3.0, SWITCHED, seed=seed)
    rig = EmulatedRig(
        DAMPERS[damper](),
        motion,
        switched_current(seed, round(2.0 * duration)),
        settings=RigSettings(displacement_noise=1e-6, seed=seed),
    )
    said = replay(rig.record(duration))
    windows = [each for each in said.reports if each.sample_count and each.method in _OF_WINDOWS]
    end_ns = said.start_ns + 2.0 / 3.0 * duration * 1e9
    return Switched(
        f"seed {seed}: {damper}, {name}",
        float(np.mean([report.confirms for report in windows])),
        not any(report.confirms for report in windows if report.stamp_ns > end_ns),
    )


# -- what the measured force does to the current ---------------------------------------------------

FOLLOWED = 24.0
DEMAND = 9000.0
"""Desired damping [N s/m]."""

COLD = replace(invented_damper(LAG), set_id="cold", peak_velocity_range=(0.0, 0.5))

BOUC_WEN = replace(
    OTHER_DAMPERS["bouc_wen"], peak_velocity_range=(0.0, 0.5), current_range=(0.0, HIGHEST_CURRENT)
)


@dataclass(frozen=True)
class Case:
    """A known set, and a damper with a ``part`` of the force of this set, at a temperature [°C].

    The damper moves at random or in a ``sine``. With ``learns``, it is identified at the same time.
    """

    known: ParameterSet = COLD
    part: float = 1.0
    celsius: float = 28.0
    sine: bool = False
    learns: bool = False

    def damper(self) -> Damper:
        """The damper, whose force is smaller when it is hot."""
        values = self.known.values.copy()
        values[self.known.law.strength_indices] *= self.part
        hot_force = HOT_FORCE if self.celsius > 28.0 else 1.0
        return EmulatedDamper(replace(self.known, values=values), hot_force)


CASES: dict[str, Case] = {
    "right, random": Case(),
    "right, random, learns": Case(learns=True),
    "sine": Case(sine=True),
    "sine, learns": Case(sine=True, learns=True),
    "71 °C, learns": Case(celsius=71.0, learns=True),
    "85 %": Case(part=0.85),
    "80 %": Case(part=0.80),
    "80 %, sine": Case(part=0.80, sine=True),
    "bouc_wen, learns": Case(BOUC_WEN, learns=True),
    "71 °C": Case(celsius=71.0),
    "80 %, learns": Case(part=0.80, learns=True),
}

_TRACKED = ("right, random", "71 °C, learns")
"""Cases whose force error is a figure: known, and hot and identified."""


class Followed(NamedTuple):
    """Reversals of the current and drops to the safe current per second, and NRMSE of the force.

    ``late`` is the NRMSE of the second half, over the standard deviation after :data:`SETTLED`.
    """

    reversals: float
    drops: float
    late: float


def followed(name: str, watched: bool, seed: int = 0, duration: float = FOLLOWED) -> Followed:
    """Track a viscous damper; ``watched`` selects the default maximum_error, otherwise 0."""
    case, supply = CASES[name], SupplySetpoint(0.0)
    motion: Excitation = SineMotion(0.005, 1.0)
    if not case.sine:
        motion = random_motion(0.004, 0.5, 3.0, FOLLOWED, seed)
    rig = EmulatedRig(
        case.damper(),
        motion,
        supply,
        settings=RigSettings(displacement_noise=1e-6, seed=seed),
        # So much heat capacity that it stays as it is.
        thermal=ThermalModel(
            ambient_temperature=case.celsius, initial_temperature=case.celsius, heat_capacity=1e9
        ),
    )
    rig.live = True

    def wanted(made: RigBlock) -> float:
        return DEMAND * float(made.displacement[-1] - made.displacement[0]) / (PERIOD * (BLOCK - 1))

    engine = Engine(start=case.known) if case.learns else None
    choice = chosen(wanted, case.known, engine, watched=watched)
    commands, late, forces = [], [], []
    before = None
    for number, (made, _, _) in enumerate(commanded(rig, supply, choice, BLOCK, duration), start=1):
        is_late = number * BLOCK * PERIOD >= 0.5 * duration
        if is_late and before is not None and before.attainable and not before.doubt:
            late.append(made.force - before.wanted)
        forces.append(made.force)
        before = choice.last
        assert before is not None
        commands.append((before.current, before.falls_back))
    spread = float(np.std(np.concatenate(forces)[round(SETTLED / PERIOD) :]))
    error = rms(np.concatenate(late)) / spread if late else np.nan
    return Followed(*smoothness(commands), error)


# -- figures ---------------------------------------------------------------------------------------

_FEW = 0.5
"""Reversals per second that are negligible."""


def figures(every: int = 1, seed: int = 0) -> Measured:
    """Validity, error and smoothness of the loop; prints each run.

    The figures are those of all drives, runs and cases, or of one in ``every``.
    """
    roads, seeds = zip(*some_of(DRIVES, every, seed), strict=True)
    drives = in_processes(driven, roads, [each + 5 * seed for each in seeds])
    loops = in_processes(documented, [each + 8 * seed for each in some_of(range(8), every, seed)])
    chosen = some_of(SWITCHED_RUNS, every, seed)
    runs = in_processes(switched, [each + len(SWITCHED_RUNS) * seed for each in chosen])
    names = some_of(tuple(CASES), every, seed)
    jobs = list(product(dict.fromkeys((*names, *_TRACKED)), (True, False)))
    smooth = in_processes(followed, *zip(*jobs, strict=True), repeat(seed))
    results = dict(zip(jobs, smooth, strict=True))
    print(*drives, *runs, *results.items(), sep="\n", file=sys.stderr)
    ratios = {
        name: (results[name, True].reversals + _FEW) / (results[name, False].reversals + _FEW)
        for name in names
    }
    worst = max(ratios, key=lambda name: ratios[name])
    least = min(drives, key=lambda each: each.valid)
    far = max(drives, key=lambda each: each.nrmse / each.exact)
    poor = min(runs, key=lambda each: each.confirmed)
    right = [name for name in names if CASES[name].part == 1.0 and CASES[name].celsius == 28.0]
    cold, hot = (results[name, True].late for name in _TRACKED)
    return {
        "loop_valid_percent": (100.0 * least.valid, f"Road {least.road}, seed {least.seed}."),
        "loop_nrmse_ratio": (far.nrmse / far.exact, f"Road {far.road}, seed {far.seed}."),
        "loop_current_range": min(each.reach for each in drives),
        "attainable_nrmse_percent": (
            100.0 * float(np.median([each.nrmse for each in loops])),
            f"Mean current {np.median([each.current for each in loops]):.2f} A, attainable "
            f"{np.median([each.attainable for each in loops]):.0%} of the time, acceleration "
            f"{np.median([each.gain for each in loops]):.0%} below the better passive damper.",
        ),
        "loop_drops": max(each.drops for each in drives),
        "loop_confirmed_percent": (
            100.0 * poor.confirmed,
            f"{poor.name}; median {100.0 * float(np.median([r.confirmed for r in runs])):.0f} %.",
        ),
        "loop_stuck": (float(sum(each.stuck for each in runs)), f"Of {len(runs)}."),
        "controller_reversals_ratio": (
            ratios[worst],
            f"{worst}; " + ", ".join(f"{name} {each:.2f}" for name, each in ratios.items()),
        ),
        "controller_drops": max([results[name, True].drops for name in right], default=np.nan),
        "force_tracking_nrmse_percent": 100.0 * cold,
        "force_tracking_hot_growth": hot / cold,
    }
