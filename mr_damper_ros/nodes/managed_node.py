"""Base class of the managed nodes: configure, activate, stop and release the device."""

from __future__ import annotations

from dataclasses import dataclass

from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from mr_damper_ros.nodes import rclpy_internals
from mr_damper_ros.processes.files import reason_of
from mr_damper_ros.settings.option_table import ParameterTable, option


@dataclass(frozen=True)
class ManagedOptions(ParameterTable):
    """Options of all managed nodes."""

    autostart: bool = option(
        True,
        "Whether the node configures and activates itself at the start. If false, a lifecycle "
        "manager or `ros2 lifecycle set` does both. Configuring connects to the device or opens "
        "the file; activating starts the stream or switches the output on.",
        start_only=True,
    )


class ManagedNode(LifecycleNode):
    """A lifecycle node that rejects transitions which its state does not allow.

    A subclass implements ``on_configure``, ``on_activate``, :meth:`_stop` and :meth:`_close`, which
    releases its device.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self._problem = ""
        self._starting = False
        rclpy_internals.refuse_wrong_transitions(self)

    def _start_by_itself(self) -> None:
        """Configure and activate; raises ValueError with the problem."""
        self._starting = True
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                self._close()
                raise ValueError(self._problem)
        self._starting = False

    def _fail(self, what: str, error: Exception) -> TransitionCallbackReturn:
        """Store the problem, and log it unless the node is just starting."""
        self._problem = f"{what}: {reason_of(error)}"
        if not self._starting:
            self.get_logger().error(self._problem)
        return TransitionCallbackReturn.FAILURE

    def _stop(self) -> None:
        """Undo the activation, if the node is active."""
        raise NotImplementedError

    def _close(self) -> None:
        """Undo the configuration, if the node is configured."""
        raise NotImplementedError

    def destroy_node(self) -> None:
        """Stop and release the device before the publishers are destroyed."""
        self._stop()
        self._close()
        super().destroy_node()

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop; rclpy calls this and the next two methods."""
        self._stop()
        return TransitionCallbackReturn.SUCCESS

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release the device."""
        self._close()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop and release the device for good."""
        self._stop()
        self._close()
        return TransitionCallbackReturn.SUCCESS
