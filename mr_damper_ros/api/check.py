"""Check of the data of runs, before anything is identified from them."""

from __future__ import annotations

from dataclasses import dataclass

from numpy.typing import ArrayLike

from mr_damper_ros.api.measured_runs import RunSource, findings_on, measured_runs
from mr_damper_ros.data_check.findings import NOTE, Finding, Severity, labelled
from mr_damper_ros.processes.blas_threads import one_thread


@dataclass(frozen=True)
class DataCheck:
    """Result of :func:`check`: ``findings``, the gravest first."""

    findings: tuple[Finding, ...]

    @property
    def severity(self) -> Severity:
        """The largest severity; NOTE without findings."""
        return max((finding.severity for finding in self.findings), default=NOTE)

    def __str__(self) -> str:
        return "\n".join(map(labelled, self.findings)) or "No fault found in the data."


@one_thread()
def check(
    *runs: RunSource,
    displacement: ArrayLike | None = None,
    force: ArrayLike | None = None,
    current: ArrayLike | None = None,
    period: float | None = None,
) -> DataCheck:
    """Check the data of runs: units, signs, clipping, spikes, hum, clocks, currents.

    Parameters
    ----------
    *runs, displacement, force, current, period
        As in :func:`identify`.

    Raises
    ------
    ValueError
        If a run cannot be read, or its displacement or force is constant.

    Examples
    --------
    >>> import numpy as np
    >>> import mr_damper_ros as mr
    >>> time = np.arange(2000) * 1e-3
    >>> displacement, force = 5e-3 * np.sin(20 * time), 1000 * np.cos(20 * time)
    >>> print(mr.check(displacement=displacement, force=force, current=1.0, period=1e-3))
    No fault found in the data.
    >>> found = mr.check(displacement=displacement, force=-force, current=1.0, period=1e-3)
    >>> found.severity.name
    'REFUSE'
    """
    measured = measured_runs(runs, (displacement, force, current, period), accept_doubtful=True)
    found = sorted(findings_on(measured), key=lambda finding: -finding.severity)
    return DataCheck(tuple(found))
