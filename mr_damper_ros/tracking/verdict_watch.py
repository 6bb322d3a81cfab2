"""What the identifier's verdicts on the newest windows say of the force that is predicted."""

from __future__ import annotations

from mr_damper_ros.tracking.acceptance import Verdict
from mr_damper_ros.tracking.validity import NO_DOUBT, Doubt, DoubtKind

_DISTRUST = {
    Verdict.FAULT_OF_DATA: "the samples cannot be used",
    Verdict.POOR_FIT: "no parameters fit the samples",
    Verdict.DISTURBED: "the residual is far above the usual one",
    Verdict.UNCONFIRMED: "the force has changed by too much at once",
    Verdict.BEYOND_LIMITS: "the force is beyond what this damper can have changed to",
}
"""Verdicts that speak against the samples or the parameters, in words."""

_IN_A_ROW = 2
"""One window may be spoilt by a passing fault: the force is doubted from the second on."""

_FITS = 0.3
"""Where the running parameters leave less than this NRMSE of a window they are trusted."""


class VerdictWatch:
    """Follows the verdicts on windows."""

    def __init__(self) -> None:
        self._refused = 0
        self._doubt = NO_DOUBT

    @property
    def doubt(self) -> Doubt:
        """Why the newest windows speak against the force."""
        return self._doubt if self._refused >= _IN_A_ROW else NO_DOUBT

    def follow(self, verdict: int, nrmse_before: float, *, confirms: bool) -> None:
        """Follow a report: its verdict, and the NRMSE of the parameters in use (NaN: unknown)."""
        if confirms or nrmse_before < _FITS:
            self.forget()
        elif verdict in _DISTRUST:
            self._refused += 1
            self._doubt = Doubt(
                DoubtKind.REFUSED,
                f"the identifier has refused {self._refused} windows in a row: "
                f"{_DISTRUST[Verdict(verdict)]}; its reports on damper/fit_report say more",
            )

    def forget(self) -> None:
        """The parameters are others now, or have been confirmed."""
        self._refused = 0
