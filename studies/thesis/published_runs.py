"""The conditions of the thesis, re-synthesised from its published parameter sets.

The recordings behind D. M. D. da Silva, "Comparative study of optimization algorithms for
parameter identification of the sigmoid model in MR dampers", University of Brasília, 2023, were
not published. Its tables 17-40 were; they list 34 conditions, each identified by two methods. A
re-synthesised run is the force of the Nelder-Mead set of a condition for the sinusoid that the
thesis fitted to its motion, with noise of the size that the thesis reports. Its details state that
it is not an original recording.

The thesis does not state two values, which are assumed: 1 ms between samples, and white noise of
1 micrometre on the displacement, the resolution of a laboratory displacement transducer.
"""

from __future__ import annotations

from mr_damper_ros.emulation.emulator import (
    THESIS_FORCE_NOISE,
    EmulatedDamper,
    EmulatedRig,
    RigSettings,
)
from mr_damper_ros.emulation.motions import SineMotion
from mr_damper_ros.models.published import (
    CONDITIONS,
    ERRATA,
    PUBLISHED_METHODS,
    Condition,
    is_clean,
    parameters,
)
from mr_damper_ros.models.sigmoid.law import PARAMETER_NAMES
from mr_damper_ros.signals.recording import Recording

SAMPLE_COUNT = 7001
"""Samples 3000 to 10000 of each run were used (appendix D)."""

SAMPLE_RATE = 1000.0
"""Assumed [Hz]; the thesis does not state the sampling period."""

PHASE = 4.481
"""Phase of the fitted sinusoid [rad] (appendix D)."""

DISPLACEMENT_NOISE = 1e-6
"""Assumed standard deviation [m]; the thesis states none."""

PROVENANCE = "re-synthesised from the published parameter sets; not the original recordings"


def recording_name(condition: Condition) -> str:
    """Name of the run of a condition; errata are marked in it."""
    return condition.name if is_clean(condition) else f"{condition.name}_erratum"


def synthesise(condition: Condition, *, seed: int = 0) -> Recording:
    """Run of a condition: 7001 samples; the same condition and seed give the same samples.

    Raises ConditionError if the thesis does not contain the condition.
    """
    values = parameters(condition)
    rig = EmulatedRig(
        EmulatedDamper(values),
        SineMotion(condition.amplitude, condition.frequency, phase=PHASE),
        condition.current,
        settings=RigSettings(
            sample_rate=SAMPLE_RATE,
            force_noise=THESIS_FORCE_NOISE,
            displacement_noise=DISPLACEMENT_NOISE,
            # Each condition has independent noise.
            seed=(seed, CONDITIONS.index(condition)),
        ),
    )
    details = {
        "condition": condition.name,
        "provenance": PROVENANCE,
        "source": "D. M. D. da Silva, University of Brasília, 2023, tables 17-40",
        "method": PUBLISHED_METHODS[0],
        "parameters": ", ".join(
            f"{name}={value}" for name, value in zip(PARAMETER_NAMES, values, strict=True)
        ),
        "force_noise_standard_deviation": f"{THESIS_FORCE_NOISE} N",
        "displacement_noise_standard_deviation": f"{DISPLACEMENT_NOISE} m",
        "seed": str(seed),
        "assumed": "1 ms between samples; white noise on the displacement",
    }
    if not is_clean(condition):
        details["erratum"] = ERRATA[condition]
    return rig.record(SAMPLE_COUNT / SAMPLE_RATE, name=recording_name(condition), details=details)
