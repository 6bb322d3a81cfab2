"""Whether a search of real records ends in the lowest minimum, whatever it starts from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.figure import Figure
from mr_damper_ros.estimation.differential_evolution import EvolutionSettings
from mr_damper_ros.estimation.global_fit import GlobalFit, identify_global
from mr_damper_ros.estimation.observability import operating_points_within
from mr_damper_ros.estimation.profile_likelihood import profiled, search_misfit
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS
from mr_damper_ros.models.sigmoid.following import EXTENDED_MODEL
from mr_damper_ros.processes.process_pool import ProcessPool, Tell
from mr_damper_ros.signals.arrays import Array
from studies import recordings

LAWS = ("sigmoid", EXTENDED_MODEL)
STARTS = 20
AS_GOOD = 1.01
"""A search that ends with a cost up to this times the published one agrees with it."""

_SCALES = 1.0
"""Standard deviation of the logarithm of a drawn scale, about that of the model's own start."""


@dataclass(frozen=True, eq=False)
class StartedSearch:
    """One search, as a task."""

    law: str
    windows: tuple[Window, ...]
    start: Array
    seed: int


def random_start(law: str, windows: Sequence[Window], seed: int) -> Array:
    """Some damper's parameters (p,): another strength, another shape."""
    model, rng = MODELS[law], np.random.default_rng(seed)
    speeds, currents = operating_points_within(windows)
    start = model.initial_values()[0]
    scales = model.places(model.scale_names)
    start[scales] *= np.exp(rng.normal(0.0, _SCALES, scales.size))
    drawn = model.draw_shape(rng, max(speeds), max(currents))
    start[model.places(tuple(drawn))] = list(drawn.values())
    return np.clip(start, *model.bounds)


def _identified(search: StartedSearch, tell: Tell) -> GlobalFit:
    settings = EvolutionSettings(seed=search.seed)
    return identify_global(MODELS[search.law], search.windows, search.start, settings)


def agreeing(
    law: str, windows: Sequence[Window], published: GlobalFit, starts: int, processes: ProcessPool
) -> float:
    """Part of the searches from random starts that end as low as the published one.

    All are measured alike, by the noise that the published one was weighed with: the cost of a
    search is in units of what its own fits of single records left.
    """
    tasks = [
        StartedSearch(law, tuple(windows), random_start(law, windows, seed), seed)
        for seed in range(1, starts + 1)
    ]
    fits = processes.map(_identified, tasks)
    misfit = search_misfit(published, windows)
    most = AS_GOOD * misfit.mean_square(published.parameter_set.values)
    costs = [misfit.mean_square(fit.parameter_set.values) for fit in fits if fit is not None]
    return float(np.mean(np.array(costs) <= most))


def containing(
    windows: Sequence[Window], published: GlobalFit, processes: ProcessPool
) -> tuple[float, str]:
    """Part of the observable parameters that lie in their own interval, and the others' names."""
    found = published.parameter_set
    names = [n for n, seen in zip(found.law.parameter_names, found.observable, strict=True) if seen]
    fit, profiles = profiled(published, windows, names, EvolutionSettings(), processes)
    values = fit.parameter_set.as_dict()
    missed = [each.name for each in profiles if not each.contains(values[each.name])]
    return 1.0 - len(missed) / len(profiles), ", ".join(missed)


def figures(
    starts: int = STARTS, laws: Sequence[str] = LAWS, step: int = 1, workers: int = 2
) -> list[Figure]:
    """``starts_agreeing`` and ``profile_contains_estimate``, of every ``step``-th record."""
    place = recordings.folder()
    note = recordings.NONE if place is None else ""
    parts: list[float] | None = None
    contained: list[float] | None = None
    if place is not None:
        windows = recordings.processed_windows(place)[::step]
        parts, contained = [], []
        with ProcessPool(workers) as processes:
            for law in laws:
                start = MODELS[law].initial_values()[0]
                published = identify_global(MODELS[law], windows, start, EvolutionSettings())
                parts.append(agreeing(law, windows, published, starts, processes))
                share, missed = containing(windows, published, processes)
                contained.append(share)
                note += f"{law}: cost {published.cost:.4g}, outside {missed or 'none'}. "
    return [
        Figure(
            "starts_agreeing",
            parts,
            f"Part of {starts} searches from random starts (strength and shape drawn, another seed "
            "each) that end within 1 % of the cost of the set published, for the processed "
            f"sinusoid records: {', '.join(laws)}.",
            (0.95, 1.0),
            note.strip(),
        ),
        Figure(
            "profile_contains_estimate",
            contained,
            "Part of the parameters marked observable that lie within the 95 % interval of their "
            "own profile likelihood, for these sets.",
            (1.0, 1.0),
            recordings.NONE if place is None else "",
        ),
    ]
