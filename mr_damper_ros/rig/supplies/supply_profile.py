"""What a kind of supply wants to hear: a profile of an instrument, in YAML."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

_FILLED_IN = {"current": 1.0, "voltage": 1.0, "seconds": 1.0}
"""What a command may have in braces."""


class ProfileError(ValueError):
    """A profile that cannot be used; the message says what to change."""


@dataclass(frozen=True)
class SupplyProfile:
    """Lines of SCPI by what they do. A line may hold ``{current}``, ``{voltage}``, ``{seconds}``.

    ``setup`` is sent once, with the output off and no current. ``watchdog`` makes the instrument
    switch off by itself where it hears nothing for ``{seconds}``, a whole multiple of
    ``watchdog_step`` [s] of at least that; without these lines it has none. ``rearm`` makes it take
    ``output_on`` again after that. An answer to ``read_error`` that begins with ``no_error`` says
    that there are no errors (any more). ``tested`` says in a sentence what the profile was tried
    on.

    Raises ProfileError where a line has something else in braces.
    """

    tested: str
    set_current: str = "CURR {current:.4f}"
    read_current: str = "MEAS:CURR?"
    output_on: str = "OUTP ON"
    output_off: str = "OUTP OFF"
    read_error: str = "SYST:ERR?"
    no_error: tuple[str, ...] = ("0,", "+0,")
    setup: tuple[str, ...] = ("VOLT {voltage:.3f}",)
    watchdog: tuple[str, ...] = ()
    watchdog_step: float = 1.0
    rearm: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        lines = (self.set_current, self.read_current, self.output_on, self.output_off)
        for line in (*lines, self.read_error, *self.setup, *self.watchdog, *self.rearm):
            try:
                line.format(**_FILLED_IN)
            except (KeyError, IndexError, ValueError) as error:
                raise ProfileError(
                    f"the line '{line}' of the profile cannot be filled in: it may hold "
                    "{current}, {voltage} and {seconds}, and no other braces"
                ) from error
        if not (math.isfinite(self.watchdog_step) and self.watchdog_step > 0.0):
            raise ProfileError("watchdog_step of the profile must be positive [s]")

    def watchdog_delay(self, wanted: float) -> float:
        """The shortest delay [s] of the instrument's watchdog that is not below ``wanted``."""
        return max(math.ceil(wanted / self.watchdog_step - 1e-9), 1) * self.watchdog_step


def shipped_profiles() -> list[str]:
    """Names of the profiles that come with the package."""
    return sorted(path.stem for path in _FOLDER.glob("*.yaml"))


def read_profile(name: str) -> SupplyProfile:
    """The profile of a name, or of the path of a YAML file; raises ProfileError."""
    import yaml  # here: a node that has no supply does without

    path = Path(name) if name.endswith((".yaml", ".yml")) else _FOLDER / f"{name}.yaml"
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ProfileError(
            f"the profile '{name}' cannot be read: name one of {', '.join(shipped_profiles())}, or "
            "the path of a YAML file"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ProfileError(f"the profile '{name}' is no YAML: {error}".split("\n")[0]) from error
    return _profile(content, name)


def _profile(content: Any, name: str) -> SupplyProfile:
    if not isinstance(content, dict):
        raise ProfileError(f"the profile '{name}' is no table of names and lines")
    kinds = {field.name: field.type for field in fields(SupplyProfile)}
    values: dict[str, Any] = {}
    for key, value in content.items():
        if key not in kinds:
            raise ProfileError(
                f"the profile '{name}' has '{key}', which is none of {', '.join(kinds)}"
            )
        if str(kinds[key]).startswith("tuple"):
            given = value if isinstance(value, list) else [value]
            values[key] = tuple(str(line) for line in given)
        elif key == "watchdog_step":
            if isinstance(value, bool) or not isinstance(value, (int, float)):
                raise ProfileError(f"'watchdog_step' of the profile '{name}' must be a number [s]")
            values[key] = float(value)
        else:
            values[key] = str(value)
    if "tested" not in values:
        raise ProfileError(f"the profile '{name}' does not say what it was tested on ('tested')")
    return SupplyProfile(**values)


_FOLDER = Path(__file__).parent / "profiles"
