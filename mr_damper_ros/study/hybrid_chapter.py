"""Chapter of the report on the hybrid simulation."""

from __future__ import annotations

from collections.abc import Mapping

from mr_damper_ros.report.document import (
    DASHES,
    GREY,
    INK,
    Chapter,
    Picture,
    Table,
    Text,
    legend_above,
    panels,
)
from mr_damper_ros.study.building_runs import SCALE
from mr_damper_ros.study.hybrid_run import (
    BANDWIDTH,
    DAMPING,
    DELAY,
    MODEL_ERROR,
    STEP,
    HybridResult,
    HybridRun,
    missed,
)

REFERENCE = HybridRun(machine=False)
LATE = HybridRun(machine=True)
COMPENSATED = HybridRun(machine=True, compensated=True)
_NAMES = {REFERENCE: "reference", LATE: "machine, as it is", COMPENSATED: "machine, compensated"}

TASKS = tuple(_NAMES)


def hybrid_chapter(found: Mapping[HybridRun, HybridResult]) -> Chapter:
    """With a machine that is late, and with a command that runs ahead."""
    reference = found[REFERENCE]
    figure, axes = panels(2, 1, 6.6, 3.8, sharex=True)
    for place, (task, name) in enumerate(_NAMES.items()):
        result = found[task]
        chosen = (result.time > 1.0) & (result.time < 6.0)
        style = {
            "color": GREY if task == REFERENCE else INK[place - 1],
            "linestyle": "-" if task == REFERENCE else DASHES[place],
        }
        axes[0, 0].plot(result.time[chosen], 1e3 * result.roof[chosen], label=name, **style)
        axes[1, 0].plot(result.time[chosen], 1e-3 * result.force[chosen], **style)
    axes[0, 0].set(ylabel="roof (mm)")
    axes[1, 0].set(ylabel="force (kN)", xlabel="time (s)")
    legend_above(figure, axes[0, 0], 3)
    rows = [
        (
            _NAMES[task],
            100.0 * missed(found[task].damper, reference.floor),
            100.0 * missed(found[task].force, reference.force),
            100.0 * missed(found[task].damper, found[task].floor),
            100.0 * missed(found[task].roof, reference.roof),
        )
        for task in (LATE, COMPENSATED)
    ]
    return Chapter(
        "hybrid",
        "A hybrid simulation, emulated",
        [
            Text(
                "The building is reckoned and the damper is moved by a machine, as in a real-time "
                "hybrid simulation; here the machine and the damper are emulated too. One step "
                f"is 1/{1.0 / STEP:.0f} s, as the authors have it: the building is solved exactly "
                "for the measured force, which holds for a step. The machine follows its command "
                f"like a second order of {BANDWIDTH:.0f} Hz and a damping ratio of {DAMPING:g}, "
                f"{1e3 * DELAY:.1f} ms late. Compensated, the command is x + 2ζ/ω v + a/ω² of the "
                f"reckoned floor, with an ω that is {MODEL_ERROR:.0%} too high. Building I, El "
                f"Centro at {SCALE:.0%}, passive-on; the reference has the damper in the building."
            ),
            Picture("hybrid", "Roof and force of the dampers.", figure),
            Table(
                "hybrid",
                "RMS of the difference in percent of the RMS: motion of the damper and force "
                "against the reference (J1, J2 of the authors measure the same), motion of the "
                "damper against the floor that it should follow (J3), roof against the reference.",
                ("", "motion", "force", "following", "roof"),
                rows,
            ),
        ],
    )
