"""Tables of options: each table declares, validates and documents its options.

A table is a frozen dataclass. Each field is an :func:`option` with its default, description and
valid values, or a :func:`group`, which is another table. The names of the options of a group have
the name of the group and a dot as prefix, unless the group is flat::

    @dataclass(frozen=True)
    class PredictorSettings(CheckedSettings):
        timeout: float = option(1.0, "Age [s] of the oldest usable current.", within=(0.0, 60.0))

    @dataclass(frozen=True)
    class ModelParameters(ParameterTable):
        predictor: PredictorSettings = group(PredictorSettings, flat=True)
        frame_id: str = option("damper", "Frame of the published forces.")

Settings of the core derive from :class:`CheckedSettings` and reject invalid values when they are
created. A node declares its ROS parameters from its table
(:mod:`mr_damper_ros.nodes.node_parameters`), which contains the settings of the core as groups.
Each source of samples has its own table.
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
    """One parameter of a node; both ends of the range ``within`` are allowed.

    If the default is NaN, NaN is also valid and means "not given".
    """

    name: str
    default: Value
    description: str
    within: tuple[float, float] | None = None
    choices: tuple[str, ...] = ()
    read_only: bool = True
    start_only: bool = False

    @property
    def kind(self) -> type[Value]:
        """The type of the values."""
        return type(self.default)

    def normalised(self, value: Any) -> Any:
        """The value of Python; an integer becomes a float if the option is one (``rate: 1``)."""
        if getattr(value, "shape", None) == ():  # a number of NumPy
            value = value.item()
        if self.kind is float and type(value) is int:
            return float(value)
        return value

    def objection(self, value: Any) -> str:
        """A sentence why the value is invalid; empty if it is valid."""
        # A Boolean is no integer here, but a member of a StrEnum is a text.
        fits = isinstance(value, str) if self.kind is str else type(value) is self.kind
        if not fits:
            return f"parameter {self.name} must be {_TYPE_NAMES[self.kind]}, not {value!r}"
        if isinstance(value, float) and not math.isfinite(value):
            if math.isnan(value) and self.default != self.default:
                return ""
            return f"parameter {self.name} must be a finite number, not {value}"
        if self.choices and value not in self.choices:
            return f"parameter {self.name} must be one of {', '.join(self.choices)}, not {value!r}"
        if self.within is not None and not self.within[0] <= value <= self.within[1]:
            return f"parameter {self.name} must be {self.range_text}, not {value:g}"
        return ""

    @property
    def range_text(self) -> str:
        """The valid range in words; empty without a range."""
        if self.within is None:
            return ""
        low, high = (str(end) if isinstance(end, int) else f"{end:g}" for end in self.within)
        return f"from {low} to {high}"


@dataclass(frozen=True)
class ParameterTable:
    """Base class of the parameter tables of nodes."""

    def objection(self) -> str:
        """A sentence why the values are inconsistent; empty if they are consistent."""
        return ""


class CheckedSettings:
    """Base class of settings of the core, which are checked when they are created.

    Raises ValueError if a value is invalid.
    """

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):  # type: ignore[arg-type]
            if "option" in field.metadata:
                item = dataclasses.replace(field.metadata["option"], name=field.name)
                value = item.normalised(getattr(self, field.name))
                objection = item.objection(value)
                if objection:
                    raise ValueError(objection)
                object.__setattr__(self, field.name, value)


T = TypeVar("T")


def option(
    default: Value,
    description: str,
    *,
    within: tuple[float, float] | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = True,
    start_only: bool = False,
) -> Any:
    """A field of a parameter table with one option.

    ``read_only``: fixed while the node is active. ``start_only``: fixed from the start of a
    lifecycle node, even before it is configured.
    """
    details = Option("", default, description, within, choices, read_only, start_only)
    return dataclasses.field(default=default, metadata={"option": details})


def with_default(table: type, name: str, default: Value) -> Any:
    """The field ``name`` of another table, with a different default."""
    found: Option = {field.name: field for field in dataclasses.fields(table)}[name].metadata[
        "option"
    ]
    details = dataclasses.replace(found, default=default)
    return dataclasses.field(default=default, metadata={"option": details})


def group(table: type, *, flat: bool = False) -> Any:
    """A field with the options of another table; unless ``flat``, its name prefixes their names."""
    return dataclasses.field(default_factory=table, metadata={"group": table, "flat": flat})


def groups(tables: Mapping[str, tuple[str, type]]) -> Any:
    """A field with several tables by name, each with the prefix of its options and its class."""

    def defaults() -> dict[str, Any]:
        return {name: table() for name, (_, table) in tables.items()}

    return dataclasses.field(default_factory=defaults, metadata={"groups": tables})


def tables_of(field: dataclasses.Field[Any]) -> Mapping[str, tuple[str, type]]:
    """The tables of a field by name, each with its prefix; empty if the field is an option."""
    if "group" in field.metadata:
        prefix = "" if field.metadata["flat"] else f"{field.name}."
        return {field.name: (prefix, field.metadata["group"])}
    found: Mapping[str, tuple[str, type]] = field.metadata.get("groups", {})
    return found


def options(table: type, prefix: str = "") -> Iterator[Option]:
    """All options of a table and its groups, with their full names."""
    for field in dataclasses.fields(table):
        for own_prefix, part in tables_of(field).values():
            yield from options(part, prefix + own_prefix)
        if "option" in field.metadata:
            yield dataclasses.replace(field.metadata["option"], name=prefix + field.name)


def build(table: type[T], values: Mapping[str, Value], prefix: str = "") -> T:
    """The table with values by full name; missing options keep their defaults.

    Raises ValueError, with the full name, if a value is invalid, or if settings of the core are.
    """
    filled: dict[str, Any] = {}
    for item in options(table, prefix):
        if item.name in values and (objection := item.objection(values[item.name])):
            raise ValueError(objection)
    for field in dataclasses.fields(table):  # type: ignore[arg-type]
        name = prefix + field.name
        parts: dict[str, Any] = {
            key: build(part, values, prefix + own_prefix)
            for key, (own_prefix, part) in tables_of(field).items()
        }
        if parts:
            filled[field.name] = parts if "groups" in field.metadata else parts[field.name]
        elif name in values:
            filled[field.name] = values[name]
    return table(**filled)


def describe(table: type) -> str:
    """Description of all options, as text for a terminal."""
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
