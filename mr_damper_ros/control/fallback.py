"""What becomes of the current while the force is in doubt: no jump, and never up.

A doubt of a moment leaves the current where it is, or lets it slide towards the safe current. One
that lasts takes it to the safe current. The time in doubt is counted up, and down again while the
force is valid: it lasts from ``doubt_time`` on. Control comes back after as long without doubt, and
after twice as long each time that it has not lasted: a force that is right at the safe current
alone would else call it back again and again.
"""

from __future__ import annotations

from dataclasses import dataclass

from mr_damper_ros.settings.option_table import CheckedSettings, option

HOLD, SLIDE = "hold", "slide"


@dataclass(frozen=True)
class FallbackSettings(CheckedSettings):
    """How the command falls back to the safe current, and comes back."""

    safe_current: float = option(
        0.0,
        "Current [A] that is commanded when the predicted force is invalid, and when the node "
        "ends. It must lie within the identified range of currents: outside it the force is "
        "invalid, so control would never start.",
        minimum=-10.0,
        maximum=10.0,
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
        "Time [s] of invalid force, minus time of valid force, after which the command goes "
        "to the safe current. Control returns after the same time of valid force; this wait "
        "doubles each time control is lost again.",
        minimum=0.0,
        maximum=60.0,
    )
    fade_time: float = option(
        0.1,
        "Time [s] for a ramp through the whole range of currents on the way to the safe "
        "current; also the shortest time on the way back.",
        minimum=0.001,
        maximum=60.0,
    )


_ROUNDING = 1e-9
"""Seconds."""

_LASTING = 10.0
"""Control has lasted after so many times ``doubt_time``."""

_LONGEST = 32.0
"""It is waited for as often as that at most."""


class Fallback:
    """Follows the doubts of a controller whose currents lie ``span`` [A] apart."""

    def __init__(self, settings: FallbackSettings, span: float) -> None:
        self._settings = settings
        self._span = span
        self._wait = settings.doubt_time
        self.give_up()

    @property
    def lasts(self) -> bool:
        """Whether the doubt lasts: the command is the safe current, or on its way there."""
        return self._lasts

    @property
    def left(self) -> float:
        """Time [s] without doubt until control comes back."""
        return self._wait - self._calm if self._lasts else 0.0

    def give_up(self) -> None:
        """The safe current is commanded: control has to begin anew."""
        self._lasts, self._reach = True, 0.0
        # Seconds: in doubt, less those without; without, less those in doubt; since it began.
        self._doubted = self._calm = self._controlled = 0.0

    def follow(self, duration: float, *, doubted: bool, at_once: bool = False) -> bool:
        """Follow so many seconds with or without doubt: whether control goes on.

        ``at_once``: the doubt has lasted before it was raised.
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
        """The current [A] while control does not go on, from that before."""
        safe, settings = self._settings.safe_current, self._settings
        time = settings.fade_time
        if not self._lasts:
            time = settings.doubt_time if settings.in_doubt == SLIDE else 0.0
        step = self._span * duration / time if time > 0.0 else 0.0
        self._reach = max(abs(current - safe) - step, 0.0)
        return self.within_reach(current)

    def towards(self, current: float, duration: float) -> float:
        """A wanted current [A], as far as the way back from the safe one has come."""
        step = self._span * duration / self._settings.fade_time
        self._reach = min(self._reach + step, self._span)
        return self.within_reach(current)

    def within_reach(self, current: float) -> float:
        """The nearest current [A] to one that is within reach of the safe one."""
        safe = self._settings.safe_current
        return min(max(current, safe - self._reach), safe + self._reach)
