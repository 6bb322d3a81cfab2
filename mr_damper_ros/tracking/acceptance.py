"""Whether a new parameter set may replace the running one."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from mr_damper_ros.settings.option_table import CheckedSettings, option

_NO_NOISE = 1e-4
"""An NRMSE below this is better than any load cell: smaller ones are not told apart."""


class Verdict(IntEnum):
    """What became of a window or a global identification; the numbers are those of FitReport."""

    ACCEPTED = 1
    """The new set predicts better: it is in use."""
    ACCEPTED_EARLY = 2
    """The force had changed: the running set was brought up to date from a few samples."""
    NO_BETTER = 3
    """The running set predicts as well: it stays in use."""
    FAULT_OF_DATA = 4
    """The samples cannot be used: nothing was fitted."""
    POOR_FIT = 5
    """The fit leaves too much of the force unexplained."""
    DISTURBED = 6
    """The residual is far above the usual one."""
    UNCONFIRMED = 7
    """The force changed by so much at once that the next window must confirm it."""
    FAILED = 8
    """Nothing was computed, through no fault of the data."""
    TOO_LITTLE_MOTION = 9
    """The motion does not show enough of the damper yet: nothing was fitted."""
    BEYOND_LIMITS = 10
    """The force differs from all that is known by more than a damper can change."""

    @property
    def accepted(self) -> bool:
        """Whether a new set is in use."""
        return self in (Verdict.ACCEPTED, Verdict.ACCEPTED_EARLY)


@dataclass(frozen=True)
class Judgement:
    """A verdict and, for people, why: one sentence, empty where it needs none."""

    verdict: Verdict
    sentence: str = ""


ACCEPTED = Judgement(Verdict.ACCEPTED)


def fault_of_data(sentence: str) -> Judgement:
    """The judgement of data that cannot be used."""
    return Judgement(Verdict.FAULT_OF_DATA, sentence)


def too_little_motion(sentence: str) -> Judgement:
    """The judgement of a window that lacks motion: its data may be all right."""
    return Judgement(Verdict.TOO_LITTLE_MOTION, sentence)


@dataclass(frozen=True)
class AcceptanceSettings(CheckedSettings):
    """Limits that a fit must keep to be accepted."""

    maximum_nrmse: float = option(
        0.5, "Largest RMSE/std of the force on held-back samples.", minimum=0.0, maximum=10.0
    )
    residual_factor: float = option(
        3.0,
        "A residual so many times the usual one is taken for a disturbance.",
        minimum=1.0,
        maximum=1e6,
    )
    step_limit: float = option(
        0.5,
        "A relative change of the force beyond this must be confirmed by the next window.",
        minimum=0.0,
        maximum=1e6,
    )


@dataclass(frozen=True)
class Evidence:
    """What a window says of the running and the new set, on samples held back from the fit.

    ``nrmse_before`` and ``nrmse_after``: RMSE/std; ``rmse_after`` [N]; ``force_change``: relative
    change of the force from the running to the new set over the window's motion.
    """

    nrmse_before: float
    nrmse_after: float
    rmse_after: float
    force_change: float


@dataclass(frozen=True)
class AcceptanceHistory:
    """What a gatekeeper remembers.

    ``residuals``: RMSE [N] and NRMSE of the newest accepted windows; ``refused_for_residual``:
    refusals in a row since; ``pending_change``: relative change of the force that is to be
    confirmed.
    """

    residuals: tuple[tuple[float, float], ...] = ()
    refused_for_residual: int = 0
    pending_change: float | None = None


class Gatekeeper:
    """Accepts or refuses new sets, with the reason; remembers the usual residual."""

    _MEMORY = 15
    _PATIENCE = 4
    """After this many refusals in a row for the residual, the larger residual is the usual one."""

    def __init__(
        self, settings: AcceptanceSettings, history: AcceptanceHistory | None = None
    ) -> None:
        """Go on from a history, or begin without one."""
        history = history or AcceptanceHistory()
        self._settings = settings
        self._residuals = deque(history.residuals, maxlen=self._MEMORY)
        self._refused_for_residual = history.refused_for_residual
        self._pending_change = history.pending_change

    @property
    def history(self) -> AcceptanceHistory:
        """What is remembered now."""
        return AcceptanceHistory(
            tuple(self._residuals), self._refused_for_residual, self._pending_change
        )

    def judge(self, evidence: Evidence) -> Judgement:
        """Whether the new set is accepted, and why not."""
        judgement = self._judge(evidence)
        if judgement.verdict.accepted:
            self._residuals.append((evidence.rmse_after, evidence.nrmse_after))
        return judgement

    def judge_global(self, nrmse_before: float, nrmse_after: float) -> Judgement:
        """Whether a set for the windows of the past is accepted: it leaves no trace."""
        if not nrmse_after <= self._settings.maximum_nrmse:
            return Judgement(
                Verdict.POOR_FIT,
                f"one set for all operating points leaves {nrmse_after:.0%} of the force "
                f"unexplained, more than maximum_nrmse ({self._settings.maximum_nrmse:.0%})",
            )
        if nrmse_after < nrmse_before:
            return ACCEPTED
        return Judgement(Verdict.NO_BETTER, "the running set predicts the reservoir as well")

    def may_be_early(self, evidence: Evidence) -> bool:
        """Whether a fit to a few samples after a change may replace the running set.

        It must leave no more than the usual residual, predict better, and need no confirmation.
        What it says leaves no trace: the next window judges again.
        """
        return bool(
            self._residuals
            and evidence.nrmse_after <= self._settings.maximum_nrmse
            and self._excess(evidence.rmse_after, evidence.nrmse_after)
            <= self._settings.residual_factor
            and evidence.nrmse_after < evidence.nrmse_before
            and abs(evidence.force_change) <= self._settings.step_limit
        )

    def is_usual(self, rmse: float, nrmse: float) -> bool:
        """Whether a residual, RMSE [N] and NRMSE, is that of samples to identify from."""
        if not nrmse <= self._settings.maximum_nrmse:
            return False
        return not self._residuals or self._excess(rmse, nrmse) <= self._settings.residual_factor

    def _excess(self, rmse: float, nrmse: float) -> float:
        """Residual over the usual one.

        A sensor's noise keeps its newtons, a model's error its share of the force: a disturbance
        exceeds both.
        """
        usual_rmse, usual_nrmse = np.median(np.array(self._residuals), axis=0)
        # A force without noise, as a simulation has it, leaves rounding: that is no measure.
        spread = rmse / max(nrmse, _NO_NOISE)
        return float(
            min(
                rmse / max(usual_rmse, _NO_NOISE * spread),
                nrmse / max(usual_nrmse, _NO_NOISE),
            )
        )

    def _judge(self, evidence: Evidence) -> Judgement:
        settings = self._settings
        pending, self._pending_change = self._pending_change, None
        if not np.isfinite(evidence.nrmse_after):
            return Judgement(Verdict.POOR_FIT, "the fit has no finite error: the window is refused")
        if evidence.nrmse_after > settings.maximum_nrmse:
            return Judgement(
                Verdict.POOR_FIT,
                f"the fit leaves {evidence.nrmse_after:.0%} of the force unexplained, more than "
                f"maximum_nrmse ({settings.maximum_nrmse:.0%})",
            )
        known = bool(self._residuals)
        if known:
            excess = self._excess(evidence.rmse_after, evidence.nrmse_after)
            if excess > settings.residual_factor:
                self._refused_for_residual += 1
                if self._refused_for_residual <= self._PATIENCE:
                    return Judgement(
                        Verdict.DISTURBED,
                        f"the residual is {excess:.1f} times the usual one: "
                        "a disturbance or a sensor fault",
                    )
                # It has lasted: the rig itself has become noisier.
                self._residuals.clear()
        self._refused_for_residual = 0
        if not evidence.nrmse_after < evidence.nrmse_before:
            return Judgement(
                Verdict.NO_BETTER, "the running set predicts the held-back samples as well"
            )
        change = evidence.force_change
        confirmed = pending is not None and abs(change - pending) <= 0.2 * abs(pending)
        if known and abs(change) > settings.step_limit and not confirmed:
            self._pending_change = change
            return Judgement(
                Verdict.UNCONFIRMED,
                f"the force changed by {change:+.0%} at once: "
                "waiting for the next window to confirm it",
            )
        return ACCEPTED
