"""What identifying many dampers costs beside the identifications themselves."""

from __future__ import annotations

import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

from benchmarks.figure import Figure
from benchmarks.lot_of_dampers import READING, write_lot
from mr_damper_ros.lots.many_dampers import identify_many

_WORKERS = 2
_PER_DAMPER = 2


def figures(recordings: int = 1000, on_dask: int = 200) -> list[Figure]:
    """Overhead in two processes, and on a Dask cluster of two workers."""
    own, dampers = _overhead(recordings, dask=False)
    found = [
        Figure(
            "many_overhead_percent",
            100.0 * own,
            f"{recordings} recordings of {dampers} dampers (least squares), two processes: time of "
            "the whole, from the search for files to the last result, beyond half the sum of what "
            "the identifications take, each in its process in the same run",
            (float("-inf"), 5.0),
        )
    ]
    key, bar = "many_dask_overhead_percent", (float("-inf"), 25.0)
    definition = f"the same for {on_dask} recordings on a local Dask cluster of two workers"
    if find_spec("distributed") is None:
        return [*found, Figure(key, None, definition, bar, "Dask is not installed")]
    return [*found, Figure(key, 100.0 * _overhead(on_dask, dask=True)[0], definition, bar)]


def _overhead(recordings: int, *, dask: bool) -> tuple[float, int]:
    dampers = recordings // _PER_DAMPER
    with tempfile.TemporaryDirectory() as place:
        lot = Path(place, "lot")
        write_lot(lot, dampers, _PER_DAMPER)
        if not dask:
            return _measured(lot, Path(place, "results"), None), dampers
        from distributed import LocalCluster

        with LocalCluster(
            n_workers=_WORKERS, threads_per_worker=1, dashboard_address=None
        ) as cluster:
            return _measured(lot, Path(place, "results"), cluster.scheduler_address), dampers


def _measured(lot: Path, results: Path, scheduler: str | None) -> float:
    began = time.monotonic()
    found = identify_many(
        lot,
        folder=results,
        method="least_squares",
        workers=_WORKERS,
        scheduler=scheduler,
        **READING,
    )
    whole = time.monotonic() - began
    if found.failures or found.left_out:
        raise RuntimeError(f"not all was identified: {[*found.failures.items()][:3]}")
    return whole / (found.duration / _WORKERS) - 1.0
