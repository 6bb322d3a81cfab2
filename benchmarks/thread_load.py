"""Processor time of a script that identifies, against the same with one thread of BLAS.

A user starts Python and calls ``mr.identify``, with no variable set: what the libraries take by
themselves must not cost more than one thread does.
"""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.models.published import CONDITIONS, is_clean
from studies.thesis.published_runs import synthesise

_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_SCRIPT = """
import sys, time
sys.path[:] = {path!r}
import mr_damper_ros as mr
from benchmarks.thread_load import records
runs = records({count})
began = time.process_time()
mr.identify(*runs, model="sigmoid_lag", generations={generations})
print(time.process_time() - began)
"""


def records(count: int) -> list[object]:
    """Records of so many clean conditions of the thesis, spread over all of them."""
    clean = [condition for condition in CONDITIONS if is_clean(condition)]
    places = np.linspace(0, len(clean) - 1, count).round().astype(int)
    return [synthesise(clean[place]) for place in places]


def figures(records: int = 10, generations: int = 100) -> list[Figure]:
    """Identify in a fresh process without the variables of BLAS, and in one with them."""
    others = {name: value for name, value in os.environ.items() if name not in _VARIABLES}
    script = _SCRIPT.format(path=sys.path, count=records, generations=generations)
    taken, single = (
        float(
            subprocess.run(
                [sys.executable, "-c", script],
                env={**others, **variables},
                capture_output=True,
                text=True,
                check=True,
            ).stdout
        )
        for variables in ({}, dict.fromkeys(_VARIABLES, "1"))
    )
    return [
        Figure(
            "threads_cpu_ratio",
            taken / single,
            f"Processor time of identify({records} records, model='sigmoid_lag') in a process "
            "without any variable, against one with one thread of BLAS by OMP_NUM_THREADS=1 and "
            "its like.",
            (0.0, 1.1),
            f"{taken:.1f} s against {single:.1f} s.",
        )
    ]
