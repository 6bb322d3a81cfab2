"""Exported code against the law: its errors, its speed, what the compiler and FMPy say."""

from __future__ import annotations

import ctypes
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.control.export.exported_law import ExportedLaw, ExportSettings, Vectors
from mr_damper_ros.control.export.fmu import compile_library, compiler, write_fmu
from mr_damper_ros.control.export.source_code import header
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import CONDITIONS, PUBLISHED_METHODS, parameters
from mr_damper_ros.signals.arrays import Array

POINTS = 100_000

_DRIVER = """\
#include "mr_damper.h"
void law(const double *inputs, long count, double *force) {
  long k;
  for (k = 0; k < count; ++k) {
    mr_damper_point point = {0};
    point.velocity = inputs[5 * k];
    point.peak_velocity = inputs[5 * k + 1];
    point.branch = inputs[5 * k + 3];
    point.change = inputs[5 * k + 4];
    force[k] = mr_damper_force(&point, inputs[5 * k + 2]);
  }
}
void stream(const double *displacement, long count, double *force) {
  long k;
  mr_damper_state damper;
  mr_damper_reset(&damper, 0.0);
  for (k = 0; k < count; ++k) {
    mr_damper_supply(&damper, 1.0);
    force[k] = mr_damper_step(&damper, displacement[k]);
  }
}
"""


class _Driver:
    """The compiled code of a set."""

    def __init__(self, law: ExportedLaw, folder: Path) -> None:
        (folder / "mr_damper.h").write_text(header(law, "mr_damper"), encoding="utf-8")
        (folder / "driver.c").write_text(_DRIVER, encoding="utf-8")
        self.said = compile_library(folder / "driver.c", folder / "driver.so", f"-I{folder}")
        self._code = ctypes.CDLL(str(folder / "driver.so"))

    def force(self, inputs: Array) -> Array:
        force = np.empty(len(inputs))
        self._code.law(_of(inputs), ctypes.c_long(force.size), _of(force))
        return force

    def seconds_per_step(self, displacement: Array) -> float:
        force = np.empty(displacement.size)
        began = time.process_time()
        self._code.stream(_of(displacement), ctypes.c_long(force.size), _of(force))
        return (time.process_time() - began) / force.size


def _of(array: Array) -> ctypes.c_void_p:
    return array.ctypes.data_as(ctypes.c_void_p)


def _fmu_problems(law: ExportedLaw, folder: Path) -> float | None:
    try:
        from fmpy.validation import validate_fmu
    except ImportError:
        return None
    write_fmu(law, "mr_damper", folder / "mr_damper.fmu")
    return float(len(validate_fmu(str(folder / "mr_damper.fmu"))))


def figures() -> list[Figure]:
    """``export_c_error``, ``export_c_warnings``, ``..._us_per_step``, ``export_fmu_problems``."""
    if compiler() is None:
        return [Figure("export_c_error", None, "Needs a C compiler.", (0.0, 1e-9))]
    chosen = [(c, m) for c in CONDITIONS[::8] for m in PUBLISHED_METHODS]
    worst, warnings, problems = 0.0, 0.0, None
    with tempfile.TemporaryDirectory() as temporary:
        for number, (condition, method) in enumerate(chosen):
            # A library of the same name would not be loaded again.
            folder = Path(temporary, str(number))
            folder.mkdir()
            law = ExportedLaw.of(ParameterSet(parameters(condition, method)), ExportSettings())
            driver = _Driver(law, folder)
            vectors = Vectors.of(law, POINTS // len(chosen) + 1, seed=number)
            size = np.maximum(np.abs(vectors.force), 1.0)
            errors = np.abs(driver.force(vectors.inputs) - vectors.force) / size
            worst, warnings = max(worst, float(errors.max())), warnings + float(bool(driver.said))
        moved = 5e-3 * np.sin(2.0 * np.pi * 1e-3 * np.arange(200_000))
        duration = min(driver.seconds_per_step(moved) for _ in range(3))
        problems = _fmu_problems(law, folder)
    return [
        Figure(
            "export_c_error",
            worst,
            "Largest relative error of the exported C law against Python, 1e5 random points of ten "
            "published sets, a tenth of them beyond all measure.",
            (0.0, 1e-9),
        ),
        Figure(
            "export_c_warnings",
            warnings,
            "Sets whose code gives a warning with -Wall -Wextra -pedantic -std=c99.",
            (0.0, 0.0),
        ),
        Figure(
            "export_c_us_per_step",
            1e6 * duration,
            "Processor time [µs] of a sample of the exported code: observer, peak velocity, law.",
            (0.0, 1.0),
        ),
        Figure(
            "export_fmu_problems",
            problems,
            "Problems that FMPy finds in the exported FMU.",
            (0.0, 0.0),
            "FMPy is not installed." if problems is None else "",
        ),
    ]
