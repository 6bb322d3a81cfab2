"""Starts a node, spins it, and ends it in an orderly way."""

from __future__ import annotations

import faulthandler
import gc
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
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

from mr_damper_ros.nodes.quality import OVERRIDES, use_profile
from mr_damper_ros.nodes.rclpy_internals import RCLError, given_parameters
from mr_damper_ros.processes.blas_threads import keep_one_thread
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.settings.option_table import ParameterTable, describe

SUCCESS = 0
FAILURE = 1
BAD_CONFIGURATION = 2

_LOG_ADVICE = "set ROS_LOG_DIR to a folder in which the log can be written"

_WAKE_UP = 0.1
"""Largest time [s] between two checks whether a spinning node must stop or has finished."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)

N = TypeVar("N", bound=Node)


class ConfigurationError(ValueError):
    """The configuration of the node is invalid; the message is a sentence with the reason."""


def run(
    factory: Callable[[], N],
    parameters: type[ParameterTable],
    arguments: Sequence[str] | None = None,
    ended: Callable[[N], int | None] = lambda _: None,
    between: Callable[[N], float] = lambda _: _WAKE_UP,
    left: Callable[[N], int] = lambda _: SUCCESS,
) -> int:
    """Run a node until SIGINT, SIGTERM or the end of its work; returns the exit code.

    ``ended`` returns the exit code once the node has finished its work, None before. ``between``
    does work after each callback, and at the latest after the time [s] that it returned. ``left``
    returns the exit code of a node that a signal has ended. An invalid configuration gives one
    sentence on stderr and exit code 2.
    """
    keep_one_thread(with_scipy=False)  # only workers use SciPy
    arguments = list(sys.argv if arguments is None else arguments)
    try:
        with _refusals("the command line cannot be used"):
            others = remove_ros_args(arguments)[1:]
        if "-h" in others or "--help" in others:
            print("Parameters, set by --ros-args -p NAME:=VALUE or --params-file FILE:\n")
            print(describe(parameters))
            return SUCCESS
        if others:
            raise ConfigurationError(
                f"unknown argument {others[0]}: parameters are set by --ros-args -p NAME:=VALUE"
            )
        if not any(os.environ.get(name) for name in ("HOME", "ROS_HOME", "ROS_LOG_DIR")):
            raise ConfigurationError(f"HOME is not set: {_LOG_ADVICE}")
        # rclpy's own signal handlers shut the context down while callbacks run, and Ctrl-C raises
        # an exception in the middle of a callback: of 60 nodes that were so interrupted, three
        # ended with an error of rcl. With these handlers the node ends between two callbacks. An
        # Event would deadlock on a second signal while it is being set.
        signals: list[int] = []
        for number in _SIGNALS:
            signal.signal(number, lambda received, _: signals.append(received))
        use_profile()
        with _refusals("the command line cannot be used"):
            rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        return _spin(_node(factory), ended, between, left, signals)
    except _CONFIGURATION_ERRORS as error:
        print(error, file=sys.stderr)
        return BAD_CONFIGURATION
    finally:
        rclpy.try_shutdown()
        # A second Ctrl-C would end Python by the signal while it exits.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def _refusals(what: str) -> Iterator[None]:
    """Convert errors of rcl, which share no public base class, to ConfigurationError."""
    try:
        yield
    except Exception as error:
        # The position in the source code of rcl is removed.
        reason = str(error).removeprefix("Failed to parse ROS arguments: ").split(", at /")[0]
        reason = " ".join(reason.split())
        advice = f"{reason}: {_LOG_ADVICE}" if "logging" in reason else f"{what}: {reason}"
        raise ConfigurationError(advice) from error


def _node(factory: Callable[[], N]) -> N:
    try:
        node = factory()
    except RCLError:
        with _refusals("the node cannot be started"):
            raise
    except (ValueError, OSError) as error:
        raise ConfigurationError(reason_of(error)) from error
    for name in given_parameters(node):
        if name.startswith(OVERRIDES) and not node.has_parameter(name):
            node.get_logger().warning(f"{name} is not used: the node has no such topic so far")
    return node


def _spin(
    node: N,
    ended: Callable[[N], int | None],
    between: Callable[[N], float],
    left: Callable[[N], int],
    signals: Sequence[int],
) -> int:
    """Spin the node until it has ended or a signal has been received; returns the exit code."""
    executor = make_executor()
    executor.add_node(node)
    # All existing objects live until the end. Checking them in each garbage collection would take
    # some tens of milliseconds, during which blocks would wait.
    gc.collect()
    gc.freeze()
    try:
        while not signals:
            executor.spin_once(timeout_sec=min(_WAKE_UP, between(node)))
            code = ended(node)
            if code is not None:
                return code
    finally:
        executor.shutdown()
        # Fast DDS 2.14 sometimes deadlocks if a writer is deleted while another participant leaves.
        # The deadlocked thread holds Python's global lock, so that neither Python code nor signal
        # handlers can run. The thread of faulthandler, which ends the process, does not need it.
        # All state of the node is on disk before its publishers are destroyed.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        faulthandler.dump_traceback_later(10.0, exit=True, file=nowhere)
        node.destroy_node()
    return left(node)


_CONFIGURATION_ERRORS = (
    ConfigurationError,
    InvalidParameterTypeException,
    InvalidParameterValueException,
    InvalidQosOverridesError,
    InvalidNodeNameException,
    InvalidNamespaceException,
)


def make_executor(context: Context | None = None) -> Executor:
    """The executor of all nodes; ``context`` None is rclpy's default context.

    The events executor (Jazzy since rclpy 7.1.4) takes half of the processor time of the
    single-threaded one, and long latencies are rarer. It was tested with services, timers,
    lifecycle transitions and actions. The executor must be driven by ``spin_once`` with a timeout,
    because before rclpy 7.1.8 the waiting time of its ``spin`` is undefined.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor(context=context)
    return EventsExecutor(context=context)
