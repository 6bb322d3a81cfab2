"""Fallback to the safe current while the force is invalid.

During fallback, the current does not jump and does not move away from the safe current. At first,
it stays constant or moves slowly towards the safe current. When the force has been invalid for
``doubt_time`` longer than it was valid, the current goes to the safe current. Control returns when
the force has been valid for this time. If control is lost again soon, this time doubles; without
this rule, a force that is valid only at the safe current would switch control on and off for ever.
"""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.settings.option_table import CheckedSettings, option

HOLD, SLIDE = "hold", "slide"


@dataclass(frozen=True)
class FallbackSettings(CheckedSettings):
    """Options of the fallback to the safe current and of the return to control."""

    safe_current: float = option(
        0.0,
        "Current [A] that is commanded when the predicted force is invalid, and when the node "
        "ends. It must lie within the identified range of currents, because the force is invalid "
        "outside this range, and control would never start.",
        within=(-10.0, 10.0),
    )
    in_doubt: str = option(
        HOLD,
        f"Reaction to a force that has just become invalid: {HOLD} keeps the current, which "
        f"suits a force that is soon valid again; {SLIDE} moves it towards the safe current "
        "from the first invalid sample on, and reaches it after doubt_time.",
        choices=(HOLD, SLIDE),
    )
    doubt_time: float = option(
        0.3,
        "Once the force has been invalid for this time [s] longer than it was valid, the command "
        "goes to the safe current. Control returns after this time of valid force; the wait "
        "doubles if control is soon lost again.",
        within=(0.0, 60.0),
    )
    fade_time: float = option(
        0.1,
        "Duration [s] of a ramp through the whole range of currents on the way to the safe "
        "current; the way back is at most as fast.",
        within=(0.001, 60.0),
    )


_ROUNDING = 1e-9
"""Tolerance of times [s] against rounding errors."""

_LASTING = 10.0
"""Control that has lasted for this multiple of ``doubt_time`` resets the wait."""

_LONGEST = 32.0
"""Longest wait for valid force, as a multiple of ``doubt_time``."""


class Fallback:
    """Limits the current around the safe current according to the validity of the force.

    ``span`` [A] is the range of the currents of the controller.
    """

    def __init__(self, settings: FallbackSettings, span: float) -> None:
        self._settings = settings
        self._span = span
        self._wait = settings.doubt_time
        self.give_up()

    @property
    def lasts(self) -> bool:
        """Whether the command is the safe current, or moves towards it."""
        return self._lasts

    @property
    def left(self) -> float:
        """Time [s] of valid force that is still needed until control returns."""
        return self._wait - self._calm if self._lasts else 0.0

    def give_up(self) -> None:
        """Go to the safe current at once, and wait for valid force again."""
        self._lasts, self._reach = True, 0.0
        # Times [s]: invalid minus valid; valid minus invalid; since the start of control.
        self._doubted = self._calm = self._controlled = 0.0

    def follow(self, duration: float, *, doubted: bool, at_once: bool = False) -> bool:
        """Update with ``duration`` [s] of valid or invalid (``doubted``) force.

        Returns whether the controller may command its own current. ``at_once``: fall back without
        waiting for ``doubt_time``.
        """
        step = duration if doubted else -duration
        if self._lasts:
            self._calm = max(self._calm - step, 0.0)
            if not doubted and self._calm >= self._wait - _ROUNDING:
                self._lasts = False
                self._doubted = self._controlled = 0.0
            return not self._lasts
        limit = self._settings.doubt_time
        self._controlled += duration
        self._doubted = max(self._doubted + step, 0.0)
        if doubted and (at_once or self._doubted >= limit - _ROUNDING):
            lasted = at_once or self._controlled > _LASTING * limit
            self._wait = limit if lasted else min(2.0 * self._wait, _LONGEST * limit)
            self._lasts, self._calm = True, 0.0
        return not doubted

    def away_from(self, current: float, duration: float) -> float:
        """The current [A] during fallback, ``duration`` [s] after it was ``current`` [A]."""
        safe, settings = self._settings.safe_current, self._settings
        time = settings.fade_time
        if not self._lasts:
            time = settings.doubt_time if settings.in_doubt == SLIDE else 0.0
        step = self._span * duration / time if time > 0.0 else 0.0
        self._reach = max(abs(current - safe) - step, 0.0)
        return self.within_reach(current)

    def towards(self, current: float, duration: float) -> float:
        """The setpoint ``current`` [A], limited by the ramp away from the safe current."""
        step = self._span * duration / self._settings.fade_time
        self._reach = min(self._reach + step, self._span)
        return self.within_reach(current)

    def within_reach(self, current: float) -> float:
        """The current [A], limited to the largest present distance from the safe current."""
        safe = self._settings.safe_current
        return min(max(current, safe - self._reach), safe + self._reach)
