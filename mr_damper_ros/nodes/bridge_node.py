"""Publishes the test machine and the supply as ROS topics, from any source of samples.

It is a managed node: configuring opens the source, activating starts the stream. By default it does
both when it starts, so that ``ros2 run`` publishes data at once.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import entry_points

from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState, Temperature

from mr_damper_ros.data_check import findings
from mr_damper_ros.nodes import messages
from mr_damper_ros.nodes.command_topic import CommandTopic
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Finding, finding_of
from mr_damper_ros.nodes.managed_node import ManagedNode, ManagedOptions
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.pacing import PacedSender, PacingSettings
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.nodes.topic_source import TopicOptions, TopicSource
from mr_damper_ros.rig.blocks import Decimator, Meter, aligned
from mr_damper_ros.rig.sources import SOURCES
from mr_damper_ros.rig.sources.source import Source, StreamSettings
from mr_damper_ros.settings.option_table import ParameterTable, group, groups, option
from mr_damper_ros.signals.blocks import MOST_SAMPLES, NANOSECONDS, RigBlock

_MIRROR = "joint_states"

_TOPICS = {
    "mts/samples": MtsSamples,
    "supply/current": SupplyCurrent,
    "temperature": Temperature,
    _MIRROR: JointState,
    messages.SUSPENSION_TOPIC: JointState,
}


def _others() -> dict[str, type[Source]]:
    """The sources of other packages; a source that cannot be loaded is reported and omitted."""
    found: dict[str, type[Source]] = {}
    for point in entry_points(group="mr_damper_ros.sources"):
        try:
            kind = point.load()
        except Exception as error:  # code of another package, without which the bridge works
            print(f"the source {point.name} cannot be loaded: {error}", file=sys.stderr)
            continue
        if not (isinstance(kind, type) and issubclass(kind, Source)):
            print(f"the source {point.name} is not a Source: {point.value}", file=sys.stderr)
            continue
        found[point.name] = kind
    return found


_ALL_SOURCES: dict[str, type[Source]] = {**SOURCES, "topics": TopicSource, **_others()}
"""Source classes by the value of the parameter ``source``."""


@dataclass(frozen=True)
class BridgeParameters(ManagedOptions):
    """Parameters of the bridge node.

    It publishes displacement and force of the test machine on mts/samples, the supply current on
    supply/current, the temperature (if it is known) on temperature, and a subsampled copy of the
    samples on joint_states. The first sample is stamped with the time of activation. From then on
    the stamps follow the clock of the samples; stamps in a recording are ignored.
    """

    source: str = option(
        "emulated",
        "Source of the samples: emulated (an emulated rig), quarter_car (an emulated car), "
        "bag (a recorded bag), record (a text, CSV or MAT file), stream (a serial line, TCP, "
        "UDP), daq (a data acquisition device) or topics (of other nodes).",
        choices=tuple(_ALL_SOURCES),
    )
    pacing: PacingSettings = group(PacingSettings, flat=True)
    loop: bool = option(
        False,
        "Whether to repeat a recording for ever. Stamps and seq continue, with a gap of one "
        "second in the stamps between repetitions. The emulated rig never ends.",
    )
    block_size: int = option(
        10,
        "Samples per message. 1 has the smallest delay. A message takes about the same processor "
        "time with 1 or 1000 samples, so larger blocks take less time in total.",
        within=(1, MOST_SAMPLES),
    )
    current_rate: float = option(
        10.0,
        "Readings of the supply current per second of data [Hz]. An extra reading is "
        "published if the current changes by more than 5 mA in between.",
        within=(0.01, 100_000.0),
    )
    mirror_rate: float = option(
        50.0,
        "Messages per second of data [Hz] on joint_states (position: displacement [m], "
        "effort: force [N], velocity: mean since the last message [m/s]); 0.0: none.",
        within=(0.0, 100_000.0),
    )
    frame_id: str = option(
        "damper", "Frame of all messages, and name of the joint on joint_states."
    )
    force_lateness: float = option(
        0.0,
        "Delay [s] of the force relative to the displacement, caused by a filter or a "
        "multiplexer; negative if the force is earlier. The bridge compensates for it; "
        "`mr-damper check` measures it.",
        within=(-0.1, 0.1),
    )
    sources: dict[str, ParameterTable] = groups(
        {name: (kind.prefix, kind.options) for name, kind in _ALL_SOURCES.items()}
    )

    def objection(self) -> str:
        """Return the reason if the chosen source lacks an option, or an empty string."""
        if self.source == "topics" and self.mirror_rate > 0.0:
            read = self.sources["topics"]
            assert isinstance(read, TopicOptions)
            if _MIRROR in (read.displacement_topic.lstrip("/"), read.force_topic.lstrip("/")):
                return (
                    f"the source is the topic {_MIRROR}, which the bridge also publishes: set "
                    "mirror_rate to 0"
                )
        return self.sources[self.source].objection()


class BridgeNode(ManagedNode):
    """Publishes the samples of a source at the right time, with stamps on the source's own clock.

    The bridge represents a live machine; the replay node keeps recorded stamps.
    """

    def __init__(self) -> None:
        super().__init__("bridge")
        self._source: Source | None = None
        self.parameters = NodeParameters(
            self, BridgeParameters, changed=self._apply, configured=lambda: self._source is not None
        )
        self._sender: PacedSender | None = None
        self._sent = 0
        # Whether blocks are sent, so that what arrives at a live source must leave.
        self._streams = False
        # Stamp [ns] and displacement [m] of the last joint state.
        self._mirrored: tuple[int, float] | None = None
        self._commands: dict[str, CommandTopic] = {}
        self._diagnostics = Diagnostics(
            self,
            {
                "source": self._find,
                "current": partial(self._find_commands, "current"),
                "motion": partial(self._find_commands, "motion"),
            },
            self._stream_findings,
        )
        if self.parameters.values.autostart:
            self._start_by_itself()

    def _apply(self, values: BridgeParameters, changed: Collection[str]) -> None:
        source = self._source
        if source is None:
            return
        source.settings = values.sources[values.source]
        if source.commander is not None and f"{source.prefix}current" in changed:
            source.commander.set_by_hand(source.settings.current)

    # --- life cycle: rclpy calls these methods and swallows their exceptions --------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the source and announce the topics."""
        values = self.parameters.values
        kind, settings = _ALL_SOURCES[values.source], values.sources[values.source]
        stream = StreamSettings(values.block_size, values.loop)
        for_node = (self,) if issubclass(kind, TopicSource) else ()
        source = self._source = kind(settings, stream, *for_node)
        try:
            found = source.open()
            for what, commander in (("current", source.commander), ("motion", source.mover)):
                if commander is not None:
                    self._commands[what] = CommandTopic(self, what, commander)
            unused = {_MIRROR} if values.mirror_rate == 0.0 else set()
            unused |= set() if source.suspended else {messages.SUSPENSION_TOPIC}
            topics = {topic: kind for topic, kind in _TOPICS.items() if topic not in unused}
            self._sender = PacedSender(self, values.pacing, topics)
        except (ValueError, OSError) as error:
            failed = self._fail("the source cannot be opened", error)
            self._close()
            return failed
        self._problem = ""
        for sentence in (*found, f"the source is open: {values.source}"):
            self.get_logger().info(sentence)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stream from the beginning."""
        assert self._source is not None
        assert self._sender is not None
        values = self.parameters.values
        made = self._source.blocks(self.get_clock().now().nanoseconds)
        blocks = aligned(made, values.force_lateness)
        due = self._due(self._sender, blocks, live=self._source.live)
        self._sent = 0
        self._sender.start(partial(self._send, self._sender, due))
        return TransitionCallbackReturn.SUCCESS

    def _stop(self) -> None:
        self._streams = False
        if self._sender is not None:
            self._sender.stop()

    def _close(self) -> None:
        for commands in self._commands.values():
            commands.close()
        self._commands = {}
        if self._source is not None:
            self._source.close()
            self._source = None
        if self._sender is not None:
            self._sender.close()
            self._sender = None

    # --- sending, in its own thread -------------------------------------------------------------

    def _send(self, sender: PacedSender, blocks: Iterator[RigBlock]) -> None:
        values = self.parameters.values
        frame_id = values.frame_id

        def publish_current(stamp_ns: int, current: float) -> None:
            message = messages.current_message(stamp_ns, current, frame_id)
            sender.publish("supply/current", message)

        sender.state, self._streams = "streams", True
        # A larger change of the current is published at once, a smaller one at the next reading.
        supply = Meter(1.0 / values.current_rate, step=0.005)
        thermometer = Meter(1.0)
        decimator, self._mirrored = Decimator(values.mirror_rate), None
        source = self._source
        block = None
        for block in blocks:
            # Current and temperature are published first, so that subscribers know them when the
            # samples arrive.
            for reading in supply.read(block, block.current, block.supply_ahead_ns):
                publish_current(*reading)
            for stamp_ns, celsius in thermometer.read(block, block.temperature):
                stamp = messages.header(stamp_ns, frame_id)
                sender.publish("temperature", Temperature(header=stamp, temperature=celsius))
            if block.suspension is not None:
                # The desired force must be known when the controller of the damper receives the
                # samples.
                stamp = messages.header(_last_stamp(block), frame_id)
                sender.publish(
                    messages.SUSPENSION_TOPIC, messages.suspension_message(block.suspension, stamp)
                )
            sender.publish("mts/samples", messages.samples_message(block, frame_id))
            if source is not None and source.watch is not None:
                source.watch.leave(time.monotonic(), block.period, block.displacement, block.force)
            if _MIRROR in sender.publishers:
                for k, stamp_ns in decimator.due(block.start_ns, block.period, block.sample_count):
                    self._publish_mirror(sender, block, k, stamp_ns)
            self._sent += block.sample_count
        if sender.stopped:
            return
        if block is not None and not math.isnan(block.current[-1]):
            # The current is now known up to the last sample.
            publish_current(_last_stamp(block), float(block.current[-1]))
        sender.wait_for_acknowledgements()
        sender.state = "the recording has ended: no more samples are sent"
        self.get_logger().info(f"end of the recording: {self._sent} samples were sent")

    def _publish_mirror(self, sender: PacedSender, block: RigBlock, k: int, stamp_ns: int) -> None:
        """Publish sample ``k`` as a joint state, with the mean velocity since the last one."""
        position = float(block.displacement[k])
        before, self._mirrored = self._mirrored, (stamp_ns, position)
        if before is None or stamp_ns <= before[0]:
            return
        if sender.publishers[_MIRROR].get_subscription_count():
            joint = self.parameters.values.frame_id
            message = JointState(
                header=messages.header(stamp_ns, joint),
                name=[joint],
                position=[position],
                velocity=[(position - before[1]) / (stamp_ns - before[0]) * NANOSECONDS],
                effort=[float(block.force[k])],
            )
            sender.publish(_MIRROR, message)

    def _due(
        self, sender: PacedSender, blocks: Iterator[RigBlock], *, live: bool
    ) -> Iterator[RigBlock]:
        """Yield the blocks of a live source as they arrive, others when their last sample is due.

        Live blocks have their own stamps. The stamps of other blocks begin when everything is ready
        to send. If the sender cannot catch up with a delay, the stamps also pause.
        """
        later_ns = 0 if live else None
        for made in blocks:
            if later_ns is None and made.sample_count > 0:
                # The first sample is stamped now, but sent with the last sample of its block.
                first_ns = made.due_ns - (_last_stamp(made) - made.start_ns)
                later_ns = self.get_clock().now().nanoseconds - first_ns
                sender.begin(first_ns)
            if sender.stopped or not (live or sender.wait_until(made.due_ns)):
                return
            if made.sample_count and later_ns is not None:
                yield replace(made, start_ns=made.start_ns + later_ns + sender.left_out_ns)

    # --- state ----------------------------------------------------------------------------------

    def _find(self) -> Finding:
        source, sender = self._source, self._sender
        figures: dict[str, object] = {
            "source": self.parameters.values.source,
            "samples sent": self._sent,
        }
        if self._problem:
            return Finding(ERROR, self._problem, figures)
        if source is None or sender is None:
            return Finding(WARN, "not configured: no source is open", figures)
        if not sender.active:
            return Finding(WARN, "not active: the source is open, but nothing is sent", figures)
        if sender.failure:
            return Finding(ERROR, sender.failure, figures)
        state = source.state()
        figures.update(state.values)
        found = state.finding if self._streams else None
        return finding_of(found, state.doing or sender.state, figures)

    def _stream_findings(self) -> list[findings.Finding]:
        """What is wrong with the stream, once blocks are sent."""
        if self._source is None or not self._streams:
            return []
        found = self._source.state().finding
        return [] if found is None else [found]

    def _find_commands(self, what: str) -> Finding:
        if what not in self._commands:
            return Finding(OK, f"the source takes no commands of the {what}")
        return self._commands[what].finding()


def _last_stamp(block: RigBlock) -> int:
    return block.stamp_ns(block.sample_count - 1)


main = partial(run, BridgeNode, BridgeParameters)
