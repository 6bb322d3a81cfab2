"""An identified set of the sixteen parameters with what is known about it, and its YAML form."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import yaml

from mr_damper_ros.damper.sigmoid import PARAMETER_NAMES, Array

MODEL_NAME = "sigmoid"

UNITS = {
    **dict.fromkeys(("a0", "a1", "a4", "k0", "k1c", "k1e"), "s/m"),
    **dict.fromkeys(("k2", "k3", "k4", "k5", "k6"), "1"),
    **dict.fromkeys(("a2", "a3"), "1/A"),
    **dict.fromkeys(("I0", "I1"), "A"),
    "f0": "N",
}
"""Unit of each parameter. The thesis prints (m/s)^-1 for a3, which multiplies a current."""


class ParameterError(ValueError):
    """A parameter set that cannot be used; the message says what to change."""


def _unknown() -> Array:
    return np.full(len(PARAMETER_NAMES), np.nan)


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """Sixteen parameters of the sigmoid law, and how well and from what they are known.

    ``values`` and ``standard_errors`` have shape (16,), in the order of ``PARAMETER_NAMES`` and
    the units of ``UNITS``; a standard error is NaN where it is unknown. ``observable`` tells
    which parameters the data determined (the others kept the value of the start).
    ``peak_velocity_range`` [m/s] and ``current_range`` [A] span the data that were used;
    ``nrmse`` is RMSE/std of the force; ``stamp_ns`` is the time of the last sample used.

    Raises ParameterError where shapes are wrong, a value is not finite, or a range is reversed.
    """

    values: Array
    standard_errors: Array = field(default_factory=_unknown)
    observable: np.ndarray = field(
        default_factory=lambda: np.zeros(len(PARAMETER_NAMES), dtype=bool)
    )
    set_id: str = "unnamed"
    source: str = "unknown"
    peak_velocity_range: tuple[float, float] = (0.0, math.inf)
    current_range: tuple[float, float] = (-math.inf, math.inf)
    nrmse: float = math.nan
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        count = len(PARAMETER_NAMES)
        for name, dtype in (("values", float), ("standard_errors", float), ("observable", bool)):
            array = np.array(getattr(self, name), dtype=dtype)
            if array.shape != (count,):
                raise ParameterError(
                    f"{name} must hold {count} numbers, one for each of "
                    f"{', '.join(PARAMETER_NAMES)} (got shape {array.shape})"
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        for name, value, error in zip(
            PARAMETER_NAMES, self.values, self.standard_errors, strict=True
        ):
            if not math.isfinite(value):
                raise ParameterError(f"parameter {name} is {value}: give a finite number")
            if error < 0.0:
                raise ParameterError(f"the standard error of {name} is {error}: it is negative")
        for name, low_high in (
            ("peak_velocity_range", self.peak_velocity_range),
            ("current_range", self.current_range),
        ):
            low, high = low_high
            if not low <= high:
                raise ParameterError(f"{name} is [{low}, {high}]: give the lower bound first")

    def as_dict(self) -> dict[str, float]:
        """Values by parameter name."""
        return dict(zip(PARAMETER_NAMES, self.values.tolist(), strict=True))

    def to_yaml(self) -> str:
        """Text that :meth:`from_yaml` reads back to the last digit."""
        document: dict[str, Any] = {
            "model": MODEL_NAME,
            "id": self.set_id,
            "source": self.source,
            "stamp_ns": int(self.stamp_ns),
            "nrmse": None if math.isnan(self.nrmse) else float(self.nrmse),
            "peak_velocity_range": [float(x) for x in self.peak_velocity_range],
            "current_range": [float(x) for x in self.current_range],
            "parameters": {
                name: {
                    "value": float(value),
                    "unit": UNITS[name],
                    "standard_error": None if math.isnan(error) else float(error),
                    "observable": bool(observable),
                }
                for name, value, error, observable in zip(
                    PARAMETER_NAMES,
                    self.values,
                    self.standard_errors,
                    self.observable,
                    strict=True,
                )
            },
        }
        return str(yaml.safe_dump(document, sort_keys=False))

    @classmethod
    def from_yaml(cls, text: str) -> ParameterSet:
        """Parameter set from text written by :meth:`to_yaml`, or by hand.

        By hand, ``parameters`` with the sixteen names is enough, each a plain number or a mapping
        with ``value``. Raises ParameterError with one sentence that says what to change.
        """
        try:
            document = yaml.load(text, _UniqueKeyLoader)
        except yaml.YAMLError as error:
            line = getattr(getattr(error, "problem_mark", None), "line", None)
            where = "" if line is None else f" at line {line + 1}"
            problem = getattr(error, "problem", None)
            detail = f": {problem}" if problem else ""
            raise ParameterError(f"the parameter file is not valid YAML{where}{detail}") from error
        return cls._from_document(document)

    @classmethod
    def _from_document(cls, document: Any) -> ParameterSet:
        known = {
            *("model", "id", "source", "stamp_ns", "nrmse"),
            *("peak_velocity_range", "current_range", "parameters"),
        }
        if not isinstance(document, dict) or "parameters" not in document:
            raise ParameterError(
                "the parameter file has no mapping 'parameters': give the sixteen values by name"
            )
        unknown = [str(key) for key in document if key not in known]
        if unknown:
            raise ParameterError(
                f"the parameter file has unknown entries {', '.join(unknown)}: "
                f"remove them (known are {', '.join(sorted(known))})"
            )
        if document.get("model", MODEL_NAME) != MODEL_NAME:
            raise ParameterError(
                f"the parameter file is for model '{document['model']}': "
                f"give one for '{MODEL_NAME}'"
            )
        entries = document["parameters"]
        if not isinstance(entries, dict):
            raise ParameterError("'parameters' must map the sixteen names to numbers")
        unknown = [str(name) for name in entries if name not in PARAMETER_NAMES]
        if unknown:
            raise ParameterError(
                f"unknown parameter {', '.join(unknown)}: the names are "
                f"{', '.join(PARAMETER_NAMES)}"
            )
        missing = [name for name in PARAMETER_NAMES if name not in entries]
        if missing:
            raise ParameterError(f"parameter {', '.join(missing)} is missing: give its value")
        values, errors, observable = [], [], []
        for name in PARAMETER_NAMES:
            entry = entries[name]
            if not isinstance(entry, dict):
                entry = {"value": entry}
            stray = [
                str(k) for k in entry if k not in ("value", "unit", "standard_error", "observable")
            ]
            if stray:
                raise ParameterError(
                    f"parameter {name} has unknown entries {', '.join(stray)}: remove them"
                )
            if entry.get("unit", UNITS[name]) != UNITS[name]:
                raise ParameterError(
                    f"parameter {name} is given in {entry['unit']}: convert it to {UNITS[name]}"
                )
            values.append(_number(entry.get("value"), f"parameter {name}"))
            error = entry.get("standard_error")
            errors.append(
                math.nan if error is None else _number(error, f"standard error of {name}")
            )
            flag = entry.get("observable", False)
            if not isinstance(flag, bool):
                raise ParameterError(f"observable of {name} is {flag!r}: give true or false")
            observable.append(flag)
        nrmse = document.get("nrmse")
        stamp = document.get("stamp_ns", 0)
        if isinstance(stamp, bool) or not isinstance(stamp, int):
            raise ParameterError("stamp_ns must be a whole number of nanoseconds")
        return cls(
            values=np.array(values),
            standard_errors=np.array(errors),
            observable=np.array(observable),
            set_id=str(document.get("id", "unnamed")),
            source=str(document.get("source", "file")),
            peak_velocity_range=_range(
                document.get("peak_velocity_range", [0.0, math.inf]), "peak_velocity_range"
            ),
            current_range=_range(
                document.get("current_range", [-math.inf, math.inf]), "current_range"
            ),
            nrmse=math.nan if nrmse is None else _number(nrmse, "nrmse"),
            stamp_ns=stamp,
        )


class _UniqueKeyLoader(yaml.SafeLoader):
    """A loader that refuses a key given twice, of which YAML would silently take the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"'{key}' is given twice", node.value[index][0].start_mark
                )
        return super().construct_mapping(node, deep)


def _number(value: Any, what: str) -> float:
    if isinstance(value, str):
        # YAML 1.1 reads 1e5 as text: be kind to what every other program writes.
        try:
            return float(value)
        except ValueError:
            pass
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ParameterError(f"{what} is {value!r}: give a number")
    try:
        return float(value)
    except OverflowError as error:
        raise ParameterError(f"{what} is beyond what a number can hold") from error


def _range(value: Any, what: str) -> tuple[float, float]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise ParameterError(f"{what} must be a list of two numbers, lower bound first")
    return _number(value[0], what), _number(value[1], what)
