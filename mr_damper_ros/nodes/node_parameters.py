"""The parameters of a running node, from a table of options.

A node sets ``self.parameters = NodeParameters(self, ModelParameters, changed=self._changed)`` and
reads ``self.parameters.values.frame_id`` (rclpy itself uses the name ``_parameters``). The node
must apply every change of an option that is not read-only: it reads the option at each use, or
applies the change in ``changed``.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection
from typing import Any, Generic, TypeVar

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.node import Node
from rclpy.parameter import Parameter

from mr_damper_ros.nodes import quality, rclpy_internals
from mr_damper_ros.settings.option_table import Option, ParameterTable, build, options

T = TypeVar("T", bound=ParameterTable)


class NodeParameters(Generic[T]):
    """The parameters of a running node, declared, validated and kept up to date.

    Raises ValueError if a parameter given at the start is unknown, or its value has the wrong type
    or is not allowed. Later changes are accepted, or rejected with a reason. ``changed``
    is called after each accepted change, with the values and the names that were set, even if a
    value stays the same. A managed node passes ``configured``; while it returns false, read-only
    options may also be set. ``values`` are the present values.
    """

    def __init__(
        self,
        node: Node,
        table: type[T],
        changed: Callable[[T, Collection[str]], None] | None = None,
        configured: Callable[[], bool] | None = None,
    ) -> None:
        self._table = table
        self._options = {item.name: item for item in options(table)}
        self._fixed = {name for name, item in self._options.items() if item.read_only}
        self._changed = changed
        self._configured = configured
        values = {name: item.default for name, item in self._options.items()} | self._given(node)
        self.values = build(table, values)
        _refuse(self.values.objection())
        for name, item in self._options.items():
            descriptor = _descriptor(item)
            descriptor.read_only = item.start_only if configured else item.read_only
            node.declare_parameter(name, values[name], descriptor, ignore_override=True)
        self._node = node
        node.add_on_set_parameters_callback(self._judge)
        node.add_post_set_parameters_callback(self._apply)

    def _given(self, node: Node) -> dict[str, Any]:
        """Valid values from the command line and from parameter files, by name."""
        # rclpy silently ignores values for undeclared parameters; with a misspelt name, the default
        # would be used.
        given: dict[str, Any] = {}
        for name, value in rclpy_internals.given_parameters(node).items():
            if name.startswith(quality.OVERRIDES):
                _refuse(quality.objection(name, value))
                continue  # rclpy declares it with its publisher or subscription
            if name.startswith(("use_sim_time", "start_type_description_service")):
                continue  # rclpy declares it
            if name not in self._options:
                close = difflib.get_close_matches(name, self._options, n=1)
                hint = f"did you mean {close[0]}?" if close else "--help lists all parameters"
                raise ValueError(f"there is no parameter {name}: {hint}")
            given[name] = self._options[name].normalised(value)
        return given

    def _merged(self, parameters: list[Parameter]) -> T:
        """The table after a change, without other parameters such as use_sim_time."""
        present = {name: self._node.get_parameter(name).value for name in self._options}
        new = {p.name: p.value for p in parameters if p.name in self._options}
        return build(self._table, present | new)

    def _judge(self, parameters: list[Parameter]) -> SetParametersResult:
        try:
            objection = self._merged(parameters).objection()
        except ValueError as error:
            objection = str(error)
        fixed = {parameter.name for parameter in parameters} & self._fixed
        if fixed and self._configured is not None and self._configured():
            objection = (
                f"parameter {min(fixed)} is fixed while the node is configured: first call its "
                "transition cleanup"
            )
        return SetParametersResult(successful=not objection, reason=objection)

    def _apply(self, parameters: list[Parameter]) -> None:
        names = {parameter.name for parameter in parameters} & self._options.keys()
        if not names:
            return
        self.values = self._merged(parameters)
        if self._changed is not None:
            self._changed(self.values, names)


def _refuse(objection: str) -> None:
    if objection:
        raise ValueError(objection)


def _descriptor(item: Option) -> ParameterDescriptor:
    descriptor = ParameterDescriptor(
        name=item.name,
        description=item.description,
        additional_constraints=f"one of {', '.join(item.choices)}" if item.choices else "",
    )
    if item.within is not None:
        low, high = map(item.kind, item.within)
        ranged = {"from_value": low, "to_value": high}
        if item.kind is int:
            descriptor.integer_range = [IntegerRange(**ranged)]
        else:
            descriptor.floating_point_range = [FloatingPointRange(**ranged)]
    return descriptor
