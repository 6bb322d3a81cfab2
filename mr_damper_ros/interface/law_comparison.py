"""The force law that the runs given support."""

from __future__ import annotations

from collections.abc import Sequence

from numpy.typing import ArrayLike

from mr_damper_ros.estimation.differential_evolution import EvolutionSettings, Report
from mr_damper_ros.estimation.law_choice import LawChoice, cross_validate
from mr_damper_ros.interface.measured_runs import RunSource, measured_runs
from mr_damper_ros.models import MODELS
from mr_damper_ros.processes.blas_threads import one_thread
from mr_damper_ros.processes.process_pool import ProcessPool


@one_thread()
def choose_law(
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
    models: Sequence[str] = tuple(MODELS),
    seed: int = 0,
    workers: int = 1,
    accept_doubtful: bool = False,
    report: Report | None = None,
) -> LawChoice:
    """Compare force laws on motions that they were not fitted to, and choose the simplest good one.

    Parameters
    ----------
    *runs, displacement, force, current, period, workers, accept_doubtful, report
        As in :func:`identify`. Where ``report`` stops it, the laws that are finished are compared.
    models
        Names of the laws, keys of ``MODELS``.
    seed
        Of the identifications' random numbers.

    Returns
    -------
    LawChoice
        ``chosen`` is the law, ``trials`` what was left by each, and its text a table of them.

    Raises
    ------
    ValueError
        In one sentence that says what to change, where a run cannot be used, a law is unknown, or
        there is too little to leave a part out.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> time = np.arange(2000) * 1e-3
    >>> displacement, velocity = 5e-3 * np.sin(20 * time), 0.1 * np.cos(20 * time)
    >>> force = 900 * np.tanh(velocity / 0.02) + 1500 * velocity
    >>> choice = mr.choose_law(displacement=displacement, force=force, current=1.0, period=1e-3,
    ...                        models=("bingham", "hyperbolic_tangent"))
    >>> choice.chosen.model
    'hyperbolic_tangent'
    """
    with ProcessPool(workers) as processes:
        measured = measured_runs(
            runs,
            displacement=displacement,
            force=force,
            current=current,
            period=period,
            accept_doubtful=accept_doubtful,
            processes=processes,
        )
        return cross_validate(
            [run.windows for run in measured],
            models,
            EvolutionSettings(seed=seed),
            report,
            processes,
        )
