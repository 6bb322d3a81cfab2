"""Node parameters: one table per node that is declaration, validation and documentation.

The table is a frozen dataclass. Each field is an :func:`option` with its default, its description
and what values it takes, or a :func:`group` of options, another such dataclass, whose names are
prefixed by the group's and a dot::

    @dataclass(frozen=True)
    class ModelParameters(ParameterTable):
        frame_id: str = option("damper", "Frame of the published forces.")
        staleness: float = option(0.5, "Oldest usable current [s].", minimum=0.0, read_only=True)

A node then says ``self.parameters = NodeParameters(self, ModelParameters, changed=self._changed)``
and reads ``self.parameters.values.staleness`` (not ``_parameters``, which is rclpy's own name).
Every option that is not read-only must be applied when it changes: read it where it is used, or
apply it in ``changed``.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import textwrap
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, TypeVar

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
    from rclpy.node import Node
    from rclpy.parameter import Parameter

Value = bool | int | float | str

_TYPE_NAMES = {bool: "true or false", int: "an integer", float: "a number", str: "a text"}

_NOT_OURS = ("qos_overrides.", "use_sim_time", "start_type_description_service")
"""Overrides that rclpy itself declares, some of them only with the publisher they belong to."""


class ConfigurationError(ValueError):
    """The node cannot start as it is configured; the message is a sentence that says why."""


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
) -> Any:
    """A field of a parameter table: one parameter."""
    details = Option("", default, description, minimum, maximum, choices, read_only)
    return dataclasses.field(default=default, metadata={"option": details})


def group(table: type) -> Any:
    """A field of a parameter table: further options, prefixed by its name."""
    return dataclasses.field(default_factory=table, metadata={"group": table})


def options(table: type, prefix: str = "") -> Iterator[Option]:
    """All parameters of a table, groups included, by their full names."""
    for field in dataclasses.fields(table):
        if "group" in field.metadata:
            yield from options(field.metadata["group"], f"{prefix}{field.name}.")
        else:
            yield dataclasses.replace(field.metadata["option"], name=prefix + field.name)


def build(table: type[T], values: Mapping[str, Value], prefix: str = "") -> T:
    """The table filled from values by full name; what is missing keeps its default."""
    filled: dict[str, Any] = {}
    for field in dataclasses.fields(table):
        name = prefix + field.name
        if "group" in field.metadata:
            filled[field.name] = build(field.metadata["group"], values, f"{name}.")
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
            notes.append("fixed while the node runs")
        text = f"{item.description} ({'; '.join(notes)})"
        parts.append(f"  {item.name}\n{textwrap.indent(textwrap.fill(text, 88), '      ')}")
    return "\n".join(parts)


class NodeParameters(Generic[T]):
    """The parameters of a running node, declared, validated and kept up to date.

    Raises ConfigurationError where a value given at the start is unknown, of the wrong type or
    not allowed. Later changes are accepted or rejected with a sentence as the reason; ``changed``
    is called after each accepted change of a value that is not read-only.
    """

    def __init__(
        self, node: Node, table: type[T], changed: Callable[[T], None] | None = None
    ) -> None:
        self._table = table
        self._options = {item.name: item for item in options(table)}
        self._changed = changed
        given = self._given(node)
        objections = [self._options[name].objection(value) for name, value in given.items()]
        defaults = {name: item.default for name, item in self._options.items()}
        self._raise_first(objections)
        self._values = build(table, defaults | given)
        self._raise_first([self._values.objection()])
        for name, item in self._options.items():
            node.declare_parameter(
                name, (defaults | given)[name], _descriptor(item), ignore_override=True
            )
        self._node = node
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    @property
    def values(self) -> T:
        """The present values."""
        return self._values

    @staticmethod
    def _raise_first(objections: list[str]) -> None:
        for objection in objections:
            if objection:
                raise ConfigurationError(objection)

    def _given(self, node: Node) -> dict[str, Any]:
        """Values from the command line and from parameter files, by name."""
        # rclpy ignores values for undeclared parameters without a word, so that a misspelt name
        # would leave the default in force; the values given are not public in rclpy.
        given: dict[str, Any] = {}
        for name, parameter in node._parameter_overrides.items():
            if name.startswith(_NOT_OURS):
                continue
            if name not in self._options:
                close = difflib.get_close_matches(name, self._options, n=1)
                hint = f"did you mean {close[0]}?" if close else "--help lists all there are"
                raise ConfigurationError(f"there is no parameter {name}: {hint}")
            given[name] = self._options[name].normalised(parameter.value)
        return given

    def _merged(self, parameters: list[Parameter]) -> T:
        """The table after a change; other parameters, such as use_sim_time, are not in it."""
        present = {name: self._node.get_parameter(name).value for name in self._options}
        new = {p.name: p.value for p in parameters if p.name in self._options}
        return build(self._table, present | new)

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        from rcl_interfaces.msg import SetParametersResult

        for parameter in parameters:
            item = self._options.get(parameter.name)
            objection = item.objection(parameter.value) if item else ""
            if objection:
                return SetParametersResult(successful=False, reason=objection)
        objection = self._merged(parameters).objection()
        return SetParametersResult(successful=not objection, reason=objection)

    def _apply(self, parameters: list[Parameter]) -> None:
        if not any(parameter.name in self._options for parameter in parameters):
            return
        self._values = self._merged(parameters)
        if self._changed is not None:
            self._changed(self._values)


def _descriptor(item: Option) -> ParameterDescriptor:
    from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor

    descriptor = ParameterDescriptor(
        name=item.name,
        description=item.description,
        read_only=item.read_only,
        additional_constraints=f"one of {', '.join(item.choices)}" if item.choices else "",
    )
    if item.range_text:
        if item.kind is int:
            limit = 2**63 - 1
            low = -limit if item.minimum is None else int(item.minimum)
            high = limit if item.maximum is None else int(item.maximum)
            descriptor.integer_range = [IntegerRange(from_value=low, to_value=high)]
        else:
            descriptor.floating_point_range = [
                FloatingPointRange(
                    from_value=-math.inf if item.minimum is None else float(item.minimum),
                    to_value=math.inf if item.maximum is None else float(item.maximum),
                )
            ]
    return descriptor
