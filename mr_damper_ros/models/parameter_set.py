"""A parameter set of a model with its uncertainty and its range, and its YAML form."""

from __future__ import annotations

import math
import os
import reprlib
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from numbers import Real
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from numpy.typing import ArrayLike

from mr_damper_ros.kinematics.motion import Motion, MotionSample
from mr_damper_ros.kinematics.window import Window
from mr_damper_ros.models import MODELS, Model
from mr_damper_ros.models.domain import Domain, Origin
from mr_damper_ros.models.quantities import SAME_CURRENT, State
from mr_damper_ros.processes.files import write_text
from mr_damper_ros.signals.arrays import NEGLIGIBLE, Array, samples_of
from mr_damper_ros.signals.blocks import fits_a_stamp

DEFAULT_MODEL = "sigmoid"
"""The law of a parameter file that does not name one."""


_ENTRIES = ("value", "unit", "standard_error", "discrepancy", "observable")
"""Keys that a file may contain for a parameter."""

LONGEST_NAME = 200
"""Largest number of characters of an id or a source; this package creates about thirty."""


class UserError(ValueError):
    """A user error, whose message is a sentence that may also be sent in a ROS message.

    Characters that cannot be encoded, such as half a surrogate pair in a file name, would end the
    node that sends the message; they are written as escape sequences.
    """

    def __init__(self, sentence: str) -> None:
        super().__init__(sentence.encode("utf-8", "backslashreplace").decode("utf-8"))


class ParameterError(UserError):
    """A parameter set cannot be used; the message says what to change."""


_SINE = np.arange(0.0, 2.0, 0.01)
"""Times [cycles] at which a sine is sampled to find its largest force."""

Moved = TypeVar("Moved", Motion, MotionSample, Window)

_UNKNOWN = np.empty(0)
"""Placeholder for NaN or False at all parameters, until the number of parameters is known."""


def _unknown() -> Array:
    return _UNKNOWN


def motion_window(time: ArrayLike, displacement: ArrayLike, current: ArrayLike) -> Window:
    """The window of a motion, without a force; see :meth:`ParameterSet.force`."""
    if np.asarray(time).dtype.kind in "mM":
        raise ValueError("the times are dates: give seconds")
    times, moved, amperes = map(samples_of, (time, displacement, current))
    if times.ndim != 1 or times.shape != moved.shape or times.size < 2:
        raise ValueError(
            f"time has the shape {times.shape} and displacement {moved.shape}: give one "
            "displacement for each time, and at least two"
        )
    if amperes.size != 1 and amperes.shape != moved.shape:
        raise ValueError(
            f"current has the shape {amperes.shape} and displacement {moved.shape}: give one "
            "current for each displacement, or one for all"
        )
    steps = np.diff(times)
    period = float(np.mean(steps))
    if not (period > 0.0 and np.max(np.abs(steps - period)) <= NEGLIGIBLE * period):
        raise ValueError(
            f"the times are from {np.min(steps):g} to {np.max(steps):g} s apart: give uniform "
            "samples"
        )
    return Window.from_samples(moved, np.zeros_like(moved), amperes, period).resolved()


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """Parameters of a model with their standard errors, validity range and origin.

    ``values`` and ``standard_errors`` have shape (p,), in the order and the units of the parameters
    of ``model``, a name in ``MODELS``; an unknown standard error is NaN. ``discrepancies`` (p,) are
    the part of the standard errors that comes from model error, NaN if unknown. The square root of
    standard_errors² - discrepancies² is the scatter between windows of the same motion.
    ``observable`` (p,) marks the parameters that the data determined; the others kept their start
    values. A parameter that the data determined only jointly with others is observable and has no
    standard error. ``peak_velocity_range`` [m/s] and ``current_range`` [A] span the data that were
    used; ``nrmse`` is RMSE/std of the force; ``stamp_ns`` is the time of the last sample used.
    ``largest_force`` [N] is the largest force in these data, NaN if unknown. ``origin`` says where
    the set comes from, ``source`` names the method that found it, for people. ``dependence_range``
    [m/s] is the range in which the dependence on the peak velocity is known, None if it is the
    ``peak_velocity_range``. The fit of a window beyond it may scale the law without extending it.

    Raises ParameterError for an unknown model, wrong shapes, values that are not finite or out of
    bounds, a reversed range, and a negative or infinite largest force. It is also raised if the set
    does not fit into a message: id and source must be printable and have at most 200 characters,
    and the stamp must be before January 2038.
    """

    values: Array
    standard_errors: Array = field(default_factory=_unknown)
    observable: np.ndarray = field(default_factory=_unknown)
    set_id: str = "unnamed"
    source: str = "unknown"
    peak_velocity_range: tuple[float, float] = (0.0, math.inf)
    current_range: tuple[float, float] = (-math.inf, math.inf)
    nrmse: float = math.nan
    stamp_ns: int = 0
    model: str = DEFAULT_MODEL
    largest_force: float = math.nan
    discrepancies: Array = field(default_factory=_unknown)
    dependence_range: tuple[float, float] | None = None
    origin: Origin = Origin.USER

    def __post_init__(self) -> None:
        model = known_model(self.model)
        names = model.parameter_names
        count = len(names)
        for name, dtype, unknown in (
            ("values", float, None),
            ("standard_errors", float, math.nan),
            ("observable", bool, False),
            ("discrepancies", float, math.nan),
        ):
            given = getattr(self, name)
            array = np.full(count, unknown) if given is _UNKNOWN else np.array(given, dtype=dtype)
            if array.ndim == 1:
                # Parameters with a default, such as a current dependence, may be omitted at the
                # end.
                complete = model.completed(array.astype(float))
                if unknown is not None:
                    complete[array.size :] = unknown
                array = complete.astype(dtype)
            if array.shape != (count,):
                raise ParameterError(
                    f"{name} of model '{self.model}' must hold {count} numbers, one for each of "
                    f"{', '.join(names)} (the shape is {array.shape})"
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        for name, value, low, high in zip(names, self.values, *model.bounds, strict=True):
            if not math.isfinite(value):
                raise ParameterError(f"parameter {name} is {value}: give a finite number")
            if not low <= value <= high:
                raise ParameterError(
                    f"parameter {name} is {value}: it must lie in {low:g} to {high:g}"
                )
        errors = ("standard error", self.standard_errors), ("discrepancy", self.discrepancies)
        for what, each in errors:
            for name, error in zip(names, each, strict=True):
                if error < 0.0:
                    raise ParameterError(
                        f"the {what} of {name} is {error}: it must not be negative"
                    )
        for name in ("peak_velocity_range", "current_range", "dependence_range"):
            given = getattr(self, name)
            if name == "dependence_range" and given is None:
                continue
            if not isinstance(given, (list, tuple, np.ndarray)) or len(given) != 2:
                raise ParameterError(f"{name} must be a list of two numbers, lower bound first")
            low, high = (_number(bound, name) for bound in given)
            if not low <= high:
                raise ParameterError(f"{name} is [{low}, {high}]: give the lower bound first")
            object.__setattr__(self, name, (low, high))
        if self.largest_force < 0.0 or math.isinf(self.largest_force):
            raise ParameterError(
                f"largest_force is {self.largest_force}: give a finite, non-negative force [N]"
            )
        for what, text in (("id", self.set_id), ("source", self.source)):
            check_name(what, text)
        if not fits_a_stamp(self.stamp_ns):
            raise ParameterError(
                "the stamp_ns of the parameters is after January 2038, which a stamp cannot hold: "
                "give nanoseconds since 1970, or 0"
            )

    @property
    def law(self) -> Model:
        """The model that the parameters belong to."""
        return MODELS[self.model]

    @property
    def known_parameters(self) -> dict[str, tuple[float, float]]:
        """Value and standard error of each parameter by name; NaN for the error if it is unknown.

        The error of a parameter that is not observable counts as unknown.
        """
        errors = np.where(self.observable, self.standard_errors, math.nan)
        pairs = zip(self.values.tolist(), errors.tolist(), strict=True)
        return dict(zip(self.law.parameter_names, pairs, strict=True))

    @property
    def held_range(self) -> tuple[float, float]:
        """Range [m/s] to which the peak velocity is limited wherever the law is evaluated.

        Beyond the data that determined it, the dependence on the peak velocity is unknown and may
        even have a pole.
        """
        return self.dependence_range or self.peak_velocity_range

    def held(self, motion: Moved) -> Moved:
        """The motion with the peak velocity limited to :attr:`held_range`."""
        return motion.held_within(*self.held_range)

    def law_turning(self, *, gradual: bool) -> Model:
        """The law; if ``gradual``, with a continuous force at reversals instead of its jump."""
        return self.law.continuous if gradual else self.law

    def follow(
        self,
        motion: Motion,
        current: Array,
        period: float,
        state: State | None = None,
        *,
        gradual: bool,
    ) -> tuple[Array, State]:
        """Force (n,) [N] of samples ``period`` [s] apart, and the state after them.

        ``current`` [A] has shape (n,); ``state`` is the state after the previous sample;
        ``gradual`` is as in :meth:`law_turning`.
        """
        law = self.law_turning(gradual=gradual)
        return law.follow(self.values, self.held(motion), current, period, state)

    def window_force(self, window: Window, *, gradual: bool | None = False) -> Array:
        """Force (n,) [N] predicted at the samples of a window.

        ``gradual`` is as in :meth:`law_turning`; None means :meth:`turns_gradually`.
        """
        law = self.law_turning(gradual=self.turns_gradually(window) if gradual is None else gradual)
        return law.window_force(self.held(window), self.values)

    def settled(self, window: Window, *, gradual: bool = False) -> np.ndarray:
        """Mask (n,) of the samples whose force does not depend on the time before the window.

        The state of a law with memory is unknown at the first sample, so the force of the other
        samples says nothing about the set.
        """
        return self.law_turning(gradual=gradual).settled(self.held(window), self.values)

    def turns_gradually(self, window: Window) -> bool:
        """Whether the law with gradual reversals fits the measured force of a window better.

        A prediction selects the branch rule by the measured force in the same way. Without a
        measured force, reversals are gradual except in a steady sine, whose acceleration has no
        noise.
        """
        jumping, gradual = self.law, self.law.continuous
        if gradual is jumping or np.ptp(window.force) == 0.0:
            return gradual is not jumping and window.motion.sine is None
        errors = []
        for each in (False, True):
            error = self.window_force(window, gradual=each) - window.force
            error = error[self.settled(window, gradual=each)]
            errors.append(float(error @ error) / error.size if error.size else math.inf)
        return errors[1] < errors[0]

    def force(self, time: ArrayLike, displacement: ArrayLike, current: ArrayLike) -> Array:
        """Force (n,) [N] of the damper in a motion.

        ``time`` (n,) [s] is uniform, ``displacement`` (n,) [m] is positive in extension,
        ``current`` [A] is a number or has shape (n,). The force of a law with memory begins with a
        transient, because the past is unknown.

        Raises ValueError for non-uniform times and for unusable samples.

        >>> import numpy as np
        >>> import mr_damper_ros as mr
        >>> time = np.arange(1000) * 1e-3
        >>> damper = mr.ParameterSet(mr.MODELS["sigmoid"].initial_values()[0])
        >>> damper.force(time, 5e-3 * np.sin(2 * np.pi * time), 1.0).shape
        (1000,)
        """
        return self.window_force(motion_window(time, displacement, current), gradual=None)

    def largest_in_sine(self, peak_velocity: float, half_cycle: float, current: float) -> float:
        """Largest force [N] in a sine of this peak velocity [m/s] at a current [A].

        ``half_cycle`` [s] is that of the sine. Infinite if one of the two is not positive.
        """
        amplitude = peak_velocity * half_cycle / math.pi
        if not amplitude > 0.0:
            return math.inf
        force = self.force(
            2.0 * half_cycle * _SINE, amplitude * np.sin(2.0 * math.pi * _SINE), current
        )
        # The first half-cycle is a transient of a law with memory.
        return float(np.max(np.abs(force[_SINE >= 0.5])))

    @property
    def domain(self) -> Domain:
        """The speeds and currents for which the set holds."""
        confirmed_ns = self.stamp_ns if self.origin.is_identified else None
        return Domain(self.peak_velocity_range, self.current_range, confirmed_ns)

    def as_given(self) -> ParameterSet:
        """The set as loaded by a user; a start set stays one.

        If no parameter is marked as observable, the parameters that a run over the ranges of the
        set would determine are marked. An unbounded range determines none.
        """
        if not self.origin.is_evidence:
            return self
        given = self if self.origin is Origin.USER else replace(self, origin=Origin.USER)
        if given.observable.any():
            return given
        ranges = self.peak_velocity_range, self.current_range
        wide = [0.0 < high - low < math.inf for low, high in ranges]
        if not any(wide):
            return given
        known = [
            (parameter.peak_velocities == 1 or wide[0]) and (parameter.currents == 1 or wide[1])
            for parameter in self.law.parameters
        ]
        return replace(given, observable=np.array(known))

    def times_force(self, factor: float, error: float = 0.0, **changes: Any) -> ParameterSet:
        """The set with ``changes``, and its force multiplied by a factor with a standard error."""
        values, errors = self.values.copy(), self.standard_errors.copy()
        discrepancies, gains = self.discrepancies.copy(), self.law.strength_indices
        errors[gains] = np.hypot(errors[gains] * factor, values[gains] * error)
        values[gains] *= factor
        discrepancies[gains] *= factor
        changed: dict[str, Any] = {"values": values, "standard_errors": errors} | changes
        return replace(self, discrepancies=discrepancies, **changed)

    @property
    def doubt_over_current(self) -> str:
        """Why the set is not valid at several currents, in words; empty if it is."""
        low, high = self.current_range
        if not (math.isfinite(low) and high - low <= SAME_CURRENT):
            return ""
        return (
            f"set {self.set_id} was identified at {0.5 * (low + high):.3g} A only, so its force at "
            "other currents is unknown, and no current can be computed for a desired force: "
            "identify it from runs at several currents"
        )

    def of_model(self, model: str) -> ParameterSet:
        """Return the set; raises ParameterError if it is not of ``model``."""
        if self.model != model:
            raise ParameterError(
                f"the parameters belong to model '{self.model}': give a set of model '{model}'"
            )
        return self

    def start_of(self, model: str) -> Array:
        """Start values (p,) for another model that has all parameters of this set.

        Raises ParameterError if one is missing.
        """
        target, names = known_model(model), self.law.parameter_names
        if not set(names) <= set(target.parameter_names):
            return self.of_model(model).values
        values = target.initial_values()[0]
        values[target.places(names)] = self.values
        return values

    def as_dict(self) -> dict[str, float]:
        """Values by parameter name."""
        return dict(zip(self.law.parameter_names, self.values.tolist(), strict=True))

    def to_yaml(self) -> str:
        """YAML text that :meth:`from_yaml` reads back exactly."""
        units = self.law.units
        document: dict[str, Any] = {
            "model": self.model,
            "id": self.set_id,
            "source": self.source,
            "origin": self.origin.name.lower(),
            "stamp_ns": int(self.stamp_ns),
            "nrmse": _or_none(self.nrmse),
            "peak_velocity_range": list(self.peak_velocity_range),
            "current_range": list(self.current_range),
            "largest_force": _or_none(self.largest_force),
            **({} if self.dependence_range is None else {"dependence_range": [*self.held_range]}),
            "parameters": {
                name: {
                    "value": float(value),
                    "unit": units[name],
                    "standard_error": _or_none(error),
                    "discrepancy": _or_none(discrepancy),
                    "observable": bool(observable),
                }
                for name, value, error, discrepancy, observable in zip(
                    self.law.parameter_names,
                    self.values,
                    self.standard_errors,
                    self.discrepancies,
                    self.observable,
                    strict=True,
                )
            },
        }
        return str(yaml.safe_dump(document, sort_keys=False))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the set as YAML, for :meth:`load` and the nodes. Raises OSError."""
        write_text(Path(path), self.to_yaml())

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> ParameterSet:
        """Parameter set from a file, written by :meth:`save`, by ``identify`` or by hand.

        Raises ParameterError with one sentence that says what to change, and OSError.
        """
        try:
            return cls.from_yaml(Path(path).read_text(encoding="utf-8"))
        except UnicodeDecodeError as error:
            raise ParameterError(
                f"{os.fspath(path)} is not a parameter file: it is not text"
            ) from error
        except ParameterError as error:
            raise ParameterError(f"{os.fspath(path)}: {error}") from error

    @classmethod
    def from_yaml(cls, text: str) -> ParameterSet:
        """Parameter set from text written by :meth:`to_yaml`, or by hand.

        The shortest text is a mapping ``parameters`` with all names of the sigmoid law, each with a
        number or a mapping that contains ``value``. Any other law also needs its name as ``model``.
        Without the parameters of the current dependence, the law is independent of the current.

        Raises ParameterError with one sentence that says what to change.
        """
        try:
            return cls._from_document(yaml.load(text, _UniqueKeyLoader))
        except yaml.YAMLError as error:
            line = getattr(getattr(error, "problem_mark", None), "line", None)
            where = "" if line is None else f" at line {line + 1}"
            problem = getattr(error, "problem", None)
            detail = f": {problem}" if problem else ""
            raise ParameterError(f"the parameter file is not valid YAML{where}{detail}") from error
        except ParameterError:
            raise
        except Exception as error:
            # PyYAML raises various errors, as for a date that does not exist, !!int '', or many
            # brackets. Python does not convert a number of 5000 digits to text.
            raise ParameterError(
                "the parameter file has an entry that cannot be used: give plain YAML"
            ) from error

    @classmethod
    def _from_document(cls, document: Any) -> ParameterSet:
        known = {
            *("model", "id", "source", "origin", "stamp_ns", "nrmse"),
            *("peak_velocity_range", "current_range", "largest_force", "dependence_range"),
            "parameters",
        }
        if not isinstance(document, dict) or "parameters" not in document:
            raise ParameterError(
                "the parameter file has no mapping 'parameters': give the values by name"
            )
        known_only = f"remove them (the known entries are {', '.join(sorted(known))})"
        _check_keys(document, known, "the parameter file has unknown entries", known_only)
        model = document.get("model", DEFAULT_MODEL)
        law = known_model(model)
        names, units = law.parameter_names, law.units
        entries = document["parameters"]
        if not isinstance(entries, dict):
            raise ParameterError("'parameters' must map the names of the parameters to numbers")
        listed = f"the names are {', '.join(names)}"
        _check_keys(entries, names, f"model '{model}' has no parameter", listed)
        defaults = {parameter.name: parameter.default for parameter in law.parameters}
        missing = [name for name in names if name not in entries and defaults[name] is None]
        if missing:
            raise ParameterError(f"parameter {', '.join(missing)} is missing: give its value")
        rows = []
        for name in names:
            entry = entries.get(name, defaults[name])
            if not isinstance(entry, dict):
                entry = {"value": entry}
            _check_keys(entry, _ENTRIES, f"parameter {name} has unknown entries", "remove them")
            if entry.get("unit", units[name]) != units[name]:
                raise ParameterError(
                    f"parameter {name} is given in {entry['unit']}: convert it to {units[name]}"
                )
            flag = entry.get("observable", False)
            if not isinstance(flag, bool):
                raise ParameterError(f"observable of {name} is {_shown(flag)}: give true or false")
            value = _number(entry.get("value"), f"parameter {name}")
            error = _or_nan(entry.get("standard_error"), f"standard error of {name}")
            discrepancy = _or_nan(entry.get("discrepancy"), f"discrepancy of {name}")
            rows.append((value, error, flag, discrepancy))
        values, errors, observable, discrepancies = map(np.array, zip(*rows, strict=True))
        stamp = document.get("stamp_ns", 0)
        if isinstance(stamp, bool) or not isinstance(stamp, int):
            raise ParameterError("stamp_ns must be a whole number of nanoseconds")
        return cls(
            values=values,
            standard_errors=errors,
            observable=observable,
            set_id=str(document.get("id", "unnamed")),
            source=str(document.get("source", "file")),
            peak_velocity_range=document.get("peak_velocity_range", cls.peak_velocity_range),
            current_range=document.get("current_range", cls.current_range),
            nrmse=_or_nan(document.get("nrmse"), "nrmse"),
            stamp_ns=stamp,
            model=model,
            largest_force=_or_nan(document.get("largest_force"), "largest_force"),
            discrepancies=discrepancies,
            dependence_range=document.get("dependence_range"),
            origin=_origin(document.get("origin", Origin.USER.name.lower())),
        )


def _origin(name: Any) -> Origin:
    """The origin of this name; raises ParameterError for an unknown name."""
    names = {each.name.lower(): each for each in Origin}
    if not isinstance(name, str) or name not in names:
        raise ParameterError(f"origin is {_shown(name)}: the origins are {', '.join(names)}")
    return names[name]


def check_name(what: str, text: str) -> None:
    """Raise ParameterError if a text is too long for a message or not printable."""
    if not isinstance(text, str) or not text.isprintable() or len(text) > LONGEST_NAME:
        raise ParameterError(
            f"the {what} of the parameters is {str(text)[:40]!a}: give at most "
            f"{LONGEST_NAME} printable characters"
        )


def check_set(given: object) -> None:
    """Raise ParameterError for anything but a parameter set, such as the path of its file."""
    if not isinstance(given, ParameterSet):
        raise ParameterError(
            f"a parameter set cannot be of type {type(given).__name__}: give a ParameterSet, such "
            "as the parameter_set of an Identification, or ParameterSet.load(file)"
        )


def known_model(name: Any) -> Model:
    """The model of this name; raises ParameterError for an unknown name."""
    if not isinstance(name, str) or name not in MODELS:
        raise ParameterError(f"model {_shown(name)} is unknown: the models are {', '.join(MODELS)}")
    return MODELS[name]


class _UniqueKeyLoader(yaml.SafeLoader):
    """A loader that rejects duplicate keys; PyYAML would silently use the last of them."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        for index, key in enumerate(keys):
            if key in keys[:index]:
                raise yaml.constructor.ConstructorError(
                    None, None, f"'{key}' is given twice", node.value[index][0].start_mark
                )
        return super().construct_mapping(node, deep)


def _check_keys(given: Any, known: Collection[str], fault: str, remedy: str) -> None:
    """Raise ParameterError, which lists them, if there are unknown keys."""
    unknown = [str(key) for key in given if key not in known]
    if unknown:
        raise ParameterError(f"{fault} {', '.join(unknown)}: {remedy}")


def _number(value: Any, what: str) -> float:
    if isinstance(value, str):
        # YAML 1.1 reads 1e5 as text, but most programs write numbers in this form.
        try:
            return float(value)
        except ValueError:
            pass
    if isinstance(value, bool) or not isinstance(value, Real):
        raise ParameterError(f"{what} is {_shown(value)}: give a number")
    try:
        return float(value)
    except OverflowError as error:
        raise ParameterError(f"{what} is too large for a number") from error


def _or_nan(value: Any, what: str) -> float:
    """Read an optional number; NaN if it is missing or null."""
    return math.nan if value is None else _number(value, what)


def _or_none(value: float) -> float | None:
    """Write an optional number; NaN becomes null."""
    return None if math.isnan(value) else float(value)


def _shown(value: Any) -> str:
    """A value as short text, because a few characters of YAML can define endless lists."""
    shortened = reprlib.Repr()
    shortened.maxlevel = 1
    return shortened.repr(value)


def start_set(model: str) -> ParameterSet:
    """A start set of the model.

    For the sigmoid law it is the set from the literature; the extended law adds no lag, stiffness
    or offset to it. For any other model, its force is zero and never valid, and the fit of the
    first window starts from values derived from that window.
    """
    values, name, speed = MODELS[model].initial_values()
    return ParameterSet(
        values,
        set_id=name,
        source=name,
        peak_velocity_range=(speed, speed),
        current_range=(0.0, 0.0),
        model=model,
        origin=Origin.START if name == Origin.START.name.lower() else Origin.LITERATURE,
    )
