"""Parameter sets from messages or a file, and the identifier's reports about them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from mr_damper_msgs.msg import DamperParameters, FitReport
from rclpy.node import Node

from mr_damper_ros.models.parameter_set import ParameterError, ParameterSet
from mr_damper_ros.models.plausibility import check_plausible
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Finding
from mr_damper_ros.nodes.messages import parameter_set, to_nanoseconds
from mr_damper_ros.nodes.node_parameters import ConfigurationError
from mr_damper_ros.settings.option_table import ParameterTable, option
from mr_damper_ros.signals.error_sums import RunningError
from mr_damper_ros.tracking.predictor import ForcePredictor
from mr_damper_ros.tracking.reports import WindowVerdict
from mr_damper_ros.tracking.state_directory import StateError, read_parameter_file

PARAMETERS_TOPIC = "damper/parameters"
REPORT_TOPIC = "damper/fit_report"

_UNKNOWN = "_NODE_NAME_UNKNOWN_"
"""Part of the name that the ROS graph gives to a node before its name is known."""

_SHOWN = 100
"""Shown characters of a name: a message may hold a megabyte of them."""


@dataclass(frozen=True)
class SetOptions(ParameterTable):
    """Options that choose the parameter set of a node and judge its force."""

    parameter_file: str = option(
        "",
        'Parameter file (YAML) to use; "": none. A set from an identifier replaces the file once '
        "the set covers all currents of the file, or once the force of the file is wrong; the "
        "start set of an identifier never replaces it. Give the identifier the same file as "
        "initial_parameters. With a file no identifier is needed.",
    )
    trusted_source: str = option(
        "",
        "Name of the only node whose parameters and reports are used, such as /identifier; "
        '"": any. Without a name, two nodes that publish damper/parameters are an error in '
        "the diagnostics. The ROS graph shows which nodes publish; if several do, the field "
        "node of the messages is also checked. Both can be forged; only SROS2 authenticates "
        "(doc/security.md).",
    )
    error_memory: float = option(
        10.0,
        "Averaging time [s] of the error of the force in the diagnostics.",
        within=(0.1, 3600.0),
    )


class ParameterInput:
    """Subscribes to parameter sets and reports, and passes on valid ones.

    ``use`` receives a set and the stamp of the last sample that it is known to fit, None if
    unknown. The ``predictor`` receives the identifier's reports about the set in use. A new set
    resets ``error``. Parameters of a file are used at once; raises ConfigurationError if they are
    invalid.

    With a ``trusted_source``, messages of other nodes are ignored. The ROS graph shows which nodes
    publish a topic, but rclpy of Jazzy does not show which of them sent a message (later versions
    have ``publisher_gid``). If several nodes publish, the node name in the message is also checked,
    which any node can forge. Without SROS2, the names in the graph are not authenticated either.
    """

    def __init__(
        self,
        node: Node,
        use: Callable[[ParameterSet, int | None], None],
        predictor: ForcePredictor,
        options: SetOptions,
        error: RunningError | None = None,
    ) -> None:
        self._node = node
        self._use = use
        self._predictor = predictor
        self._trusted = options.trusted_source
        self._unattributed: DamperParameters | None = None
        self._error = error
        self._refused = ""
        self._from = self._file = options.parameter_file
        self._given = ""
        if self._file:
            try:
                given = check_plausible(read_parameter_file(self._file))
            except (StateError, ParameterError) as problem:
                raise ConfigurationError(f"parameter_file: {problem}") from problem
            self._given = given.set_id
            use(given, None)
        node.create_subscription(DamperParameters, PARAMETERS_TOPIC, self._take, quality.latched())
        quality.subscription(node, FitReport, REPORT_TOPIC, self._take_report, quality.newest())

    def _objection(self, topic: str, claimed: str) -> str:
        """Reason to ignore a message that names ``claimed`` as its node; empty if there is none."""
        names = set(quality.publishing_nodes(self._node, topic))
        if len(names) > 1 and self._trusted in names:
            names = {claimed[:_SHOWN] or "a node that does not state its name"}
        if not self._trusted or names == {self._trusted}:
            return ""
        found = " or ".join(sorted(names)) or "a node that has ended"
        return f"they come from {found}, and trusted_source is {self._trusted}"

    def _take(self, message: DamperParameters) -> None:
        self._unattributed = None
        self._refused = self._objection(PARAMETERS_TOPIC, message.node)
        if self._refused:
            # A message may arrive before the graph knows its publisher; it is checked again later.
            names = quality.publishing_nodes(self._node, PARAMETERS_TOPIC)
            if not names or any(_UNKNOWN in name for name in names):
                self._unattributed = message
            return
        try:
            parameters = check_plausible(parameter_set(message))
        except ParameterError as error:
            self._refused = str(error)
            self._node.get_logger().warning(
                f"parameters {message.id[:_SHOWN]} are not used: {error}"
            )
            return
        self._from = message.node or "a node that does not state its name"
        before = self._predictor.parameters
        # Published parameters that were not identified from samples have the stamp 0.
        self._use(parameters, parameters.stamp_ns or None)
        if self._predictor.parameters is not before:
            if self._error is not None:
                self._error.reset()
            self._node.get_logger().debug(f"using parameters {parameters.set_id}")

    def _take_report(self, message: FitReport) -> None:
        if self._objection(REPORT_TOPIC, message.node):
            return
        self._predictor.follow_report(
            WindowVerdict(
                window_start_ns=to_nanoseconds(message.window_start),
                stamp_ns=to_nanoseconds(message.header.stamp),
                verdict=message.verdict,
                nrmse_before=message.nrmse_before,
                confirms=message.confirms,
                set_id=message.parameter_set,
            )
        )

    def finding(self, doing: str) -> Finding:
        """The set in use; ``doing`` is the word for its use, such as "predicting"."""
        if self._unattributed is not None:
            self._take(self._unattributed)
        parameters = self._predictor.parameters
        publishers = quality.publishing_nodes(self._node, PARAMETERS_TOPIC)
        several = f"{PARAMETERS_TOPIC} is published by {' and '.join(publishers)}"
        if len(publishers) > 1 and not self._trusted:
            return Finding(
                ERROR, f"{several}: stop all but one, or name the one to use in trusted_source"
            )
        if self._refused:
            return Finding(WARN, f"the newest parameters are not used: {self._refused}")
        if parameters is None:
            return Finding(
                WARN,
                "no parameters yet: start the identifier in this namespace, or give parameter_file",
            )
        sentence, level = f"{doing} with {parameters.set_id}", OK
        if len(set(publishers)) > 1:
            level = WARN
            sentence += (
                f"; {several}, and only the node names in their messages distinguish them: end "
                "all but one, or exclude the others with SROS2"
            )
        return Finding(
            level,
            sentence,
            {
                "id": parameters.set_id,
                "model": parameters.model,
                "source": parameters.source,
                "from": self._file if parameters.set_id == self._given else self._from,
                "peak velocity [m/s]": "{:.4g} to {:.4g}".format(*parameters.peak_velocity_range),
                "current [A]": "{:.4g} to {:.4g}".format(*parameters.current_range),
            },
        )
