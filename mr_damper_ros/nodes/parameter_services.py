"""Limits on the services that every node has for its parameters: rclpy sets none.

A request of a megabyte with the name of one parameter over and over holds up a node for seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
from rclpy.node import Node

MOST_ENTRIES = 1000
"""Names, prefixes or values in a request; no node has so many parameters."""

_ENTRIES: dict[type, str] = {
    GetParameters: "names",
    GetParameterTypes: "names",
    DescribeParameters: "names",
    ListParameters: "prefixes",
    SetParameters: "parameters",
    SetParametersAtomically: "parameters",
}
"""The field of each service's request that may be long."""


def limit_parameter_services(node: Node) -> None:
    """Let the node refuse requests with more entries than it could ever need.

    What is asked for nothing gets nothing, as rclpy answers where a parameter is not known; what is
    to be set is told the reason.
    """
    for service in node.services:
        if service.srv_type in _ENTRIES:
            field = _ENTRIES[service.srv_type]
            service.callback = partial(_answer, node, field, service.callback)


def _answer(
    node: Node, field: str, answer: Callable[[Any, Any], Any], request: Any, response: Any
) -> Any:
    count = len(getattr(request, field))
    if count <= MOST_ENTRIES:
        return answer(request, response)
    reason = f"the request has {count} {field}: at most {MOST_ENTRIES} are answered"
    node.get_logger().warning(reason, throttle_duration_sec=10.0)
    result = SetParametersResult(successful=False, reason=reason)
    if isinstance(response, SetParameters.Response):
        response.results = [result]
    elif isinstance(response, SetParametersAtomically.Response):
        response.result = result
    return response
