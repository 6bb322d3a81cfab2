"""Global identification from several seeds: the best result, its reproducibility, and a record.

Each seed is a separate search (:mod:`global_fit`), so the searches can run in any number of
processes. A record stores the results. Finished searches are not repeated; a search that was
stopped continues with its earlier result as a start, so its cost is never higher than before.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import chain
from typing import Any, SupportsIndex

import numpy as np

from mr_damper_ros.estimation.differential_evolution import (
    EvolutionSettings,
    GlobalProgress,
    Report,
)
from mr_damper_ros.estimation.global_fit import AS_GOOD, Candidate, GlobalFit, identify_global
from mr_damper_ros.estimation.record_levels import LevelPrior
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models.force_model import Model
from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.processes.files import json_ready
from mr_damper_ros.processes.process_pool import Notify, ProcessPool
from mr_damper_ros.signals.arrays import Array

_VERSION = 3


class SearchRecordError(ValueError):
    """A record does not belong to this search; the message says what to change."""


@dataclass(frozen=True, eq=False)
class MultiStart:
    """The searches by seed, and the best of them."""

    fits: Mapping[int, GlobalFit]

    @property
    def best(self) -> GlobalFit:
        """The fit with the lowest cost."""
        # A NaN cost is no minimum.
        return min(self.fits.values(), key=lambda fit: np.nan_to_num(fit.cost, nan=math.inf))

    def replaced(self, better: GlobalFit) -> MultiStart:
        """A copy in which a better fit replaces the best one."""
        best = self.best
        return MultiStart({k: better if fit is best else fit for k, fit in self.fits.items()})

    @property
    def as_good(self) -> tuple[int, ...]:
        """Seeds whose cost is within 2 % of the best."""
        least = self.best.cost
        return tuple(seed for seed, fit in self.fits.items() if fit.cost <= AS_GOOD * least)

    @property
    def spread(self) -> Array:
        """Range (p,) of each parameter over the equally good searches, in standard errors.

        0 if a parameter was held; NaN if there is only one such search.
        """
        sets = np.array([self.fits[seed].parameter_set.values for seed in self.as_good])
        if len(sets) < 2:
            return np.full(sets.shape[1], math.nan)
        errors = np.sqrt(np.diag(self.best.covariance))
        return np.divide(
            np.ptp(sets, axis=0), errors, out=np.zeros_like(errors), where=errors > 0.0
        )


@dataclass(eq=False)
class SearchRecord:
    """Results (``fits``) of the searches from several seeds so far, in a form suitable for JSON.

    A record belongs to one combination of model, windows, start (p,), settings except the seed,
    method and record levels.
    """

    model: Model
    windows: Sequence[Window]
    start: Array
    settings: EvolutionSettings
    method: str
    levels: LevelPrior | None = None
    fits: dict[int, GlobalFit] = field(default_factory=dict)

    @property
    def digest(self) -> str:
        """A digest of all arguments of the searches except the seed and the known set."""
        with_levels = () if self.levels is None else (self.levels,)
        asked = (self.model.name, replace(self.settings, seed=0), self.method, *with_levels)
        digest = hashlib.sha256(repr(asked).encode())
        arrays = [(w.motion.displacement, w.force, w.current) for w in self.windows]
        for array in chain([self.start], *arrays):
            digest.update(np.ascontiguousarray(array, dtype=float).tobytes())
        return digest.hexdigest()

    def is_finished(self, seed: int) -> bool:
        """Whether the search from this seed is complete."""
        return seed in self.fits and not self.fits[seed].stopped

    def search_from(self, seed: int) -> Callable[..., GlobalFit]:
        """The search from a seed, continued from its result so far, as a task for a process."""
        known = self.fits[seed].parameter_set.values if seed in self.fits else None
        settings = replace(self.settings, seed=seed)
        given: dict[str, Any] = {"method": self.method, "known": known, "levels": self.levels}
        return partial(identify_global, self.model, self.windows, self.start, settings, **given)

    def add(self, seed: int, fit: GlobalFit) -> None:
        """Add a result; an earlier one stays if it is better."""
        before = self.fits.get(seed)
        if before is not None and before.cost < fit.cost:
            fit = replace(before, success=fit.success, message=fit.message, stopped=fit.stopped)
        self.fits[seed] = fit

    def document(self) -> dict[str, Any]:
        """The whole record for JSON."""
        found = {str(seed): _to_document(fit) for seed, fit in self.fits.items()}
        return {"version": _VERSION, "search": self.digest, "found": found}

    def take(self, document: Any) -> None:
        """Load the output of :meth:`document`; raises SearchRecordError if it is unusable."""
        try:
            if document["version"] != _VERSION:
                raise SearchRecordError("it was written by another version: begin a new one")
            if document["search"] != self.digest:
                raise SearchRecordError(
                    "it belongs to a search with other bags, start, model, method or settings: "
                    "begin a new one, or repeat that search"
                )
            found = document["found"].items()
            self.fits |= {int(seed): _from_document(fit, self.levels) for seed, fit in found}
        except (KeyError, TypeError, AttributeError, ParameterError) as error:
            raise SearchRecordError("it holds no progress of a search: begin a new one") from error


def _run(search: Callable[..., GlobalFit], notify: Notify) -> GlobalFit:
    return search(report=notify)


def identify_from_seeds(
    record: SearchRecord,
    count: int = 1,
    report: Report | None = None,
    *,
    processes: ProcessPool | None = None,
    keep: Callable[[SearchRecord], None] | None = None,
) -> MultiStart:
    """Search from ``count`` seeds, starting with the seed of the settings.

    The result does not depend on the number of ``processes``. ``record`` holds earlier results and
    receives the new ones; ``keep`` is called after each new result. If ``report`` stops the search,
    the best results so far are returned.

    Raises ValueError for a count below 1 and the errors of :func:`identify_global`.
    """
    if not isinstance(count, SupportsIndex) or count < 1:
        raise ValueError(f"starts is {count!r}: give a whole number of at least 1")
    seeds = [record.settings.seed + place for place in range(count)]
    missing = [seed for seed in seeds if not record.is_finished(seed)]
    began, parts = time.monotonic(), dict[int, float]()

    def done(place: int, fit: GlobalFit) -> None:
        record.add(missing[place], fit)
        if keep is not None:
            keep(record)

    def follow(place: int, progress: GlobalProgress) -> bool:
        """Combine the progress of several searches."""
        assert report is not None
        if len(missing) > 1:
            parts[place] = progress.generation / max(progress.generations, 1)
            part, gone = sum(parts.values()) / len(missing), time.monotonic() - began
            progress = replace(
                progress,
                stage=f"search {place + 1} of {len(missing)}, {progress.stage}",
                time_left=gone * (1.0 - part) / part if part > 0.0 else progress.time_left,
            )
        return report(progress)

    tasks = [record.search_from(seed) for seed in missing]
    (processes or ProcessPool()).map(_run, tasks, follow if report else None, done)
    return MultiStart({seed: record.fits[seed] for seed in seeds if seed in record.fits})


_ARRAYS = ("covariance", "discrepancy", "nrmse", "noise", "spread")
_FIELDS = (
    *(*_ARRAYS, "evaluations", "success", "message", "stopped", "cost", "frequency"),
    "only_with",
)
"""Fields of a fit that a record stores unchanged, arrays first."""


def _to_document(fit: GlobalFit) -> Any:
    return json_ready(
        {
            "set": fit.parameter_set.to_yaml(),
            **{name: getattr(fit, name) for name in _FIELDS},
            "candidates": [vars(each) for each in fit.candidates],
            "counted_samples": None if fit.levels is None else fit.levels.counted_samples,
        }
    )


def _from_document(document: dict[str, Any], levels: LevelPrior | None) -> GlobalFit:
    count, cost = document["counted_samples"], document["cost"]
    if levels is not None:
        levels = replace(levels, counted_samples=math.inf if count is None else float(count))
    fields: dict[str, Any] = {name: document[name] for name in _FIELDS}
    fields |= {name: np.array(fields[name], dtype=float) for name in _ARRAYS}
    fields["cost"] = math.nan if cost is None else float(cost)
    fields["candidates"] = tuple(
        Candidate(**each | {"parameters": np.array(each["parameters"])})
        for each in document["candidates"]
    )
    return GlobalFit(ParameterSet.from_yaml(document["set"]), levels=levels, **fields)
