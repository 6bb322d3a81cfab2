"""The test machine and the supply as ROS topics, from recordings or from an emulated rig.

It is a managed node: configuring opens the source, activating streams. By itself it does both at
the start, so that ``ros2 run`` gives data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from mr_damper_msgs.msg import MtsSamples, SupplyCurrent
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from sensor_msgs.msg import JointState, Temperature

from mr_damper_ros.io.bags import read_bag
from mr_damper_ros.io.records import read_record
from mr_damper_ros.models.parameter_set import ParameterSet
from mr_damper_ros.models.published import THESIS_28_CELSIUS, THESIS_71_CELSIUS
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.messages import current_message, header, samples_message
from mr_damper_ros.nodes.node_parameters import ConfigurationError, NodeParameters
from mr_damper_ros.nodes.pacing import Outlet, Pacer, SendingThread, wait_for_subscribers
from mr_damper_ros.nodes.spinning import run
from mr_damper_ros.rig.emulator import (
    Damper,
    ModelDamper,
    RigBlock,
    RigSettings,
    TemperatureDependentDamper,
    ThermalModel,
    scaled,
)
from mr_damper_ros.rig.excitation import SineMotion
from mr_damper_ros.rig.sources import Meter, Reading, emulated_blocks, recorded_blocks
from mr_damper_ros.settings.option_table import ParameterTable, group, option
from mr_damper_ros.signals.blocks import NANOSECONDS, SampleBlock
from mr_damper_ros.thesis import published_runs as thesis

_THESIS_TEMPERATURES = "thesis_temperatures"

_CURRENT_STEP = 0.005
"""Change [A] of the current that is published at once; smaller ones wait for the next reading."""

_TEMPERATURE_PERIOD = 1.0

Source = Callable[[int], Iterator[RigBlock]]
"""Gives the blocks, the first one stamped with the given time [ns]."""


@dataclass(frozen=True)
class RecordParameters(ParameterTable):
    """The record file of ``source: record``."""

    file: str = option("", "Path of a text, CSV or MAT file.", read_only=True)
    columns: str = option(
        "",
        "What its columns hold, and the units, such as time:s,displacement:mm,force:N,current:A; "
        "a column to skip is a minus sign.",
        read_only=True,
    )
    current: float = option(
        math.nan,
        "Supply current [A] of the whole record, where no column holds it.",
        read_only=True,
    )
    period: float = option(
        math.nan, "Time between two samples [s], where no column holds the time.", read_only=True
    )
    variable: str = option(
        "", "Name of the matrix in a MAT file that holds more than one.", read_only=True
    )


@dataclass(frozen=True)
class EmulatedParameters(ParameterTable):
    """The emulated rig of ``source: emulated``."""

    damper: str = option(
        _THESIS_TEMPERATURES,
        f"The damper in the machine: {_THESIS_TEMPERATURES} (the thesis' at 28 °C and 71 °C, its "
        "force in between by the emulated temperature), a condition of the thesis such as "
        "5.0mm_1Hz_1.5A, or the path of a parameter file (YAML) of any model.",
        read_only=True,
    )
    hot_force: float = option(
        1.0,
        "Factor on the force at 71 °C, for a damper that gets weaker (below 1) as it heats; "
        "between 28 °C and 71 °C the force changes linearly.",
        minimum=0.0,
        maximum=10.0,
        read_only=True,
    )
    amplitude: float = option(
        0.005, "Amplitude of the sine [m].", minimum=1e-6, maximum=0.5, read_only=True
    )
    frequency: float = option(
        1.0, "Frequency of the sine [Hz].", minimum=1e-3, maximum=100.0, read_only=True
    )
    current: float = option(
        1.5,
        "Supply current [A]. It may be changed while the rig runs: this is the knob of the supply.",
        minimum=-10.0,
        maximum=10.0,
    )
    force_noise: float = option(
        5.53,
        "Standard deviation [N] of the noise of the force.",
        minimum=0.0,
        maximum=1e6,
        read_only=True,
    )
    displacement_noise: float = option(
        0.0,
        "Standard deviation [m] of the noise of the displacement.",
        minimum=0.0,
        maximum=0.1,
        read_only=True,
    )
    sample_rate: float = option(
        1000.0, "Samples per second [Hz].", minimum=1.0, maximum=100_000.0, read_only=True
    )
    initial_temperature: float = option(
        28.0,
        "Temperature of the damper at the start [°C].",
        minimum=-50.0,
        maximum=200.0,
        read_only=True,
    )
    ambient_temperature: float = option(
        22.0, "Temperature of the air [°C].", minimum=-50.0, maximum=200.0, read_only=True
    )
    heat_capacity: float = option(
        430.0,
        "Heat capacity of the damper [J/K]: smaller drifts faster.",
        minimum=0.1,
        maximum=1e6,
        read_only=True,
    )
    conductance: float = option(
        0.5,
        "Heat lost to the air per kelvin [W/K]; 0 for none.",
        minimum=0.0,
        maximum=1e4,
        read_only=True,
    )
    seed: int = option(
        0,
        "Seed of the noise; the same seed gives the same samples.",
        minimum=0,
        maximum=2**31 - 1,
        read_only=True,
    )


@dataclass(frozen=True)
class BridgeParameters(ParameterTable):
    """Parameters of the bridge node."""

    source: str = option(
        "emulated",
        "Where the samples come from: an emulated rig, a bag, or a record file.",
        choices=("emulated", "bag", "record"),
        read_only=True,
    )
    autostart: bool = option(
        True,
        "Configure and activate at the start; false leaves both to a lifecycle manager.",
        read_only=True,
    )
    rate: float = option(
        1.0,
        "Speed relative to the data's time; 0 streams as fast as the subscribers take it.",
        minimum=0.0,
        maximum=1000.0,
        read_only=True,
    )
    loop: bool = option(
        False,
        "Start a recording again at its end, for ever: stamps and seq go on, with one second "
        "left out of the stamps in between. The emulated rig never ends anyway.",
        read_only=True,
    )
    block_size: int = option(
        10,
        "Samples per message; 1 has the least delay, more cost less.",
        minimum=1,
        maximum=100_000,
        read_only=True,
    )
    current_rate: float = option(
        10.0,
        "Readings of the supply current per second [Hz]; where it steps, there is one more.",
        minimum=0.01,
        maximum=100_000.0,
        read_only=True,
    )
    mirror_rate: float = option(
        50.0,
        "Messages per second [Hz] on joint_states, a mirror for standard tools; 0 for none.",
        minimum=0.0,
        maximum=100_000.0,
        read_only=True,
    )
    frame_id: str = option(
        "damper", "Frame of all messages, and name of the joint on joint_states.", read_only=True
    )
    wait_for_subscribers: int = option(
        0,
        "Number of nodes that must have subscribed before the first sample is sent.",
        minimum=0,
        maximum=1000,
        read_only=True,
    )
    wait_timeout: float = option(
        10.0,
        "Longest time [s] to wait for them; then it streams to those that are there.",
        minimum=0.0,
        maximum=86400.0,
        read_only=True,
    )
    bag: str = option(
        "", "Path of the bag of source: bag, a folder or a single file.", read_only=True
    )
    record: RecordParameters = group(RecordParameters)
    emulated: EmulatedParameters = group(EmulatedParameters)

    def objection(self) -> str:
        """Name the path that the chosen source lacks."""
        if self.source == "bag" and not self.bag:
            return "source is bag, but no bag is given: set the parameter bag to the path of one"
        if self.source == "record" and not self.record.file:
            return (
                "source is record, but no file is given: set the parameter record.file to the "
                "path of one"
            )
        if self.source == "record" and not self.record.columns:
            return (
                "source is record, but record.columns is empty: say what the columns hold, such "
                "as time:s,displacement:mm,force:N"
            )
        return ""


class BridgeNode(LifecycleNode):
    """Publishes the samples of a source, stamped on their own clock, at their time.

    The first sample is stamped with the node's time at activation, whatever stamps a recording
    has: the bridge stands for a live machine (the replay node keeps recorded stamps).
    """

    def __init__(self) -> None:
        super().__init__("bridge")
        self.parameters = NodeParameters(self, BridgeParameters)
        self._source: Source | None = None
        self._outlets: dict[str, Outlet] = {}
        self._pacer = Pacer(self.parameters.values.rate)
        self._sending: SendingThread | None = None
        self._problem = ""
        self._starting = self.parameters.values.autostart
        self._state = ""
        self._sent = 0
        self._diagnostics = Diagnostics(self, {"source": self._find})
        if self._starting:
            for transition in (self.trigger_configure, self.trigger_activate):
                if transition() != TransitionCallbackReturn.SUCCESS:
                    raise ConfigurationError(self._problem)
            self._starting = False

    def destroy_node(self) -> None:
        """End the sending before its publishers go."""
        self._stop()
        super().destroy_node()

    # --- life cycle: rclpy's calls these, and swallows what they raise --------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the source and announce the topics."""
        values = self.parameters.values
        try:
            self._source = self._open()
            self._announce()
        except (ValueError, OSError) as error:
            self._problem = _in_words(error)
            if not self._starting:
                self.get_logger().error(f"the source cannot be opened: {self._problem}")
            self._close()
            return TransitionCallbackReturn.FAILURE
        self._problem = ""
        self.get_logger().info(f"the source is open: {values.source}")
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stream from the beginning."""
        assert self._source is not None
        blocks = self._source(self.get_clock().now().nanoseconds)
        self._sent = 0
        self._pacer.start()
        self._sending = SendingThread(self, self._pacer, lambda: self._send(blocks))
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop streaming."""
        self._stop()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the source and withdraw the topics."""
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop for good."""
        self._stop()
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def _stop(self) -> None:
        if self._sending is not None:
            self._sending.stop()
            self._sending = None

    def _close(self) -> None:
        self._source = None
        for outlet in self._outlets.values():
            self.destroy_publisher(outlet.publisher)
        self._outlets.clear()

    # --- source -------------------------------------------------------------------------------

    def _open(self) -> Source:
        values = self.parameters.values
        if values.source == "emulated":
            return self._emulated()
        if values.source == "bag":
            recordings = read_bag(values.bag)
        else:
            record = values.record
            recordings = [
                read_record(
                    record.file,
                    record.columns,
                    current=None if math.isnan(record.current) else record.current,
                    period=None if math.isnan(record.period) else record.period,
                    variable=record.variable or None,
                )
            ]
        for recording in recordings:
            recording.check_plausible()
            details = "; ".join(f"{key}: {value}" for key, value in recording.details.items())
            self.get_logger().info(
                f"{recording.name}: {recording.sample_count} samples, {recording.duration:.3g} s"
                f"{'; ' + details if details else ''}"
            )
        return lambda start_ns: recorded_blocks(
            recordings, values.block_size, start_ns, loop=values.loop
        )

    def _emulated(self) -> Source:
        values = self.parameters.values
        rig = values.emulated
        damper = _damper(rig)
        excitation = SineMotion(rig.amplitude, rig.frequency)
        thermal = ThermalModel(
            ambient=rig.ambient_temperature,
            initial=rig.initial_temperature,
            capacity=rig.heat_capacity,
            conductance=rig.conductance,
        )
        return lambda start_ns: emulated_blocks(
            damper,
            excitation,
            lambda: self.parameters.values.emulated.current,
            thermal,
            RigSettings(
                sample_rate=rig.sample_rate,
                force_noise=rig.force_noise,
                displacement_noise=rig.displacement_noise,
                seed=rig.seed,
                start_ns=start_ns,
            ),
            values.block_size,
        )

    # --- sending, in its own thread -------------------------------------------------------------

    def _announce(self) -> None:
        topics = {
            "mts/samples": MtsSamples,
            "supply/current": SupplyCurrent,
            "temperature": Temperature,
            "joint_states": JointState,
        }
        if self.parameters.values.mirror_rate == 0.0:
            del topics["joint_states"]
        unpaced = self.parameters.values.rate == 0.0
        for topic, message_type in topics.items():
            self._outlets[topic] = Outlet(self, message_type, topic, self._pacer, unpaced=unpaced)

    def _send(self, blocks: Iterator[RigBlock]) -> None:
        values = self.parameters.values
        publishers = [outlet.publisher for outlet in self._outlets.values()]
        self._state = "waits for subscribers"
        if values.wait_for_subscribers > 0 and not wait_for_subscribers(
            self, publishers, values.wait_for_subscribers, values.wait_timeout, self._pacer
        ):
            self.get_logger().warning(
                f"fewer than {values.wait_for_subscribers} nodes subscribed within "
                f"{values.wait_timeout:g} s: streaming to those that are there"
            )
        self._state = "streams"
        supply = Meter(1.0 / values.current_rate, step=_CURRENT_STEP)
        thermometer = Meter(_TEMPERATURE_PERIOD)
        mirror = _Mirror(values.mirror_rate, values.frame_id) if values.mirror_rate else None
        block = None
        for block in blocks:
            if not self._pacer.wait_until(_last_stamp(block)):
                return
            # What belongs to the samples goes first, so that it is known when they arrive.
            for reading in supply.read(block, block.current):
                self._publish_current(reading)
            for reading in thermometer.read(block, block.temperature):
                self._outlets["temperature"].publish(
                    Temperature(
                        header=header(reading.stamp_ns, values.frame_id), temperature=reading.value
                    )
                )
            self._outlets["mts/samples"].publish(samples_message(_samples(block), values.frame_id))
            for message in mirror.messages(block) if mirror else ():
                self._outlets["joint_states"].publish(message)
            self._sent += block.force.size
        if block is not None:
            # The current is now known up to the last sample.
            self._publish_current(Reading(_last_stamp(block), float(block.current[-1])))
        for outlet in self._outlets.values():
            outlet.wait_for_acknowledgement()
        self._state = "the recording is at its end: nothing more comes"
        self.get_logger().info(f"end of the recording: {self._sent} samples were sent")

    def _publish_current(self, reading: Reading) -> None:
        self._outlets["supply/current"].publish(
            current_message(reading.stamp_ns, reading.value, self.parameters.values.frame_id)
        )

    # --- state ----------------------------------------------------------------------------------

    def _find(self) -> Finding:
        figures = {"source": self.parameters.values.source, "samples sent": self._sent}
        if self._problem:
            return Finding(ERROR, f"the source cannot be opened: {self._problem}", figures)
        if self._source is None:
            return Finding(WARN, "not configured: no source is open", figures)
        if self._sending is None:
            return Finding(WARN, "not active: the source is open, nothing is streamed", figures)
        if self._sending.failure:
            return Finding(ERROR, self._sending.failure, figures)
        return Finding(OK, self._state, figures)


class _Mirror:
    """The samples as joint states, thinned out; velocity is the mean since the one before."""

    def __init__(self, rate: float, joint: str) -> None:
        self._rate = rate
        self._joint = joint
        self._last: tuple[int, float] | None = None

    def messages(self, block: RigBlock) -> Iterator[JointState]:
        every = max(round(1.0 / (self._rate * block.period)), 1)
        for index in range(-block.sequence % every, block.force.size, every):
            stamp_ns = block.start_ns + round(index * block.period * NANOSECONDS)
            position = float(block.displacement[index])
            if self._last is not None:
                elapsed = (stamp_ns - self._last[0]) / NANOSECONDS
                yield JointState(
                    header=header(stamp_ns, self._joint),
                    name=[self._joint],
                    position=[position],
                    velocity=[(position - self._last[1]) / elapsed],
                    effort=[float(block.force[index])],
                )
            self._last = (stamp_ns, position)


def _damper(rig: EmulatedParameters) -> Damper:
    """Return the damper of the parameters; raises ValueError or OSError."""
    if rig.damper == _THESIS_TEMPERATURES:
        return TemperatureDependentDamper(
            THESIS_28_CELSIUS, scaled(THESIS_71_CELSIUS, rig.hot_force)
        )
    if rig.damper.endswith((".yaml", ".yml")):
        given = ParameterSet.from_yaml(Path(rig.damper).read_text(encoding="utf-8"))
        return ModelDamper(given, 1.0 / rig.sample_rate, rig.hot_force)
    values = thesis.parameters(thesis.find(rig.damper))
    return TemperatureDependentDamper(values, scaled(values, rig.hot_force))


def _in_words(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename:
        return f"{error.filename}: {error.strerror}"
    return str(error)


def _last_stamp(block: RigBlock) -> int:
    return block.start_ns + round((block.force.size - 1) * block.period * NANOSECONDS)


def _samples(block: RigBlock) -> SampleBlock:
    return SampleBlock(
        start_ns=block.start_ns,
        sequence=block.sequence,
        period=block.period,
        displacement=block.displacement,
        force=block.force,
    )


def main() -> int:
    """Run the node."""
    return run(BridgeNode, BridgeParameters)
