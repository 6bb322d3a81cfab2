"""The law with a state: what it costs, and a damper unlike it whose current switches at random."""

from __future__ import annotations

import numpy as np

from benchmarks.figure import Figure
from benchmarks.fit_times import cpu_seconds
from benchmarks.other_dampers import DAMPERS, random_motion
from mr_damper_ros.emulation.emulator import CurrentSchedule, EmulatedRig, ModelDamper, RigSettings
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import identify_global
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.first_order_lag import COIL
from mr_damper_ros.models.parameter_set import ParameterSet, start_set
from mr_damper_ros.signals.recording import stream_of
from mr_damper_ros.tracking.engine import Engine, EngineSettings

STATE_LAW = "series_springs"

COILS = (5e-3, 20e-3)
"""Time constants [s] of the coils."""

LAWS = ("sigmoid", "sigmoid_lag", STATE_LAW, "bouc_wen")

_HALF = 20.0
_RATE = 500.0
_BLOCK = 10
_TRUTH = ParameterSet(
    np.array(
        [600.0, 4e-3, 2500.0, 1e7, 0.3, 1e6, 1500.0, -20.0]
        + [3.0, -0.6, 0.0, 0.5, 0.8, 0.0, 0.0, 0.01]
    ),
    set_id="springs",
    model=STATE_LAW,
)


def random_current(duration: float, seed: int) -> CurrentSchedule:
    """Levels of 0 to 1.5 A at random, each for 0.05 to some 0.5 s."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(0.05 + rng.exponential(0.25, round(8.0 * duration)))
    times[0] = 0.0
    return CurrentSchedule(times.tolist(), rng.uniform(0.0, 1.5, times.size).tolist())


def switched_halves(coil: float, half: float = _HALF, seed: int = 0) -> list[Window]:
    """Two halves of a stream of the modified Bouc-Wen damper with this lag of its coil [s]."""
    damper = DAMPERS["modified_bouc_wen"]
    values = damper.values.copy()
    values[damper.law.parameter_names.index(COIL)] = coil
    rig = EmulatedRig(
        ModelDamper(ParameterSet(values, model=damper.model), 1.0 / _RATE),
        random_motion(4e-3, 0.3, 3.0, 2.0 * half, seed),
        random_current(2.0 * half, seed),
        settings=RigSettings(sample_rate=_RATE, seed=seed),
    )
    found = rig.record(2.0 * half)
    count = round(half * _RATE)
    return [
        Window.from_samples(
            found.displacement[part], found.force[part], found.current[part], found.period
        )
        for part in (slice(0, count), slice(count, None))
    ]


def switched(law: str, coil: float, half: float = _HALF) -> tuple[float, float]:
    """NRMSE on the half that was not fitted, and the coil's time constant that was found [s]."""
    model = MODELS[law]
    first, second = switched_halves(coil, half)
    found = identify_global(model, [first], start_set(law).values, EvolutionSettings())
    values = found.parameter_set.values
    held = second.held_within(*found.parameter_set.peak_velocity_range)
    settled = model.settled(held, values)
    left = (model.window_force(held, values) - held.force)[settled]
    nrmse = float(np.sqrt(np.mean(left**2)) / np.std(held.force[settled]))
    return nrmse, float(values[model.parameter_names.index(COIL)])


def law_us_per_sample(duration: float = 20.0) -> float:
    """Processor time [µs] of the force of a sample, in blocks of ten."""
    window = switched_halves(0.01, duration)[0]
    parts = [slice(k, k + _BLOCK) for k in range(0, window.sample_count, _BLOCK)]
    blocks = [(window.motion.part(part), window.current[part]) for part in parts]
    stream = MODELS[STATE_LAW].stream(window.period)

    def follow() -> None:
        for motion, current in blocks:
            stream.follow(_TRUTH.values, motion, current)

    follow()
    return 1e6 * min(cpu_seconds(follow) for _ in range(3)) / window.sample_count


def worker_shares(law: str, start: float, duration: float) -> tuple[float, float]:
    """Processor time of the worker over data time, in the first seconds and in those after them.

    A damper of the state law in random motion at 1 A, 1 kHz, as the nodes do by default, from a
    cold start; windows of two seconds every second with three looks between them, and global
    identifications as the node makes them: six in the first half minute, later one after every
    twenty windows that fit.
    """
    rig = EmulatedRig(ModelDamper(_TRUTH, 1e-3), random_motion(4e-3, 0.3, 3.0, duration, 1), 1.0)
    record = rig.record(duration)
    engine = Engine(EngineSettings().for_law(law))
    at_start = 0.0
    for block, _ in engine.follow(stream_of(record, _BLOCK)):
        if block.sequence * block.period < start:
            at_start = engine.worker.processor_time
    later = engine.worker.processor_time - at_start
    return at_start / start, later / (duration - start)


def figures(half: float = _HALF, start: float = 40.0, duration: float = 100.0) -> list[Figure]:
    """``law_us_per_sample``, ``switched_current_nrmse``, ``switched_current_lag_error``..."""
    found = [switched(STATE_LAW, coil, half) for coil in COILS]
    shares = [worker_shares(law, start, duration) for law in LAWS]
    coils = ", ".join(f"{1e3 * coil:g}" for coil in COILS)
    return [
        Figure(
            "law_us_per_sample",
            law_us_per_sample(),
            "Processor time [µs] of the force of a sample of the law with a state, streaming in "
            "blocks of 10, with the lag of the coil, current switched at random.",
            (0.0, 20.0),
        ),
        Figure(
            "switched_current_nrmse",
            [100.0 * nrmse for nrmse, _ in found],
            f"NRMSE [%] of the law with a state on the second half of {2.0 * half:g} s of a "
            f"modified Bouc-Wen damper, coils of {coils} ms, random motion, current switched at "
            "random; fitted to the first half.",
            (0.0, 8.0),
        ),
        Figure(
            "switched_current_lag_error",
            [100.0 * abs(lag / coil - 1.0) for (_, lag), coil in zip(found, COILS, strict=True)],
            "Error [%] of the coil's time constant found there.",
            (0.0, 10.0),
        ),
        Figure(
            "worker_core_percent",
            [100.0 * later for _, later in shares],
            "Processor time [% of a core] of the worker at the nodes' defaults, 1 kHz, from "
            f"{start:g} to {duration:g} s after a cold start, random motion: {', '.join(LAWS)}.",
            (0.0, 30.0),
        ),
        Figure(
            "worker_start_percent",
            [100.0 * first for first, _ in shares],
            f"The same in the first {start:g} s, with six global identifications.",
        ),
    ]
