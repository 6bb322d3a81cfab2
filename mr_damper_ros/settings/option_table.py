"""Tables of options: one table is declaration, validation and documentation.

A table is a frozen dataclass. Each field is an :func:`option` with its default, its description
and what values it takes, or a :func:`group` of options, another such dataclass, whose names are
prefixed by the group's and a dot::

    @dataclass(frozen=True)
    class ModelParameters(ParameterTable):
        frame_id: str = option("damper", "Frame of the published forces.")
        staleness: float = option(0.5, "Oldest usable current [s].", minimum=0.0, read_only=True)

A node makes parameters of it (:mod:`mr_damper_ros.nodes.node_parameters`); a source of samples
brings a table of its own.
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
    read_only: bool = False
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
            return f"at least {self.minimum:g}"
        if self.minimum is None:
            return f"at most {self.maximum:g}"
        return f"from {self.minimum:g} to {self.maximum:g}"


@dataclass(frozen=True)
class ParameterTable:
    """Base of a node's parameter table."""

    def objection(self) -> str:
        """Why these values do not go together, in a sentence; empty where they do."""
        return ""


T = TypeVar("T", bound=ParameterTable)


def option(
    default: Value,
    description: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = False,
    start_only: bool = False,
) -> Any:
    """A field of a parameter table: one parameter.

    ``read_only``: fixed while the node works. ``start_only``: fixed even where a managed node does
    not work yet.
    """
    read_only = read_only or start_only
    details = Option("", default, description, minimum, maximum, choices, read_only, start_only)
    return dataclasses.field(default=default, metadata={"option": details})


def group(table: type) -> Any:
    """A field of a parameter table: further options, prefixed by its name."""
    return dataclasses.field(default_factory=table, metadata={"group": table})


def groups(tables: Mapping[str, tuple[str, type]]) -> Any:
    """A field of a parameter table: tables by name, each with the prefix of its options."""

    def defaults() -> dict[str, Any]:
        return {name: table() for name, (_, table) in tables.items()}

    return dataclasses.field(default_factory=defaults, metadata={"groups": tables})


def options(table: type, prefix: str = "") -> Iterator[Option]:
    """All parameters of a table, groups included, by their full names."""
    for field in dataclasses.fields(table):
        if "group" in field.metadata:
            yield from options(field.metadata["group"], f"{prefix}{field.name}.")
        elif "groups" in field.metadata:
            for own_prefix, part in field.metadata["groups"].values():
                yield from options(part, prefix + own_prefix)
        else:
            yield dataclasses.replace(field.metadata["option"], name=prefix + field.name)


def build(table: type[T], values: Mapping[str, Value], prefix: str = "") -> T:
    """The table filled from values by full name; what is missing keeps its default."""
    filled: dict[str, Any] = {}
    for field in dataclasses.fields(table):
        name = prefix + field.name
        if "group" in field.metadata:
            filled[field.name] = build(field.metadata["group"], values, f"{name}.")
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
