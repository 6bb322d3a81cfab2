"""Starts a node, spins it, and ends it cleanly."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from typing import TypeVar

import rclpy
from rclpy.context import Context
from rclpy.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidParameterTypeException,
    InvalidParameterValueException,
)
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos_overriding_options import InvalidQosOverridesError
from rclpy.signals import SignalHandlerOptions
from rclpy.utilities import remove_ros_args

from mr_damper_ros.nodes.node_parameters import ConfigurationError
from mr_damper_ros.nodes.quality import OVERRIDES
from mr_damper_ros.nodes.rclpy_internals import RCLError, given_parameters
from mr_damper_ros.processes.blas_threads import keep_one_thread
from mr_damper_ros.processes.programs import WORKERS_HELP, Place, hosting
from mr_damper_ros.settings.option_table import ParameterTable, describe

SUCCESS = 0
FAILURE = 1
BAD_CONFIGURATION = 2

_LOG_ADVICE = "set ROS_LOG_DIR to a folder that the log can be written to"

_WAKE_UP = 0.1
"""Seconds after which a spinning node looks whether it is to stop, or at its end."""

_LAST_CHANCE = 10.0
"""Seconds that the middleware has to take a node down."""

N = TypeVar("N", bound=Node)


def run(
    factory: Callable[..., N],
    parameters: type[ParameterTable],
    arguments: Sequence[str] | None = None,
    ended: Callable[[N], int | None] = lambda _: None,
    between: Callable[[N], float] = lambda _: _WAKE_UP,
    hosted: str = "",
    shared_workers: bool = False,
) -> int:
    """Run a node until SIGINT, SIGTERM or the end of its work; returns the exit code.

    With ``hosted``, the help on it, it may be a node in each of several namespaces: the factory is
    then called with ``cli_args`` for each, as rclpy's Node takes them. ``shared_workers``: these
    share worker processes, whose number may be given.

    ``ended`` is the exit code once the node's work is over, None as long as it is not. ``between``
    is called between two callbacks, for what need not be done in one; it returns after how many
    seconds it is to be called again where no callback comes before. A
    configuration that the node cannot start with is one sentence on stderr and exit code 2.
    """
    keep_one_thread(with_scipy=False)  # only workers compute with it
    arguments = list(sys.argv if arguments is None else arguments)
    try:
        with _refusals("the command line cannot be used"):
            others = remove_ros_args(arguments)[1:]
        if "-h" in others or "--help" in others:
            print("Parameters, set by --ros-args -p NAME:=VALUE or --params-file FILE:\n")
            print(describe(parameters))
            print(hosted + (WORKERS_HELP if shared_workers else ""), end="")
            return SUCCESS
        places: tuple[Place, ...] = ()
        if hosted:
            try:
                found = hosting(others, shared_workers=shared_workers)
            except ValueError as error:
                raise ConfigurationError(str(error)) from error
            places, others = found.places, list(found.rest)
        if others:
            raise ConfigurationError(
                f"unknown argument {others[0]}: parameters are set by --ros-args -p NAME:=VALUE"
            )
        if not any(os.environ.get(name) for name in ("HOME", "ROS_HOME", "ROS_LOG_DIR")):
            raise ConfigurationError(f"HOME is not set: {_LOG_ADVICE}")
        # rclpy's own handlers shut the context down in the midst of whatever is being done:
        # callbacks fail, and the events executor may abort the process when that happens in its
        # first spin. With these the node ends in good order, and a signal before rclpy has started
        # is not lost.
        stop = _Stop()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, stop)
        with _refusals("the command line cannot be used"):
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        return _spin(_nodes(factory, places), ended, between, stop)
    except _CONFIGURATION_ERRORS as error:
        print(error, file=sys.stderr)
        return BAD_CONFIGURATION
    finally:
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def _refusals(what: str) -> Iterator[None]:
    """Make a ConfigurationError of what rcl raises, whose errors share no public base class."""
    try:
        yield
    except Exception as error:
        # Without the place in its source.
        reason = str(error).removeprefix("Failed to parse ROS arguments: ").split(", at /")[0]
        reason = " ".join(reason.split())
        advice = f"{reason}: {_LOG_ADVICE}" if "logging" in reason else f"{what}: {reason}"
        raise ConfigurationError(advice) from error


class _Stop:
    """Remembers a signal. An Event would not do: a second signal in its ``set`` locks it up."""

    def __init__(self) -> None:
        self.requested = False

    def __call__(self, *_: object) -> None:
        self.requested = True


def _nodes(factory: Callable[..., N], places: Sequence[Place]) -> list[N]:
    """The node, or that of each place."""
    if not places:
        return [_node(factory)]
    nodes = []
    for place in places:
        try:
            nodes.append(_node(partial(factory, cli_args=place.arguments)))
        except _CONFIGURATION_ERRORS as error:
            raise ConfigurationError(f"{place.namespace}: {error}") from error
    return nodes


def _node(factory: Callable[..., N]) -> N:
    try:
        node = factory()
    except RCLError:
        with _refusals("the node cannot be started"):
            raise
    for name in given_parameters(node):
        if name.startswith(OVERRIDES) and not node.has_parameter(name):
            node.get_logger().warning(f"{name} is not used: there is no such topic so far")
    return node


def _spin(
    nodes: Sequence[N],
    ended: Callable[[N], int | None],
    between: Callable[[N], float],
    stop: _Stop,
) -> int:
    executor = make_executor()
    for node in nodes:
        executor.add_node(node)
    # What was made so far stays to the end. Looking through it for garbage takes some tens of
    # milliseconds, in which blocks would wait.
    gc.collect()
    gc.freeze()
    try:
        while not stop.requested:
            executor.spin_once(timeout_sec=min(_WAKE_UP, *map(between, nodes)))
            for code in map(ended, nodes):
                if code is not None:
                    return code
    finally:
        executor.shutdown()
        _end_in_any_case()
        for node in nodes:
            node.destroy_node()
    return SUCCESS


def _end_in_any_case() -> None:
    """End the process soon, even if what takes the node down never returns.

    Fast DDS 2.14 has been seen to lock up when a writer was deleted while another participant
    left, with Python's own lock held: no Python code runs any more, nor any signal's.
    faulthandler waits in a thread without that lock. What a node has to keep is on disk before its
    publishers go.
    """
    nowhere = os.open(os.devnull, os.O_WRONLY)
    faulthandler.dump_traceback_later(_LAST_CHANCE, exit=True, file=nowhere)


_CONFIGURATION_ERRORS = (
    ConfigurationError,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    InvalidQosOverridesError,
    InvalidNodeNameException,
    InvalidNamespaceException,
)


def make_executor(context: Context | None = None) -> Executor:
    """The executor that all nodes use; ``context`` None is rclpy's own.

    The events executor takes half of the processor time of the single-threaded one and has the
    shorter tail of latencies; services, timers, lifecycle transitions and actions were tried with
    it. It must be driven by ``spin_once`` with a timeout: its ``spin`` waits in an undefined way
    before rclpy 7.1.8. Jazzy had none before rclpy 7.1.4.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)
