"""Node that drives the supply of the coil: commands in, measured current out.

It is a managed node: configuring connects to the instrument and sets it up, activating switches its
output on. By default it does both at the start. The output is off whenever the node is not active,
which is measured.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass
from functools import partial

from mr_damper_msgs.msg import SupplyCurrent
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn

from mr_damper_ros.emulation.instrument import EmulatedInstrument
from mr_damper_ros.nodes import quality
from mr_damper_ros.nodes.command_topic import CommandTopic
from mr_damper_ros.nodes.diagnostics import ERROR, OK, WARN, Diagnostics, Finding
from mr_damper_ros.nodes.managed_node import ManagedNode, ManagedOptions
from mr_damper_ros.nodes.messages import current_message
from mr_damper_ros.nodes.node_parameters import NodeParameters
from mr_damper_ros.nodes.spinning import FAILURE, SUCCESS, run
from mr_damper_ros.rig.commander import CommandSettings, CurrentCommander
from mr_damper_ros.rig.supplies import scpi_link
from mr_damper_ros.rig.supplies.supply import (
    NotOffError,
    ScpiSupply,
    SupplyDrive,
    read_profile,
)
from mr_damper_ros.settings.option_table import group, option

_EMULATED = "emulated"
"""Address and profile of the emulated instrument, which runs in this process."""

_GOES_ON = "the node keeps trying"


@dataclass(frozen=True)
class SupplyParameters(ManagedOptions):
    """Parameters of the supply node.

    It receives stamped commands on supply/current_command, sets the instrument, and publishes the
    current that the instrument measures on supply/current. The output is off whenever the node is
    not active, and after SIGINT and SIGTERM. If the instrument does not measure that it is off, the
    node reports an error and ends with exit code 1.
    """

    address: str = option(
        _EMULATED,
        "Address of the instrument: host:port (5025 for most), a VISA resource name such as "
        "USB0::0x2A8D::0x1202::MY1::INSTR (needs PyVISA), or emulated, an instrument in this "
        "process.",
    )
    profile: str = option(
        "",
        "Command set of the instrument: scpi (most bench supplies), keysight_n7900, or the "
        "path of your own YAML file (doc/supply.md). Empty: scpi, or the command set of the "
        "emulated instrument.",
    )
    current: float = option(
        0.0,
        "Manual setpoint of the current [A], between smallest_current and largest_current. It "
        "can be set while the node runs, and holds until a command arrives or the output is "
        "switched off: `ros2 param set /supply current 0.5`. After a command timeout or an "
        "activation it is not restored: set it again, even to the same value.",
        within=(-1000.0, 1000.0),
        read_only=False,
    )
    commands: CommandSettings = group(CommandSettings, flat=True)
    largest_voltage: float = option(12.0, "Largest voltage [V] at the coil.", within=(0.0, 1000.0))
    rate: float = option(
        20.0, "Readings of the measured current per second [Hz].", within=(0.1, 1000.0)
    )
    tolerance: float = option(
        0.05,
        "Largest difference [A] between measured current and setpoint; a larger one that lasts "
        "for a second is an error. A measured current of at most this size counts as zero.",
        within=(1e-6, 1000.0),
    )
    link_timeout: float = option(
        0.5,
        "Time [s] within which a complete answer must arrive. If it does not, the link counts as "
        "lost: the node becomes inactive at once and switches the output off over a new link.",
        within=(0.01, 60.0),
    )
    watchdog: float = option(
        1.0,
        "Time [s] without a command line after which the watchdog of the instrument switches "
        "its output off, if its profile has one; rounded up to the resolution of the "
        "instrument.",
        within=(0.05, 3600.0),
    )
    frame_id: str = option("damper", "Frame of the measured current.")

    def objection(self) -> str:
        """Return the reason if a current or the watchdog is invalid, or an empty string."""
        low, high = self.commands.smallest_current, self.commands.largest_current
        if not low <= self.current <= high:
            return (
                f"current is {self.current:g} A: it must lie within smallest_current and "
                f"largest_current, {low:g} to {high:g} A"
            )
        if self.watchdog < 2.0 / self.rate:
            return (
                f"watchdog is {self.watchdog:g} s, but a command line is sent only every "
                f"{1.0 / self.rate:g} s: make watchdog at least twice this time, or increase rate"
            )
        return ""


class SupplyNode(ManagedNode):
    """Drives a supply; commands and readings run in their own thread, as an instrument may be slow.

    If the link to the supply is lost, the node becomes inactive at once, so that a lifecycle
    manager learns that commands have no effect. The thread keeps trying to switch the output off.
    """

    def __init__(self) -> None:
        super().__init__("supply")
        self._supply: ScpiSupply | None = None
        self.parameters = NodeParameters(
            self, SupplyParameters, changed=self._apply, configured=lambda: self._supply is not None
        )
        self._drive: SupplyDrive | None = None
        self._commander = CurrentCommander(CommandSettings())
        self._by_hand = self.parameters.values.current
        self._commands: CommandTopic | None = None
        self._identity = ""
        self._left_on = False
        self._diagnostics = Diagnostics(
            self, {"supply": self._find_supply, "current": self._find_current}
        )
        if self.parameters.values.autostart:
            self._start_by_itself()

    def _apply(self, values: SupplyParameters, changed: Collection[str]) -> None:
        if "current" not in changed:
            return
        if self._commands is None:
            self._by_hand = values.current
        elif self._drive is not None:
            self._commander.set_by_hand(values.current)
            self._drive.wake()

    # --- life cycle: rclpy calls these methods and swallows their exceptions --------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Connect to the instrument and set it up, with its output off."""
        values = self.parameters.values
        try:
            self._supply = _supply(values)
            self._identity = self._supply.open()
            self._publisher = quality.publisher(self, SupplyCurrent, "supply/current")
        except (ValueError, OSError) as error:
            self._supply = None
            self._left_on = isinstance(error, NotOffError)
            return self._fail("the supply cannot be set up", error)
        self._problem, self._left_on = "", False
        self.get_logger().info(f"connected to {self._identity} at {values.address}")
        if math.isnan(self._supply.watchdog):
            self.get_logger().warning(
                "the profile of this supply has no watchdog: if this process or the link dies, "
                "the current stays on"
            )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Switch the output on and accept commands; the last command is not restored."""
        assert self._supply is not None
        values = self.parameters.values
        if self._drive is not None:
            self.get_logger().error(f"not switched on: {self._drive.problem}; {_GOES_ON}")
            return TransitionCallbackReturn.FAILURE
        self._commander = CurrentCommander(values.commands, self._by_hand)
        drive = SupplyDrive(
            self._supply,
            self._commander,
            period=1.0 / values.rate,
            clock_ns=lambda: int(self.get_clock().now().nanoseconds),
            publish=self._publish_current,
            log_error=self.get_logger().error,
        )
        try:
            drive.start()
        except (ValueError, OSError) as error:
            self._drive = None if drive.finished else drive
            return self._fail("the supply cannot be switched on", error)
        self._drive, self._problem, self._by_hand = drive, "", 0.0
        self._commands = CommandTopic(
            self, "current", self._commander, drive.wake, self._diagnostics.publish
        )
        return TransitionCallbackReturn.SUCCESS

    def _stop(self) -> None:
        if self._commands is not None:
            self._commands.close()
            self._commands = None
        drive = self._drive
        if drive is None or drive.failure:
            return  # the thread already switches a lost supply off
        if drive.stop():
            self._drive = None
        else:
            self._problem = f"{drive.problem}; {_GOES_ON}"
            self._diagnostics.publish()

    def _close(self) -> None:
        drive, self._drive = self._drive, None
        supply, self._supply = self._supply, None
        if drive is not None and supply is not None and not drive.stop():
            drive.end()
            self._left_on = True
            self._problem = f"{drive.problem}; the node has stopped trying"
            if not math.isnan(supply.watchdog):
                self._problem += f", the watchdog acts after {supply.watchdog:g} s of silence"
        if supply is not None:
            try:
                supply.close()
            except scpi_link.LinkLostError as error:
                self.get_logger().warning(f"closing the link failed: {error}")
            self.destroy_publisher(self._publisher)
        if self._left_on and not self._starting:  # the last words of a node that ends
            self.get_logger().error(self._problem)

    @property
    def exit_code(self) -> int:
        """1 if the coil may still carry a current after the end of the node."""
        return FAILURE if self._left_on else SUCCESS

    def _publish_current(self, stamp_ns: int, current: float) -> None:
        self._publisher.publish(current_message(stamp_ns, current, self.parameters.values.frame_id))

    def watch(self) -> float:
        """Deactivate if the supply is lost, and report when it is off; returns infinity."""
        drive = self._drive
        if drive is not None and (drive.failure or self._commands is None):
            if self._commands is not None:
                self.trigger_deactivate()
            if drive.finished:
                self._drive = None
                self._problem = f"{drive.problem}: activate the node again to continue"
                self.get_logger().error(self._problem)
        return math.inf

    # --- state ----------------------------------------------------------------------------------

    def _find_supply(self) -> Finding:
        supply, drive = self._supply, self._drive
        if supply is None:
            level = ERROR if self._problem else WARN
            output = "may be on" if self._left_on else "unknown"
            return Finding(level, self._problem or "not configured", {"output": output})
        values: dict[str, object] = {
            "instrument": self._identity,
            "watchdog [s]": "none" if math.isnan(supply.watchdog) else f"{supply.watchdog:g}",
            "output": "off" if drive is None else "on",
        }
        if drive is not None and (drive.failure or self._commands is None):
            values["output"] = "may be on"
            return Finding(ERROR, f"{drive.problem}; {_GOES_ON}", values)
        if drive is None:
            level = ERROR if self._problem else WARN
            sentence = "not active: the output is measured to be off"
            return Finding(level, self._problem or sentence, values)
        values["complaints"] = drive.complaints
        if drive.last_complaint:
            return Finding(WARN, f"the supply reports: {drive.last_complaint}", values)
        if math.isnan(supply.watchdog):
            sentence = "on; no watchdog: if this process or the link dies, the current stays on"
            return Finding(WARN, sentence, values)
        return Finding(
            OK, f"on; its watchdog switches off after {supply.watchdog:g} s of silence", values
        )

    def _find_current(self) -> Finding:
        if self._drive is None or self._commands is None:
            if self._drive is not None or self._left_on:
                return Finding(ERROR, "the coil may carry a current")
            is_known = self._supply is not None
            return Finding(WARN, "no current: the output is off" if is_known else "not configured")
        state = self._drive
        found = self._commands.finding()
        values = {**found.values, "set [A]": state.given, "measured [A]": state.measured}
        if state.deviates:
            return Finding(
                ERROR,
                f"the supply gives {state.measured:.3f} A instead of {state.given:.3f} A: is the "
                "coil connected, has a protection tripped, does it need more voltage?",
                values,
            )
        return Finding(found.level, f"{state.measured:.3f} A; {found.message}", values)


def _supply(values: SupplyParameters) -> ScpiSupply:
    """The supply of the parameters; raises ValueError."""
    emulated = values.address == _EMULATED
    profile = read_profile(values.profile or (_EMULATED if emulated else "scpi"))
    instrument = EmulatedInstrument()

    def link(patience: scpi_link.Patience, identity: str) -> scpi_link.ScpiLink:
        if not emulated:
            return scpi_link.connect(values.address, patience, identity)
        direct = scpi_link.DirectTransport(instrument.process)
        return scpi_link.ScpiLink(direct, patience, identity)

    return ScpiSupply(
        link,
        profile,
        voltage=values.largest_voltage,
        watchdog=values.watchdog,
        timeout=values.link_timeout,
        tolerance=values.tolerance,
    )


main = partial(
    run,
    SupplyNode,
    SupplyParameters,
    between=SupplyNode.watch,
    left=lambda node: node.exit_code,
)
