"""Tables of options: one table is declaration, validation and documentation.

A table is a frozen dataclass. Each field is an :func:`option` with its default, its description
and what values it takes, or a :func:`group` of options, another such dataclass, whose names are
prefixed by the group's and a dot unless it is flat::

    @dataclass(frozen=True)
    class PredictorSettings(CheckedSettings):
        timeout: float = option(1.0, "Age [s] of the oldest usable current.", minimum=0.0)

    @dataclass(frozen=True)
    class ModelParameters(ParameterTable):
        predictor: PredictorSettings = group(PredictorSettings, flat=True)
        frame_id: str = option("damper", "Frame of the published forces.")

What works in the core has :class:`CheckedSettings`: they cannot be made with values that are not
allowed. A node makes parameters of its table (:mod:`mr_damper_ros.nodes.node_parameters`) and takes
the settings of the core into it; a source of samples brings a table of its own.
"""

from __future__ import annotations

import dataclasses
import math
import textwrap
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

Value = bool | int | float | str

_TYPE_NAMES = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}


@dataclass(frozen=True)
class Option:
    """One parameter of a node; ``minimum`` and ``maximum`` belong to the allowed values.

    Where the default is NaN, NaN means "not given" and is allowed.
    """

    name: str
    default: Value
    description: str
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True
    start_only: bool = False

    @property
    def kind(self) -> type[Value]:
        """The type of the values."""
        return type(self.default)

    def normalised(self, value: Any) -> Any:
        """The value, an integer made a float where a float is expected (``rate: 1``)."""
        if self.kind is float and type(value) is int:
            return float(value)
        return value

    def objection(self, value: Any) -> str:
        """Why a value is not allowed, in a sentence; empty where it is."""
        if type(value) is not self.kind:
            return f"parameter {self.name} must be {_TYPE_NAMES[self.kind]}, not {value!r}"
        return self.out_of_range(value)

    def out_of_range(self, value: Any) -> str:
        """Why a value of the right type is not allowed, in a sentence; empty where it is."""
        if isinstance(value, float) and not math.isfinite(value):
            if math.isnan(value) and self.default != self.default:
                return ""
            return f"parameter {self.name} must be a finite number, not {value}"
        if self.choices and value not in self.choices:
            return f"parameter {self.name} must be one of {', '.join(self.choices)}, not {value!r}"
        if isinstance(value, (int, float)):
            low = -math.inf if self.minimum is None else self.minimum
            high = math.inf if self.maximum is None else self.maximum
            if not low <= value <= high:
                return f"parameter {self.name} must be {self.range_text}, not {value:g}"
        return ""

    @property
    def range_text(self) -> str:
        """The allowed range in words; empty where there is none."""
        if self.minimum is None and self.maximum is None:
            return ""
        if self.maximum is None:
            return f"at least {_shown(self.minimum)}"
        if self.minimum is None:
            return f"at most {_shown(self.maximum)}"
        return f"from {_shown(self.minimum)} to {_shown(self.maximum)}"


def _shown(limit: float | None) -> str:
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


@dataclass(frozen=True)
class ParameterTable:
    """Base of a node's parameter table."""

    def objection(self) -> str:
        """Why these values do not go together, in a sentence; empty where they do."""
        return ""


class CheckedSettings:
    """Base of the settings of something in the core: a table that is checked when it is made.

    Raises ValueError, in a sentence, for a value that is not allowed.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if "option" in field.metadata:
                item = dataclasses.replace(field.metadata["option"], name=field.name)
                objection = item.out_of_range(getattr(self, field.name))
                if objection:
                    raise ValueError(objection)


T = TypeVar("T")


def option(
    default: Value,
    description: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = True,
    start_only: bool = False,
) -> Any:
    """A field of a parameter table: one parameter.

    ``read_only``: fixed while the node works, as most are. ``start_only``: fixed even where a
    managed node does not work yet.
    """
    details = Option("", default, description, minimum, maximum, choices, read_only, start_only)
    return dataclasses.field(default=default, metadata={"option": details})


def with_default(table: type, name: str, default: Value) -> Any:
    """The field of this name of another table, with another default."""
    found: Option = {field.name: field for field in dataclasses.fields(table)}[name].metadata[
        "option"
    ]
    details = dataclasses.replace(found, default=default)
    return dataclasses.field(default=default, metadata={"option": details})


@dataclass(frozen=True)
class _Group:
    """What a field holds that is a group of options."""

    table: type
    flat: bool

    def prefix(self, name: str) -> str:
        """What goes before the options' names where the field has this name."""
        return "" if self.flat else f"{name}."


def group(table: type, *, flat: bool = False) -> Any:
    """A field of a parameter table: further options, prefixed by its name unless ``flat``."""
    return dataclasses.field(default_factory=table, metadata={"group": _Group(table, flat)})


def groups(tables: Mapping[str, tuple[str, type]]) -> Any:
    """A field of a parameter table: tables by name, each with the prefix of its options."""

    def defaults() -> dict[str, Any]:
        return {name: table() for name, (_, table) in tables.items()}

    return dataclasses.field(default_factory=defaults, metadata={"groups": tables})


def options(table: type, prefix: str = "") -> Iterator[Option]:
    """All parameters of a table, groups included, by their full names."""
    for field in dataclasses.fields(table):
        if "group" in field.metadata:
            inner: _Group = field.metadata["group"]
            yield from options(inner.table, prefix + inner.prefix(field.name))
        elif "groups" in field.metadata:
            for own_prefix, part in field.metadata["groups"].values():
                yield from options(part, prefix + own_prefix)
        else:
            item: Option = field.metadata["option"]
            yield dataclasses.replace(item, name=prefix + field.name)


def build(table: type[T], values: Mapping[str, Value], prefix: str = "") -> T:
    """The table filled from values by full name; what is missing keeps its default.

    Raises ValueError, in a sentence, where settings of the core do not go together.
    """
    filled: dict[str, Any] = {}
    for field in dataclasses.fields(table):  # type: ignore[arg-type]
        name = prefix + field.name
        if "group" in field.metadata:
            inner: _Group = field.metadata["group"]
            filled[field.name] = build(inner.table, values, prefix + inner.prefix(field.name))
        elif "groups" in field.metadata:
            filled[field.name] = {
                key: build(part, values, prefix + own_prefix)
                for key, (own_prefix, part) in field.metadata["groups"].items()
            }
        elif name in values:
            filled[field.name] = values[name]
    return table(**filled)


def describe(table: type) -> str:
    """The table as text for a terminal."""
    parts = []
    for item in options(table):
        notes = [f"default {item.default!r}"]
        if item.choices:
            notes.append("one of " + ", ".join(item.choices))
        if item.range_text:
            notes.append(item.range_text)
        if item.read_only:
            notes.append("fixed while the node works")
        text = f"{item.description} ({'; '.join(notes)})"
        parts.append(f"  {item.name}\n{textwrap.indent(textwrap.fill(text, 88), '      ')}")
    return "\n".join(parts)
